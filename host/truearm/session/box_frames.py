"""Decode and check single frames of a box (protocol/SPEC.md §4, §5).

Data, clock exchanges, and documents joined from their pages; ``frames`` decodes the usual frames of a batch at
once. The recorder uses this file too. Files are untrusted: each function returns None if its input is invalid.
"""

from __future__ import annotations

import re
from typing import Annotated, Any, NamedTuple

import cbor2
import msgspec

from truearm_wire import messages as wire
from truearm_wire.messages import PAGE_BYTES, PAGES_MAX

TAG_INT32 = 78
TAG_UINT16 = 69
MAX_PAYLOAD = 250
MAX_DEVICE_US = 2**53  # 285 years: a later time comes from a damaged or hostile file, and ns still fit 63 bits
MAX_N0 = 2**62
_FRAMES_PER_NS = 20_000e-9  # fifty times what the fastest box sends
_FRAMES_AT_ONCE = 1000  # on a link that delivers late


class Data(NamedTuple):
    """A data frame. If ``period_ns`` is 0, ``offsets_us`` holds one uint16 per sample."""

    seq: int
    stream: int
    n0: int
    t0_us: int
    period_ns: int
    offsets_us: bytes
    samples: bytes
    flags: int


def data_frame(payload: bytes) -> Data | None:
    """Decode a data frame; None if it is not a data frame."""
    frame = decode(payload)
    return None if frame is None or frame[0] != wire.DATA else data_of(frame)


def decode(payload: bytes) -> list[Any] | None:
    """Return the elements of a payload; None if it is not [type, seq, …]."""
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
    """Check a decoded data frame and return it; None if it is invalid."""
    if len(frame) < 8:
        return None
    _, seq, stream, n0, t0_us, timing, samples, flags = frame[:8]
    if not (type(stream) is type(n0) is type(t0_us) is type(flags) is int and min(stream, n0, flags) >= 0):
        return None
    if not (0 <= t0_us < MAX_DEVICE_US and max(stream, n0, flags) < MAX_N0 and _is_array(samples, TAG_INT32)):
        return None
    if type(timing) is int and 0 < timing < 2**32:
        return Data(seq, stream, n0, t0_us, timing, b"", samples.value, flags)
    if _is_array(timing, TAG_UINT16):
        return Data(seq, stream, n0, t0_us, 0, timing.value, samples.value, flags)
    return None


def too_many(lost: int, elapsed_ns: int) -> bool:
    """Return whether more frames would be lost than any link can carry in the host time between two frames.

    If so, the count cannot be trusted.
    """
    return lost > _FRAMES_AT_ONCE + _FRAMES_PER_NS * max(0, elapsed_ns)


def _is_array(value: object, tag: int) -> bool:
    return isinstance(value, cbor2.CBORTag) and value.tag == tag and type(value.value) is bytes


MAX_HOST_NS = 2**62

# The key "boot_id" and its unsigned integer in an ident, of which the first page has only a part.
_BOOT_ID = re.compile(rb"\x67boot_id(?:([\x00-\x17])|\x18(.)|\x19(..)|\x1a(....))", re.DOTALL)

_TYPES: dict[str, type] = {"data": bytes, "text": str}  # of elements; all others are integers
_BOUNDS = dict.fromkeys(("t_us", "t1_us", "t2_us"), MAX_DEVICE_US) | {"boot_id": 2**32}
# By type of a frame: the types of its elements, and the index and limit of those that have one.
_ELEMENTS = {
    kind: (
        [_TYPES.get(name, int) for name in wire.names(kind)],
        [(k, _BOUNDS[name]) for k, name in enumerate(wire.names(kind), start=1) if name in _BOUNDS],
    )
    for kind in wire.LAYOUT
}


class Exchange(NamedTuple):
    """An answered clock request: times of host write, device receive, device send and host arrival."""

    t0_ns: int
    t1_us: int
    t2_us: int
    t3_ns: int


