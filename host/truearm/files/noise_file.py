"""Noise files: what ``truearm characterize`` found out about a robot and a bar, for ``truearm identify --noise``.

TOML, the same words as in a rig file (docs/table-format.md): ``joint_sigma_rad`` or ``joint_cov_si`` of the joint readings and
``[[bar]]`` entries of a name and its ``sigma``. They stand in for the rig's. ``backlash_si`` and ``backlash_sigma_si`` are the joints'.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from truearm.errors import RigError
from truearm.files.disk import parse_toml, read_text
from truearm.files.rig_devices import joint_cov, matrix_text, numbers
from truearm.files.rig_values import check_keys, keys, length, name_of, number, positive, within
from truearm.types import Matrix, Rig

MAX_BYTES = 2**16
FIRST_LINE = "# noise of a robot and its ball-bar, by truearm characterize"
JOINTS = {"joint_sigma_rad", "joint_sigma_deg", "joint_cov_si"}
BACKLASH = ("backlash_si", "backlash_sigma_si")


@dataclass(frozen=True)
class NoiseFile:
    """``joint_cov`` S_q [rad², m²], empty for none; ``bar_sigma`` [m] by the bar's name; ``name``: of the file, for messages.

    ``backlash`` and its sigma [rad, m]: as a Rig's.
    """

    joint_cov: Matrix = ()
    bar_sigma: Mapping[str, float] = field(default_factory=dict)
    name: str = "noise"
    backlash: tuple[float, ...] = ()
    backlash_sigma: tuple[float, ...] = ()


def read_noise(path: Path) -> NoiseFile:
    """Read a noise file. Raises RigError that names the file, the entry and the key."""
    return parse_noise(read_text(path, MAX_BYTES, RigError), str(path))


def parse_noise(text: str, name: str) -> NoiseFile:
    """Parse the text of a noise file; ``name`` stands for the file in messages."""
    data = parse_toml(text, name, RigError)
    check_keys(data, JOINTS | {"bar", *BACKLASH}, name)
    tables = data.get("bar", [])
    if not isinstance(tables, list) or not all(isinstance(table, dict) for table in tables):
        raise RigError(f"{name}: bar must be written as [[bar]] entries")
    sigma: dict[str, float] = {}
    for i, table in enumerate(tables, start=1):
        where = f"{name}: [[bar]] {i}"
        check_keys(table, {"name"} | keys(("sigma",)), where)
        bar = name_of(table, where)
        if bar in sigma:
            raise RigError(f"{where}: the name {bar!r} stands twice")
        sigma[bar] = positive(length(table, "sigma", where), "sigma", where)
    cov = joint_cov(data, name)
    return NoiseFile(cov, sigma, name, *_backlash(data, cov, name))


def _backlash(data: Mapping[str, Any], cov: Matrix, name: str) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Widths and their sigmas, both or neither, one for each joint of ``cov``."""
    if not any(key in data for key in BACKLASH):
        return (), ()
    if not cov:
        raise RigError(f"{name}: backlash_si needs joint_sigma_rad or joint_cov_si, of which half of it is a part")
    both = []
    for key in BACKLASH:
        values = data.get(key)
        if not isinstance(values, list) or len(values) != len(cov):
            raise RigError(f"{name}: {key} must be a list of {len(cov)} numbers, one a joint")
        both.append(tuple(number(value, key, name) for value in values))
    width, sigma = both
    within(min(sigma), 0.0, BACKLASH[1], name)
    for j, b in enumerate(width):
        if 0.25 * b**2 > cov[j][j] * (1.0 + 1e-9):
            raise RigError(f"{name}: joint {j + 1} has a sigma of less than half its backlash, which is a part of it")
    return width, sigma


def with_noise(rig: Rig, noise: NoiseFile | None) -> Rig:
    """The rig with the noise's figures in place of its own; what the noise does not name stays."""
    if noise is None:
        return rig
    bars = {
        name: replace(bar, sigma=noise.bar_sigma[name]) if name in noise.bar_sigma else bar
        for name, bar in rig.bars.items()
    }
    rig = replace(rig, bars=bars)
    if not noise.joint_cov:
        return rig
    return replace(rig, joint_cov=noise.joint_cov, backlash=noise.backlash, backlash_sigma=noise.backlash_sigma)


def check_against_rigs(noise: NoiseFile, rigs: Mapping[str, Rig] | Rig) -> None:
    """Raise RigError for a bar that no rig has: its sigma would silently do nothing."""
    known = {bar for rig in ([rigs] if isinstance(rigs, Rig) else rigs.values()) for bar in rig.bars}
    for bar in noise.bar_sigma:
        if bar not in known:
            raise RigError(
                f"{noise.name}: bar {bar!r} is not in the rig, which has {', '.join(sorted(known)) or 'none'}"
            )


def format_noise(noise: NoiseFile, remarks: list[str], prismatic: bool) -> str:
    """The text of a noise file, with remarks as comments at its head. ``prismatic``: some joint slides."""
    lines = [FIRST_LINE, *(f"# {remark}" for remark in remarks), ""]
    if noise.joint_cov and prismatic:
        lines.append(f"joint_cov_si = {matrix_text(noise.joint_cov)}")
    elif noise.joint_cov:
        lines.append(
            f"joint_sigma_rad = {numbers([noise.joint_cov[i][i] ** 0.5 for i in range(len(noise.joint_cov))])}"
        )
    if noise.backlash:
        lines += [f"backlash_si = {numbers(noise.backlash)}", f"backlash_sigma_si = {numbers(noise.backlash_sigma)}"]
    for bar, sigma in noise.bar_sigma.items():
        lines += ["", "[[bar]]", f"name = {json.dumps(bar)}", f"sigma_m = {sigma!r}"]
    return "\n".join(lines) + "\n"


def looks_like_noise(head: bytes) -> bool:
    """Whether a file that begins so is one that ``truearm characterize`` wrote, and so may write over."""
    return head.startswith(FIRST_LINE.encode())
