"""A result.json read back: the parts that later commands need, checked (docs/reference/result-format.md)."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.errors import InputError
from truearm.files.disk import read_text
from truearm.files.law_document import LAWS
from truearm.files.result_consistency import check_consistent, check_covariance
from truearm.files.result_file import CHECKSUM, FORMAT, FORMAT_VERSION, SINCE_CHECKSUM, RobotFrames, checksum
from truearm.results import STATUSES, NullDirection, StillJoint
from truearm.schema import Choice, Flag, Key, List, ReadOnly, SchemaError, Table, Text, Value, quoted, raising
from truearm.types import Floats, Law, Payload

MAX_BYTES = 64 * 2**20
MAX_PARAMETERS = 20_000
MAX_TEXT = 500  # characters; a parameter's name has at most 150


class JointRange(NamedTuple):
    """The lowest and highest reading [rad or m] of each joint among the fitted observations."""

    lower: tuple[float, ...]
    upper: tuple[float, ...]


@dataclass(frozen=True)
class StoredResult:
    """The parts of a result.json that later commands need; arrays run over all parameters, NaN where the file has null.

    ``covariance`` (f, f) runs over ``covariance_names``, the free parameters.
    """

    status: str
    robot: RobotFrames
    parameter_names: tuple[str, ...]
    units: tuple[str, ...]
    nominal: Floats
    value: Floats
    sigma: Floats
    free: NDArray[np.bool_]
    of_robot: NDArray[np.bool_]
    covariance_names: tuple[str, ...]
    covariance: Floats
    null_space: tuple[NullDirection, ...]
    frames: tuple[NullDirection, ...]  # along which parameters were fixed as a choice of frame
    still: tuple[StillJoint, ...]
    lost: tuple[str, ...]  # parameters fixed because their joints did not move
    laws: tuple[Law, ...]  # joint laws; their parameters follow the robot's own
    document: Mapping[str, Any]  # the whole file as parsed
    joint_range: JointRange | None = None  # None: written by an earlier version
    payloads: tuple[Payload, ...] = ()  # the different ones of the fitted rows, empty if joint laws were not tried


def read_result(path: Path) -> StoredResult:
    """Read a result.json of this format version or an older one. Raises InputError that names file and field."""
    return parse_result(read_text(path, MAX_BYTES, InputError), str(path))


def parse_result(text: str, name: str) -> StoredResult:
    """Parse the text of a result.json; see ``read_result``. Unknown fields, from later versions, are skipped."""
    document = _json_object(text, name)
    if document.get("format") != FORMAT:
        raise InputError(f"{name}: is not a result of truearm identify (its format is not {FORMAT!r})")
    version = document.get("format_version")
    if version is None:
        raise InputError(f"{name}: has no format_version, so it is incomplete; identify again")
    if not isinstance(version, int) or isinstance(version, bool) or not 1 <= version <= FORMAT_VERSION:
        raise InputError(
            f"{name}: has format version {str(version)[:20]}, this truearm reads up to {FORMAT_VERSION}; update truearm"
        )
    with raising(InputError, name):
        stored = stored_result(document)
        if version >= SINCE_CHECKSUM or CHECKSUM in document:
            _check_whole(document)
        sigma = dict(zip(stored.parameter_names, stored.sigma.tolist(), strict=True))
        check_covariance(stored.covariance_names, stored.covariance, sigma)
        check_consistent(document)
        return stored


def _check_whole(document: Mapping[str, Any]) -> None:
    """Raise SchemaError if the content is not what was written."""
    try:
        whole = document.get(CHECKSUM) == checksum(document)
    except (ValueError, RecursionError):
        whole = False
    if not whole:
        raise SchemaError("was changed or damaged: its checksum does not match; copy it again or identify again")


def _json_object(text: str, name: str) -> dict[str, Any]:
    try:
        document = json.loads(text, parse_constant=_refuse_constant)
    except RecursionError as exc:
        raise InputError(f"{name}: is nested too deeply; give a result of truearm identify") from exc
    except ValueError as exc:  # JSONDecodeError, constants such as NaN, integers that are too large
        raise InputError(f"{name}: is not strict JSON: {exc}; give a result of truearm identify") from exc
    if not isinstance(document, dict):
        raise InputError(f"{name}: is not a JSON object; give a result of truearm identify")
    return document


def _refuse_constant(constant: str) -> float:
    raise ValueError(f"{constant} is not JSON")


@dataclass(frozen=True)
class _JsonNumber(ReadOnly):
    """A finite number, or NaN for ``null`` where that is allowed."""

    null: bool = True

    def parse(self, raw: Any, suffix: str = "") -> float:
        if raw is None and self.null:
            return math.nan
        if isinstance(raw, bool) or not isinstance(raw, int | float):
            raise SchemaError(f"{quoted(raw)} is not a number")
        if not abs(raw) <= sys.float_info.max:  # JSON's 1e999, or an integer too large for a float
            raise SchemaError("not a finite number")
        return float(raw)


class _NumberRow(ReadOnly):
    """A list of numbers or ``null``. Rows of finite floats, nearly all of a large covariance, are checked at once."""

    def parse(self, raw: Any, suffix: str = "") -> tuple[float, ...]:
        if isinstance(raw, list) and all(type(item) is float for item in raw) and np.isfinite(raw).all():
            return tuple(raw)  # as many as there are names
        return tuple(_many(_NUMBER).parse(raw, suffix))


@dataclass(frozen=True)
class Nullable(ReadOnly):
    """A value, or ``null``."""

    value: Value

    def parse(self, raw: Any, suffix: str = "") -> Any:
        return None if raw is None else self.value.parse(raw, suffix)


class _StoredParameter(NamedTuple):
    name: str
    unit: str
    nominal: float
    value: float
    sigma: float
    free: bool
    of: str


class _StoredCovariance(NamedTuple):
    names: tuple[str, ...]
    matrix: tuple[tuple[float, ...], ...]


def _later(keys: tuple[Key, ...], make: Callable[..., Any]) -> Table[Any]:
    """Return a table to which a later version may have added keys."""
    return Table(keys, make, unknown_keys=True)


def _many(item: Value) -> List:
    return List(item, least=0, most=MAX_PARAMETERS)


def _text(name: str) -> Key:
    return Key(name, Text(MAX_TEXT))


_NUMBER, _KNOWN = _JsonNumber(), _JsonNumber(null=False)
_NAMES = Key("names", _many(Text(MAX_TEXT)))
_UNITS = Key("joint_units", List(Choice(("rad", "m"))))
_FRAMES = _later((_text("name"), _text("base_frame"), _text("end_frame"), _UNITS), RobotFrames)
_NUMBERS = (Key("nominal", _KNOWN), Key("value", _NUMBER), Key("sigma", _NUMBER))
_OF = Key("of", Choice(("robot", "rig")))
_PARAMETER = _later((_text("name"), _text("unit"), *_NUMBERS, Key("free", Flag()), _OF), _StoredParameter)
_COVARIANCE = _later((_NAMES, Key("matrix", _many(_NumberRow()))), _StoredCovariance)
_DIRECTION = _later((_NAMES, Key("weights", _many(_KNOWN))), NullDirection)
_STILL = _later(
    (_text("joint"), Key("unit", Choice(("rad", "m"))), Key("spread", _KNOWN), Key("at", _KNOWN)), StillJoint
)
_DEFAULTS = _later(
    (
        Key("frames", _many(_DIRECTION), optional=True),
        Key("still", _many(_STILL), optional=True),
        Key("lost", _many(Text(MAX_TEXT)), optional=True),
    ),
    dict,
)
_JOINT_RANGE = _later((Key("lower", _many(_KNOWN)), Key("upper", _many(_KNOWN))), JointRange)
_OBJECT = Nullable(_later((), dict))  # its numbers are checked by ``result_consistency``
_SPAN = List(_KNOWN, least=2, most=2)
_SPANS = (Key("rows", _SPAN), Key("first_within", _SPAN), Key("last_within", _SPAN))
_SYSTEMATIC = _later(
    (_text("form"), *_SPANS, Key("unit", Nullable(Text(MAX_TEXT))), Key("chance", Nullable(_KNOWN))), dict
)
_RESULT = _later(
    (
        Key("status", Choice(STATUSES)),
        Key("robot", _FRAMES),
        Key("parameters", _many(_PARAMETER)),
        Key("covariance", _COVARIANCE),
        Key("null_space", _many(_DIRECTION)),
        Key("joint_laws", Nullable(LAWS), optional=True),
        Key("defaults", _DEFAULTS, optional=True),  # results of earlier versions have nothing here
        Key("joint_range", _JOINT_RANGE, optional=True),
        Key("suggested_free", _many(Text(MAX_TEXT)), optional=True),
        Key("chi2_band", Nullable(List(_NUMBER, least=2, most=2)), optional=True),
        Key("systematic", _many(_SYSTEMATIC), optional=True),
        Key("explanations", _many(_later((_text("what"),), dict)), optional=True),
        *(Key(name, _OBJECT, optional=True) for name in ("unexplained", "mean_change", "held_out", "held_out_before")),
    ),
    dict,
)


def stored_result(document: Mapping[str, Any]) -> StoredResult:
    """Return the parts of a result.json that later commands need. Raises SchemaError for a wrong field."""
    fields = _RESULT.parse(document)
    parameters: tuple[_StoredParameter, ...] = fields["parameters"]
    covariance: _StoredCovariance = fields["covariance"]
    names, size = tuple(p.name for p in parameters), len(covariance.names)
    if len(set(names)) != len(names):
        raise SchemaError("parameters: their names are not unique; identify again")
    if not set(covariance.names) <= set(names):
        raise SchemaError("covariance: names parameters that the result does not have; identify again")
    if len(covariance.matrix) != size or any(len(row) != size for row in covariance.matrix):
        raise SchemaError(f"covariance: matrix: needs {size} rows of {size} numbers, one per name")
    defaults = fields.get("defaults", {})
    frames: tuple[NullDirection, ...] = defaults.get("frames", ())
    for where, directions in (("null_space", fields["null_space"]), ("defaults: frames", frames)):
        for i, direction in enumerate(directions, start=1):
            if len(direction.names) != len(direction.weights):
                raise SchemaError(f"{where}: item {i}: needs a weight for each of its names")
    joint_range: JointRange | None = fields.get("joint_range")
    n_joints = len(fields["robot"].joint_units)
    if joint_range is not None and (len(joint_range.lower), len(joint_range.upper)) != (n_joints, n_joints):
        raise SchemaError(f"joint_range: needs {n_joints} numbers each, one per joint")
    laws = fields.get("joint_laws") or {}
    return StoredResult(
        status=fields["status"],
        robot=fields["robot"],
        parameter_names=names,
        units=tuple(p.unit for p in parameters),
        nominal=np.array([p.nominal for p in parameters]),
        value=np.array([p.value for p in parameters]),
        sigma=np.array([p.sigma for p in parameters]),
        free=np.array([p.free for p in parameters], dtype=bool),
        of_robot=np.array([p.of == "robot" for p in parameters], dtype=bool),
        covariance_names=covariance.names,
        covariance=np.array(covariance.matrix).reshape(size, size),
        null_space=fields["null_space"],
        frames=frames,
        still=defaults.get("still", ()),
        lost=defaults.get("lost", ()),
        laws=laws.get("laws", ()),
        document=document,
        joint_range=joint_range,
        payloads=laws.get("payloads", ()),
    )
