"""Rig files: TOML that describes the equipment around the robot (docs/reference/table-format.md); and noise files.

The kinds of observation declare the entries that they use; a rig is read and written by these declarations.

A noise file has the noise of a robot and a bar from ``truearm characterize``, for ``truearm identify --noise``, in keys
of a rig file: ``joint_sigma_rad`` or ``joint_cov_si`` for the joint readings, and ``[[bar]]`` entries with a name and
its ``sigma``. They replace those of the rig. ``backlash_si`` and ``backlash_sigma_si`` are for the joints.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

from truearm.disk import parse_toml, read_text, write_atomic
from truearm.errors import RigError
from truearm.kinds.registry import entries
from truearm.kinds.rig_entries import NAME, by_name
from truearm.kinds.seat import Socket
from truearm.schema import Entries, Key, Matrix, SchemaError, Sigmas, Table, keys_of, read, sigma, values_of
from truearm.types import SIZE, Rig, Rigs, rigs_by_name

MAX_BYTES = 2**20
OF_RIG = values_of(Rig)
FURTHER = ("joint_cov", "backlash", "backlash_sigma")  # in other keys, or in noise files
JOINT_COVARIANCE = (
    Key("joint_cov_si", OF_RIG["joint_cov"], optional=True, field="joint_cov"),
    Key("joint_sigma", Sigmas(sigma("rad")), optional=True, field="joint_cov"),
)


def _rig(sockets: Mapping[tuple[str, str], Socket] | None = None, **values: Any) -> Rig:
    kind_entries = {key: values.pop(key) for key in tuple(values) if key not in Rig.__dataclass_fields__}
    return Rig(sockets={key: socket.point for key, socket in (sockets or {}).items()}, entries=kind_entries, **values)


def _values(rig: Rig) -> dict[str, Any]:
    sockets = {key: Socket(point, key[0]) for key, point in rig.sockets.items()}
    return {**vars(rig), **rig.entries, "sockets": sockets}


def _table() -> Table[Rig]:
    keys = (key for key in keys_of(Rig) if key.name not in FURTHER)
    return Table((*keys, *JOINT_COVARIANCE), _rig, _values, entries())


def read_rig(path: Path) -> Rig:
    """Read a rig file. Raises RigError that names the file, the entry and the key."""
    return parse_rig(read_text(path, MAX_BYTES, RigError), str(path))


def parse_rig(text: str, name: str) -> Rig:
    """Parse the text of a rig file; ``name`` stands for the file in messages. See ``read_rig``."""
    return read(_table(), parse_toml(text, name, RigError), name, RigError)


def format_rig(rig: Rig) -> str:
    """Return the text of a rig file, in metres so that numbers are stored bit for bit."""
    return _table().format(rig)


def write_rig(path: Path, rig: Rig) -> None:
    """Write a rig file that ``read_rig`` reads back exactly. Raises InputError."""
    write_atomic(path, format_rig(rig))


# ---------------------------------------------------------------------------------------------------------- noise files

MAX_NOISE_BYTES = 2**16
FIRST_LINE = "# noise of a robot and its ball-bar, by truearm characterize"
BACKLASH = (
    Key("backlash_si", OF_RIG["backlash"], optional=True, field="backlash"),
    Key("backlash_sigma_si", OF_RIG["backlash_sigma"], optional=True, field="backlash_sigma"),
)


@dataclass(frozen=True)
class NoiseFile:
    """``joint_cov`` S_q [rad², m²], empty for none.

    ``bar_sigma`` [m] by the bar's name; ``name`` of the file, for messages.

    ``backlash`` and its sigma [rad, m]: as in a Rig.
    """

    joint_cov: Matrix = ()
    bar_sigma: Mapping[str, float] = field(default_factory=dict)
    name: str = "noise"
    backlash: tuple[float, ...] = ()
    backlash_sigma: tuple[float, ...] = ()


class BarSigma(NamedTuple):
    """The standard deviation [m] of a bar's dwells."""

    name: str
    sigma: float


def _noise(bars: Mapping[str, BarSigma] | None = None, **values: Any) -> NoiseFile:
    """Raise SchemaError unless backlash and its sigmas are given together, one of each for every joint.

    The joints are those of the covariance.
    """
    noise = NoiseFile(bar_sigma={name: bar.sigma for name, bar in (bars or {}).items()}, **values)
    cov, width, width_sigma = noise.joint_cov, noise.backlash, noise.backlash_sigma
    if (width or width_sigma) and not cov:
        raise SchemaError("backlash_si needs joint_sigma_rad or joint_cov_si, which must include half of it")
    for key, widths in zip(BACKLASH, (width, width_sigma), strict=True):
        if (width or width_sigma) and len(widths) != len(cov):
            joints = f"{len(cov)} value{'s' * (len(cov) != 1)}"
            raise SchemaError(f"{key.name}: needs a list of {joints}, one per joint, has {len(widths)}")
    for j, b in enumerate(width):
        if 0.25 * b**2 > cov[j][j] * (1.0 + 1e-9):
            raise SchemaError(f"joint {j + 1} has a sigma below half its backlash; the sigma must include the backlash")
    return noise


def _noise_values(noise: NoiseFile) -> dict[str, Any]:
    return {**vars(noise), "bars": tuple(BarSigma(*bar) for bar in noise.bar_sigma.items())}


BARS = Entries("bar", Table((NAME, Key("sigma", SIZE)), BarSigma, BarSigma._asdict), "bars", by_name)
NOISE = Table((*JOINT_COVARIANCE, *BACKLASH), _noise, _noise_values, (BARS,))


def read_noise(path: Path) -> NoiseFile:
    """Read a noise file. Raises RigError that names the file, the entry and the key."""
    return parse_noise(read_text(path, MAX_NOISE_BYTES, RigError), str(path))


def parse_noise(text: str, name: str) -> NoiseFile:
    """Parse the text of a noise file; ``name`` stands for the file in messages."""
    return replace(read(NOISE, parse_toml(text, name, RigError), name, RigError), name=name)


def with_noise(rig: Rig, noise: NoiseFile | None) -> Rig:
    """Return the rig with the values of the noise file in place of its own; other values are kept."""
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


def check_against_rigs(noise: NoiseFile, rigs: Rigs) -> None:
    """Raise RigError for a bar that no rig has: its sigma would have no effect."""
    bars = {bar for rig in rigs_by_name(rigs).values() for bar in rig.bars}
    for bar in noise.bar_sigma:
        if bar not in bars:
            raise RigError("not-in-rig", place=noise.name, what="bar", name=bar, names=sorted(bars))


def format_noise(noise: NoiseFile, remarks: list[str], prismatic: bool) -> str:
    """Return the text of a noise file that begins with ``remarks``. ``prismatic``: some joint is prismatic."""
    head = "".join(f"{line}\n" for line in [FIRST_LINE, *(f"# {remark}" for remark in remarks), ""])
    covariance, sigmas = JOINT_COVARIANCE
    keys = (covariance if prismatic else sigmas, *BACKLASH)
    return head + replace(NOISE, keys=keys).format(noise)