def is_text(data: bytes) -> bool:
    """Return whether the bytes are text printed by a program rather than a damaged frame."""
    try:
        text = data.decode()
    except UnicodeDecodeError:
        return False
    return all(character.isprintable() or character.isspace() for character in text)


_HostTime = Annotated[int, msgspec.Meta(gt=-MAX_HOST_NS, lt=MAX_HOST_NS)]
_DeviceTime = Annotated[int, msgspec.Meta(ge=0, lt=MAX_DEVICE_US)]


class _SyncLine(msgspec.Struct, gc=False):
    t0_ns: _HostTime
    t1_us: _DeviceTime
    t2_us: _DeviceTime
    t3_ns: _HostTime


_read_exchange = msgspec.json.Decoder(_SyncLine).decode


def parse_exchange(data: bytes) -> Exchange | None:
    """Parse a ``/sync`` message; None if the request was not answered or the message is invalid."""
    try:
        line = _read_exchange(data)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return None
    return Exchange(line.t0_ns, line.t1_us, line.t2_us, line.t3_ns)


def is_echo(frame: list[Any]) -> bool:
    """Return whether a frame has a type that only a host sends (SPEC §6)."""
    return bool(frame[0] == wire.SYNC_REQUEST or 48 <= frame[0] < 64)


def conforms(frame: list[Any]) -> bool:
    """Return whether a frame of a known type has the elements that the specification demands, within bounds.

    Frames of other types conform. A box with a newer minor version may append elements.
    """
    kind = frame[0]
    if kind == wire.DATA:
        return data_of(frame) is not None
    if kind not in wire.LAYOUT:
        return True
    types, limits = _ELEMENTS[kind]
    whole = len(frame) > wire.needed(kind) and list(map(type, frame[1 : len(types) + 1])) == types[: len(frame) - 1]
    return whole and all(0 <= frame[k] < limit for k, limit in limits)


def fields_of(kind: int, payload: bytes) -> dict[str, Any] | None:
    """Return the elements of a frame by name; None if it is not of this kind, or violates the specification."""
    frame = decode(payload)
    if frame is None or frame[0] != kind or kind not in wire.LAYOUT or not conforms(frame):
        return None
    return dict(zip(wire.names(kind), frame[1:], strict=False))


def is_boot(frame: list[Any]) -> bool:
    """Return whether a frame is the first page of the ident that a box sends unprompted at boot (SPEC §5: req_id 0)."""
    return frame[0] == wire.IDENT and frame[2:4] == [0, 0]


def boot_id(frame: list[Any]) -> int | None:
    """Return the boot id that a heartbeat or the first page of an ident states; None for other frames."""
    if frame[0] == wire.HEARTBEAT and len(frame) > 2:
        return frame[2] if type(frame[2]) is int else None
    if frame[0] == wire.IDENT and len(frame) > 5 and frame[3] == 0 and type(frame[5]) is bytes:
        found = _BOOT_ID.search(frame[5])
        return None if found is None else int.from_bytes(found[1] or found[2] or found[3] or found[4])
    return None


class Pages:
    """Joins the pages of one document at a time, within the size limits of the specification.

    Page 0 begins a document and discards an unfinished one. Repeated pages and pages of another document are ignored. A
    page that contradicts an earlier one or arrives out of order discards the document.
    """

    def __init__(self) -> None:
        self._key: tuple[int, int] | None = None  # req_id and number of pages of the document being joined
        self._parts: list[bytes] = []

    def push(self, req_id: int, page: int, pages: int, data: bytes) -> bytes | None:
        """Return the document if this page completes it, else None."""
        if not 0 <= page < pages <= PAGES_MAX or len(data) > PAGE_BYTES:
            return None
        if page == 0:
            self._key, self._parts = (req_id, pages), []
        if self._key != (req_id, pages) or self._parts[page : page + 1] == [data]:
            return None
        if page != len(self._parts):
            self._key = None
            return None
        self._parts.append(data)
        if len(self._parts) < pages:
            return None
        self._key = None
        return b"".join(self._parts)
