"""Rig files: TOML that describes the equipment around the robot (docs/reference/table-format.md).

The kinds of observation declare the entries that they use; the file is read and written by these declarations.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from truearm.disk import parse_toml, read_text, write_atomic
from truearm.errors import RigError
from truearm.kinds.registry import entries
from truearm.kinds.seat import Socket
from truearm.schema import Key, Sigmas, Table, keys_of, read, sigma, values_of
from truearm.types import Rig

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
