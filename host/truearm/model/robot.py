"""Robot files (TOML): a chain with named sets of parameter values, and which parameters are held fixed by default.

::

    name = "puma560"
    convention = "sheth_uicker"
    nominal = "design"                 # the set the chain starts from
    [link1]
    x_cm = { design = 0.0, optimised = 1.25885 }
    alpha_deg = { design = 90.0, optimised = 90.0, held = true }
    …
    [joint1]
    kind = "revolute"
    lower_deg = -160.0
    upper_deg = 160.0
    offset_deg = { design = -90.0, optimised = -90.0, held = true }
    gain = { design = 1.0, optimised = 0.999217 }

Units stand in the keys: ``_m _cm _mm`` for lengths, ``_rad _deg`` for angles, none for a gain.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from typing import Any

import numpy as np
from numpy.typing import NDArray

from truearm.errors import RobotError
from truearm.model.chain import Chain, Joint
from truearm.model.sheth_uicker import chain_from_sheth_uicker, parameter_units
from truearm.types import Floats

MAX_TEXT = 1_000_000  # characters; the PUMA's file has 3,000
MAX_JOINTS = 64
TO_SI = {"m": {"m": 1.0, "cm": 1e-2, "mm": 1e-3}, "rad": {"rad": 1.0, "deg": math.pi / 180.0}, "1": {"": 1.0}}


@dataclass(frozen=True)
class Robot:
    """A chain, named parameter sets (p,), and ``free`` (p,): False for the parameters the file holds fixed."""

    chain: Chain
    parameter_sets: Mapping[str, Floats]
    free: NDArray[np.bool_]


def builtin_names() -> tuple[str, ...]:
    """Names of the robots that come with truearm."""
    files = resources.files("truearm.model").joinpath("robots").iterdir()
    return tuple(sorted(f.name.removesuffix(".toml") for f in files if f.name.endswith(".toml")))


def builtin_robot(name: str) -> Robot:
    """A robot that comes with truearm, "puma560" for one. Raises RobotError for an unknown name."""
    if name not in builtin_names():
        raise RobotError(f"no built-in robot {name!r}; there is {', '.join(builtin_names())}")
    return parse_robot(resources.files("truearm.model").joinpath("robots", f"{name}.toml").read_text("utf-8"))


def parse_robot(text: str) -> Robot:
    """The robot of a TOML text. Raises RobotError, naming table and key, for anything missing, unknown or absurd."""
    if len(text) > MAX_TEXT:
        raise RobotError(f"robot file has {len(text)} characters, the limit is {MAX_TEXT}")
    try:
        doc = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise RobotError(f"robot file is not valid TOML: {error}") from error
    head = {key: _string(doc, key) for key in ("name", "convention", "nominal", "base_frame", "end_frame")}
    if head["convention"] != "sheth_uicker":
        raise RobotError(f"robot file: convention {head['convention']!r} is not known; use sheth_uicker")
    joints = _joints(doc)
    sets, held = _parameters(doc, joints, head["nominal"])
    chain = chain_from_sheth_uicker(head["name"], joints, sets[head["nominal"]], head["base_frame"], head["end_frame"])
    return Robot(chain, sets, ~held)


def _joints(doc: Mapping[str, Any]) -> tuple[Joint, ...]:
    known = {"name", "convention", "nominal", "base_frame", "end_frame"}
    count = sum(1 for key in doc if key.startswith("joint"))
    if not 1 <= count <= MAX_JOINTS:
        raise RobotError(f"robot file has {count} joints; 1 to {MAX_JOINTS} are possible")
    expected = known | {f"joint{i + 1}" for i in range(count)} | {f"link{i + 1}" for i in range(count + 1)}
    for key in sorted(set(doc) ^ expected):
        raise RobotError(f"robot file: {'unknown' if key in doc else 'missing'} table or key {key}")
    return tuple(_joint(f"joint{i + 1}", _table(doc, f"joint{i + 1}")) for i in range(count))


def _joint(name: str, table: Mapping[str, Any]) -> Joint:
    kind = table.get("kind")
    if kind not in ("revolute", "prismatic"):
        raise RobotError(f"robot file: {name}.kind is {kind!r}; use revolute or prismatic")
    unit = "rad" if kind == "revolute" else "m"
    limits = []
    for key in ("lower", "upper"):
        found, scale = _find(table, name, key, unit)
        limits.append(_number(table[found], f"{name}.{found}") * scale)
    if limits[0] >= limits[1]:
        raise RobotError(f"robot file: {name}'s lower limit is not below its upper limit")
    return Joint(name, kind, limits[0], limits[1])


def _parameters(
    doc: Mapping[str, Any], joints: tuple[Joint, ...], nominal: str
) -> tuple[dict[str, Floats], NDArray[np.bool_]]:
    """All parameter sets, SI, and the mask of held parameters; every parameter must be in every set."""
    rows, held = [], []
    used: dict[str, set[str]] = {f"joint{i + 1}": {"kind"} for i in range(len(joints))}
    for full, unit in parameter_units(joints):
        table_name, key = full.split(".")
        table = _table(doc, table_name)
        found, scale = _find(table, table_name, key, unit)
        used.setdefault(table_name, set()).add(found)
        values, is_held = _values(table[found], f"{table_name}.{found}")
        rows.append({k: v * scale for k, v in values.items()})
        held.append(is_held)
    for table_name, keys in used.items():
        for key in doc[table_name]:
            if key not in keys and not key.startswith(("lower_", "upper_")):
                raise RobotError(f"robot file: unknown key {table_name}.{key}")
    names = set(rows[0])
    if nominal not in names or any(set(row) != names for row in rows):
        raise RobotError(f"robot file: every parameter needs the same sets of values, {nominal!r} among them")
    return {name: np.array([row[name] for row in rows]) for name in sorted(names)}, np.array(held)


def _values(entry: Any, where: str) -> tuple[dict[str, float], bool]:
    if not isinstance(entry, Mapping):
        raise RobotError(f"robot file: {where} must be a table of named values, as {{ design = 0.0 }}")
    held = entry.get("held", False)
    if not isinstance(held, bool):
        raise RobotError(f"robot file: {where}.held must be true or false")
    return {k: _number(v, f"{where}.{k}") for k, v in entry.items() if k != "held"}, held


def _find(table: Mapping[str, Any], table_name: str, key: str, unit: str) -> tuple[str, float]:
    """The key with its unit suffix as it stands in the table, and the factor to SI."""
    candidates = {f"{key}_{suffix}" if suffix else key: scale for suffix, scale in TO_SI[unit].items()}
    found = [name for name in candidates if name in table]
    if len(found) != 1:
        raise RobotError(f"robot file: {table_name} needs exactly one of {', '.join(candidates)}")
    return found[0], candidates[found[0]]


def _table(doc: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    table = doc[name]
    if not isinstance(table, Mapping):
        raise RobotError(f"robot file: {name} must be a table")
    return table


def _string(doc: Mapping[str, Any], key: str) -> str:
    value = doc.get(key)
    if not isinstance(value, str) or not value:
        raise RobotError(f"robot file: {key} must be a text")
    return value


def _number(value: Any, where: str) -> float:
    # the comparison holds for integers too large for a float, and fails for nan
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not -1e300 < value < 1e300:
        raise RobotError(f"robot file: {where} must be a finite number")
    return float(value)
