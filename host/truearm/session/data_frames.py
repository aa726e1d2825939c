"""Data frames of a box (protocol/SPEC.md §4) → checked values; for the recorder, and for everything that reads a session.

Files are strangers': each answer is None where something is amiss.
"""

from __future__ import annotations

import struct
from typing import Any, NamedTuple

import cbor2

TAG_INT32 = 78
TAG_UINT16 = 69
MAX_PAYLOAD = 250
MAX_DEVICE_US = 2**53  # 285 years: beyond it nothing but a damaged or hostile file lies, and ns stay within 63 bits
MAX_N0 = 2**62
_FRAMES_PER_NS = 20_000e-9  # fifty times what the fastest box sends
_FRAMES_AT_ONCE = 1000  # of a link that delivers late

# A data frame as the box writes it: array(8), type, seq, stream < 24, n0, t0_us, period_ns, tag 78, byte string of 24 … 255.
_USUAL = struct.Struct(">3sIBBQBQBI3sB")
_USUAL_MARKS = (b"\x88\x10\x1a", 0x1B, 0x1B, 0x1A, b"\xd8\x4e\x58")


class Data(NamedTuple):
    """A data frame. ``period_ns`` 0: ``offsets_us`` holds uint16, one a sample."""

    seq: int
    stream: int
    n0: int
    t0_us: int
    period_ns: int
    offsets_us: bytes
    samples: bytes
    flags: int


def usual_data(payload: bytes) -> Data | None:
    """A data frame of the usual layout, without a CBOR decoder: nine of ten frames are such, 0.8 µs instead of 1.8 µs.

    None for all others, which ``decode`` and ``data_of`` then judge; the answer is the same (a test holds it).
    """
    if len(payload) < _USUAL.size + 1 or len(payload) > MAX_PAYLOAD:
        return None
    begin, seq, stream, m_n0, n0, m_t0, t0_us, m_period, period_ns, tag, size = _USUAL.unpack_from(payload)
    flags = payload[-1]
    usual = (begin, m_n0, m_t0, m_period, tag) == _USUAL_MARKS and size == len(payload) - _USUAL.size - 1
    if not usual or stream > 23 or flags > 23 or not period_ns or t0_us >= MAX_DEVICE_US or n0 >= MAX_N0:
        return None
    return Data(seq, stream, n0, t0_us, period_ns, b"", payload[_USUAL.size : -1], flags)


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


def data_of(frame: list[Any]) -> Data | None:
    """A decoded data frame, checked."""
    if len(frame) < 8:
        return None
    _, seq, stream, n0, t0_us, timing, samples, flags = frame[:8]
    if not (type(stream) is type(n0) is type(t0_us) is type(flags) is int and min(stream, n0, flags) >= 0):
        return None
    if not (0 <= t0_us < MAX_DEVICE_US and n0 < MAX_N0 and _is_array(samples, TAG_INT32)):
        return None
    if type(timing) is int and 0 < timing < 2**32:
        return Data(seq, stream, n0, t0_us, timing, b"", samples.value, flags)
    if _is_array(timing, TAG_UINT16):
        return Data(seq, stream, n0, t0_us, 0, timing.value, samples.value, flags)
    return None


def too_many(lost: int, elapsed_ns: int) -> bool:
    """Whether more frames would be lost than any link carries in the host's time between two of them: the count is not to be believed."""
    return lost > _FRAMES_AT_ONCE + _FRAMES_PER_NS * max(0, elapsed_ns)


def _is_array(value: object, tag: int) -> bool:
    return isinstance(value, cbor2.CBORTag) and value.tag == tag and type(value.value) is bytes
