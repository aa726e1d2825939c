"""Access the elements of the box's frames by name, checked. Data frames have their own reader (session/box_frames.py)."""

from __future__ import annotations

from typing import Any

from truearm.session.box_frames import decode
from truearm_wire.messages import ERROR, EVENT, HEARTBEAT, IDENT, REPLY, SYNC_REPLY, names, needed

_NAMES = {kind: names(kind) for kind in (EVENT, HEARTBEAT, IDENT, SYNC_REPLY, REPLY, ERROR)}


def fields_of(kind: int, payload: bytes) -> dict[str, Any] | None:
    """Return the elements of a frame by name.

    None if one is missing or has a type other than in SPEC §4, or if there is no such kind of frame.
    """
    values = decode(payload) if kind in _NAMES else None
    if values is None:
        return None
    fields = dict(zip(_NAMES[kind], values[1:], strict=False))
    if len(fields) < needed(kind) or not all(_fits(name, value) for name, value in fields.items()):
        return None
    return fields


def _fits(name: str, value: Any) -> bool:
    if name == "data":
        return isinstance(value, bytes)
    if name == "text":
        return isinstance(value, str)
    return type(value) is int and abs(value) < 2**64
