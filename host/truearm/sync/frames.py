"""The bytes of single messages → checked values. Files are strangers': each answer is None where something is amiss."""

from __future__ import annotations

import json
from typing import Any, NamedTuple

import cbor2

from truearm_wire import messages as wire

TAG_INT32 = 78
TAG_UINT16 = 69
MAX_PAYLOAD = 250
MAX_DEVICE_US = 2**53  # 285 years: beyond it nothing but a damaged or hostile file lies, and ns stay within 63 bits
MAX_HOST_NS = 2**62

_HEARTBEAT, _SYNC = -1, -2  # keys of the kinds of device time, beside the streams' ids


class Exchange(NamedTuple):
    """An answered clock request: host before write, device received, device sent, host arrival."""

    t0_ns: int
    t1_us: int
    t2_us: int
    t3_ns: int


def decode(payload: bytes) -> list[Any] | None:
    """The elements of a payload; None if it is not [type, seq, …]."""
    if len(payload) > MAX_PAYLOAD:
        return None
    try:
        frame = cbor2.loads(payload, max_depth=4, allow_indefinite=False)
    except cbor2.CBORError:
        return None
    if type(frame) is not list or len(frame) < 2 or type(frame[0]) is not int or type(frame[1]) is not int:
        return None
    return frame if 0 <= frame[1] < 2**32 else None


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
        document = json.loads(data)
    except (ValueError, RecursionError):
        return None
    if not isinstance(document, dict):
        return None
    t0, t1, t2, t3 = (document.get(name) for name in ("t0_ns", "t1_us", "t2_us", "t3_ns"))
    host = type(t0) is int and type(t3) is int and abs(t0) < MAX_HOST_NS and abs(t3) < MAX_HOST_NS
    device = type(t1) is int and type(t2) is int and 0 <= t1 < MAX_DEVICE_US and 0 <= t2 < MAX_DEVICE_US
    return Exchange(t0, t1, t2, t3) if host and device else None  # type: ignore[arg-type]


def device_time(frame: list[Any]) -> tuple[int, int] | None:
    """The kind of device time and its value, of a data, heartbeat or sync frame."""
    place = {wire.DATA: 4, wire.HEARTBEAT: 3, wire.SYNC_REPLY: 3}[frame[0]]
    if len(frame) <= place or type(frame[place]) is not int or type(frame[2]) is not int:
        return None
    if not 0 <= frame[place] < MAX_DEVICE_US:
        return None
    return {wire.DATA: frame[2], wire.HEARTBEAT: _HEARTBEAT, wire.SYNC_REPLY: _SYNC}[frame[0]], frame[place]


def is_data(frame: list[Any]) -> bool:
    if len(frame) < 8:
        return False
    _, _, stream, n0, t0_us, timing, samples, flags = frame[:8]
    if not (type(stream) is type(n0) is type(t0_us) is type(flags) is int and min(stream, n0, flags) >= 0):
        return False
    timed = 0 < timing < 2**32 if type(timing) is int else _is_array(timing, TAG_UINT16)
    return 0 <= t0_us < MAX_DEVICE_US and n0 < 2**62 and timed and _is_array(samples, TAG_INT32)


def _is_array(value: object, tag: int) -> bool:
    return isinstance(value, cbor2.CBORTag) and value.tag == tag and type(value.value) is bytes
