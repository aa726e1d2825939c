"""The file result.json as such: its format, its checksum and its layout (docs/reference/result-format.md).

The file is strict JSON (RFC 8259): a number that does not exist is ``null``, never NaN. It is written atomically. A
checksum over its content detects damage: a digit of a parameter altered by a disk fault or by hand would otherwise lead
to a wrong correction. ``result_document`` makes the content, ``stored_result`` reads it.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from truearm.files.disk import sha256, write_atomic

if TYPE_CHECKING:
    from truearm.model.chain import Chain

FORMAT = "truearm-result"
FORMAT_VERSION = 3
SINCE_CHECKSUM = 3  # version
CHECKSUM = "checksum"


class Input(NamedTuple):
    """An input file of an identification: its role, its name without folders, its SHA-256."""

    role: str  # "observations" | "rig" | "noise" | "robot"
    name: str
    sha256: str


def input_of(role: str, path: Path) -> Input:
    """Return the name and hash of an input file.

    Folders are omitted: they reveal where someone works, not what was read.
    """
    return Input(role, path.name.encode(errors="backslashreplace").decode(), sha256(path))


@dataclass(frozen=True)
class RobotFrames:
    """The identified chain: its name, frames, and joint units ("rad" or "m")."""

    name: str
    base_frame: str
    end_frame: str
    joint_units: tuple[str, ...]

    @classmethod
    def of(cls, chain: Chain) -> RobotFrames:
        """Return those of a chain."""
        return cls(chain.name, chain.base_frame, chain.end_frame, chain.joint_units)


def with_checksum(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of a result with its checksum as the last entry."""
    content = {name: value for name, value in document.items() if name != CHECKSUM}
    return {**content, CHECKSUM: checksum(content)}


def checksum(document: Mapping[str, Any]) -> str:
    """Return the SHA-256 of a result's content, independent of its layout. Raises ValueError for non-finite numbers."""
    content = {name: value for name, value in document.items() if name != CHECKSUM}
    digest = hashlib.sha256()
    for piece in _compact(content):
        digest.update(piece.encode())
    return digest.hexdigest()


def _compact(value: Any) -> Iterator[str]:
    """Yield JSON without spaces and with sorted keys, in pieces: a covariance with joint laws has many megabytes."""
    if not _is_nested(value):
        yield json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)
        return
    items = sorted(value.items()) if isinstance(value, dict) else [(None, item) for item in value]
    for k, (name, item) in enumerate(items):
        yield ("," if k else "{" if isinstance(value, dict) else "[") + ("" if name is None else json.dumps(name) + ":")
        yield from _compact(item)
    yield "}" if isinstance(value, dict) else "]"


def _is_nested(value: Any) -> bool:
    """Return whether a list or an object has further ones in it."""
    inner = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return any(issubclass(kind, dict | list) for kind in set(map(type, inner)))


def format_document(value: Any) -> str:
    """Return JSON with one line for each innermost list or object, so that a covariance has one line per row."""
    return "".join(_laid_out(value))


def _laid_out(value: Any, indent: int = 0) -> Iterator[str]:
    """Yield the text of ``format_document`` in pieces: with joint laws, all of it has many megabytes."""
    if not _is_nested(value):
        yield json.dumps(value, allow_nan=False)
        return
    pad = "\n" + " " * (indent + 2)
    items = value.items() if isinstance(value, dict) else [(None, item) for item in value]
    for k, (name, item) in enumerate(items):
        yield ("," if k else "{" if isinstance(value, dict) else "[") + pad
        if name is not None:
            yield json.dumps(name) + ": "
        yield from _laid_out(item, indent + 2)
    yield "\n" + " " * indent + ("}" if isinstance(value, dict) else "]")


def looks_like_result(head: bytes) -> bool:
    """Return whether a file with this beginning is a result, or empty."""
    return not head.strip() or (head.lstrip().startswith(b"{") and b'"truearm' in head)


def write_result(path: Path, document: Mapping[str, Any]) -> None:
    """Write result.json atomically. Raises InputError if it cannot be written there."""
    write_atomic(path, chain(_laid_out(dict(document)), "\n"))
