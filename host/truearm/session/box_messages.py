"""The box's smaller messages → checked values (data frames: session/data_frames.py). Files are strangers': each answer is None
where something is amiss.
"""

from __future__ import annotations

import json
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.session.data_frames import MAX_DEVICE_US
from truearm_wire import messages as wire

MAX_HOST_NS = 2**62

_TIME_AT = {wire.DATA: 4, wire.HEARTBEAT: 3, wire.SYNC_REPLY: 3}  # where a frame has its device time


class Exchange(NamedTuple):
    """An answered clock request: host before write, device received, device sent, host arrival."""

    t0_ns: int
    t1_us: int
    t2_us: int
    t3_ns: int


def is_text(data: bytes) -> bool:
    """Whether bytes are text that a program printed rather than a damaged frame."""
    try:
        text = data.decode()
    except UnicodeDecodeError:
        return False
    return all(character.isprintable() or character.isspace() for character in text)


def parse_exchange(data: bytes) -> Exchange | None:
    """A ``/sync`` message; None if it was not answered (or is no such message, which answers nothing either)."""
    try:
        return _exchange(json.loads(data))
    except (ValueError, RecursionError):
        return None


def parse_exchanges(lines: list[bytes]) -> tuple[NDArray[np.intp], NDArray[np.int64]]:
    """Which of several ``/sync`` messages were answered, and their times (k, 4)."""
    try:
        documents = json.loads(b"[" + b",".join(lines) + b"]")
    except (ValueError, RecursionError):
        documents = []
    whole = len(documents) == len(lines)
    found = [_exchange(document) for document in documents] if whole else [parse_exchange(line) for line in lines]
    answered = np.array([i for i, one in enumerate(found) if one is not None], dtype=np.intp)
    return answered, np.array([one for one in found if one is not None], dtype=np.int64).reshape(-1, 4)


def _exchange(document: Any) -> Exchange | None:
    if not isinstance(document, dict):
        return None
    t0, t1, t2, t3 = (document.get(name) for name in ("t0_ns", "t1_us", "t2_us", "t3_ns"))
    host = type(t0) is int and type(t3) is int and abs(t0) < MAX_HOST_NS and abs(t3) < MAX_HOST_NS
    device = type(t1) is int and type(t2) is int and 0 <= t1 < MAX_DEVICE_US and 0 <= t2 < MAX_DEVICE_US
    return Exchange(t0, t1, t2, t3) if host and device else None  # type: ignore[arg-type]


def is_echo(frame: list[Any]) -> bool:
    """Whether a frame is of a type that only a host sends (SPEC §6)."""
    return bool(frame[0] == wire.SYNC_REQUEST or 48 <= frame[0] < 64)


def device_time(frame: list[Any]) -> tuple[int, int] | None:
    """The kind of device time (a stream's id, or a negative number) and its value, of a frame that has one."""
    kind = frame[0]
    if kind not in _TIME_AT or len(frame) <= _TIME_AT[kind]:
        return None
    stream, value = frame[2], frame[_TIME_AT[kind]]
    if type(value) is not int or not 0 <= value < MAX_DEVICE_US:
        return None
    if kind == wire.DATA:
        return (stream, value) if type(stream) is int and stream >= 0 else None
    return -kind, value


def is_boot(frame: list[Any]) -> bool:
    """Whether a frame is the first page of the ident that a box sends unasked at boot (SPEC §5: req_id 0)."""
    return frame[0] == wire.IDENT and frame[2:4] == [0, 0]


def boot_id(frame: list[Any]) -> int | None:
    """The boot that a heartbeat is of; None for other frames."""
    return frame[2] if frame[0] == wire.HEARTBEAT and len(frame) > 2 and type(frame[2]) is int else None
