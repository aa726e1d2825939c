"""Decode and check the frames of a box (protocol/SPEC.md §4, §5) as a table: one row per frame, in order of arrival.

Nearly all frames are data and sync replies, whose heads have a fixed layout (protocol/frames.cddl). NumPy reads these in
one pass. All others are decoded singly and keep their elements.

The recorder uses the functions for single frames too. Files are untrusted: each of these returns None if its input is invalid.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import cbor2
import msgspec
import numpy as np
from numpy.typing import NDArray

from truearm.session.session_file import LATEST_NS, Messages, heads
from truearm.types import Ints
from truearm_wire import messages as wire
from truearm_wire.messages import PAGE_BYTES, PAGES_MAX

TAG_INT32 = 78
MAX_PAYLOAD = 250
MAX_DEVICE_US = 2**53  # 285 years: a later time comes from a damaged or hostile file, and ns still fit 63 bits
MAX_N0 = 2**62


class Data(NamedTuple):
    """A data frame; ``samples`` are int32."""

    seq: int
    stream: int
    n0: int
    t0_us: int
    period_ns: int
    samples: bytes
    flags: int


def data_of(frame: list[Any]) -> Data:
    """Return the elements of a data frame that conforms."""
    _, seq, stream, n0, t0_us, period_ns, samples, flags = frame[:8]
    return Data(seq, stream, n0, t0_us, period_ns, samples.value, flags)


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
    return frame if 0 <= frame[0] < 256 and 0 <= frame[1] < 2**32 else None


# The key "boot_id" and its unsigned integer in an ident, of which the first page has only a part.
_BOOT_ID = re.compile(rb"\x67boot_id(?:([\x00-\x17])|\x18(.)|\x19(..)|\x1a(....))", re.DOTALL)

# Of elements; all others are integers
_TYPES: dict[str, type] = {"data": bytes, "text": str, "samples": cbor2.CBORTag}
_RANGES = {
    **dict.fromkeys(("t_us", "t0_us", "t1_us", "t2_us"), range(MAX_DEVICE_US)),
    **dict.fromkeys(("stream", "n0", "flags"), range(MAX_N0)),
    **{"boot_id": range(2**32), "period_ns": range(1, 2**32)},
}
_INT64 = range(-(2**63), 2**63)  # of all other integers
# By type of a frame: the types of its elements, and the index and range of the integers.
_ELEMENTS = {
    kind: (
        [_TYPES.get(name, int) for name in wire.names(kind)],
        [(k, _RANGES.get(name, _INT64)) for k, name in enumerate(wire.names(kind), start=1) if name not in _TYPES],
    )
    for kind in wire.LAYOUT
}


def is_text(data: bytes) -> bool:
    """Return whether the bytes are text printed by a program rather than a damaged frame."""
    try:
        text = data.decode()
    except UnicodeDecodeError:
        return False
    return all(character.isprintable() or character.isspace() for character in text)


_HostTime = Annotated[int, msgspec.Meta(gt=-LATEST_NS, lt=LATEST_NS)]
_DeviceTime = Annotated[int, msgspec.Meta(ge=0, lt=MAX_DEVICE_US)]


class _SyncLine(msgspec.Struct, gc=False):
    t0_ns: _HostTime
    t1_us: _DeviceTime
    t2_us: _DeviceTime
    t3_ns: _HostTime


_read_exchange = msgspec.json.Decoder(_SyncLine).decode


def parse_exchange(data: bytes) -> tuple[int, ...] | None:
    """Parse a ``/sync`` message: times of host write, device receive, device send and host arrival.

    None if the request was not answered or the message is invalid.
    """
    try:
        return msgspec.structs.astuple(_read_exchange(data))
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return None


def is_echo(frame: list[Any]) -> bool:
    """Return whether a frame has a type that only a host sends (SPEC §6)."""
    return bool(frame[0] == wire.SYNC_REQUEST or 48 <= frame[0] < 64)


def conforms(frame: list[Any]) -> bool:
    """Return whether a frame of a known type has the elements that the specification demands, within bounds.

    Frames of other types conform. A box with a newer minor version may append elements.
    """
    kind = frame[0]
    if kind not in wire.LAYOUT:
        return True
    types, ranges = _ELEMENTS[kind]
    if len(frame) <= wire.needed(kind) or list(map(type, frame[1 : len(types) + 1])) != types[: len(frame) - 1]:
        return False
    is_samples = kind != wire.DATA or (frame[6].tag == TAG_INT32 and type(frame[6].value) is bytes)
    return is_samples and all(frame[k] in allowed for k, allowed in ranges if k < len(frame))


def fields_of(kind: int, payload: bytes) -> dict[str, Any] | None:
    """Return the elements of a frame by name; None if it is not of this kind, or violates the specification."""
    frame = decode(payload)
    return None if frame is None or frame[0] != kind else named_elements(frame)


def named_elements(frame: list[Any]) -> dict[str, Any] | None:
    """Return the elements of a frame by name; None if its type is not known, or it violates the specification."""
    if frame[0] not in wire.LAYOUT or not conforms(frame):
        return None
    return dict(zip(wire.names(frame[0]), frame[1:], strict=False))


def is_boot(frame: list[Any]) -> bool:
    """Return whether a frame is the first page of the ident that a box sends unprompted at boot (SPEC §5: req_id 0)."""
    return frame[0] == wire.IDENT and frame[2:4] == [0, 0]


def boot_id(frame: list[Any]) -> int:
    """Return the boot id that a heartbeat or the first page of an ident states; NONE for other frames."""
    if frame[0] == wire.HEARTBEAT:
        return int(frame[2])
    match = _BOOT_ID.search(frame[5]) if frame[0] == wire.IDENT and frame[3] == 0 else None
    return NONE if match is None else int.from_bytes(match[1] or match[2] or match[3] or match[4])


class Pages:
    """Joins the pages of one document at a time, within the size limits of the specification.

    Page 0 begins a document. A page that is not the next one of it discards it.
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
        if self._key != (req_id, pages) or page != len(self._parts):
            self._key = None
            return None
        self._parts.append(data)
        if len(self._parts) < pages:
            return None
        self._key = None
        return b"".join(self._parts)


NONE = -1  # of a frame without this element
_OF_ALL = ["message", "seq", "type", "boot_id"]
_OF_DATA = ["t_us", "stream", "n0", "period_ns", "flags", "samples_bytes"]
_OF_ACCOUNT = ["lost", "n", "run"]
FRAME = np.dtype([*((name, np.int64) for name in (*_OF_ALL, *_OF_DATA, *_OF_ACCOUNT)), ("gap", np.bool_)])

_BEGIN = [("begin", "u1"), ("type", "u1"), ("m_seq", "u1"), ("seq", ">u4"), ("stream", "u1")]
_TIMES = [("m_n0", "u1"), ("n0", ">u8"), ("m_t0", "u1"), ("t_us", ">u8"), ("m_p", "u1"), ("period_ns", ">u4")]
_DATA = np.dtype([*_BEGIN, *_TIMES, ("tag", "3u1"), ("size", "u1")])
_DATA_TAG = np.array([0xD8, 0x4E, 0x58], np.uint8)
_SYNC = np.dtype([("begin", "4u1"), ("seq", ">u4")])
_SYNC_BEGIN = np.array([0x85, 0x18, wire.SYNC_REPLY, 0x1A], np.uint8)
_SYNC_BYTES = (27, 28, 29, 31)  # by the width of the request's number
_UINT32, _UINT64 = 0x1A, 0x1B  # CBOR: an unsigned integer of this many bits follows


@dataclass(frozen=True, eq=False)
class Frames:
    """The frames (f,) in a batch of messages, which may follow frames of earlier ones. Messages that are not frames are left out.

    ``table`` (f,) of FRAME; ``message`` is an index in the batch. ``lost``, ``n``, ``run`` and ``gap`` are for ``streams``
    to fill in. ``contents``: the samples of each data frame, and the
    elements of each other frame that was decoded singly.
    The type of a frame that violates the specification is NONE; ``malformed`` counts these and the messages that are not
    frames.
    """

    table: NDArray[Any]
    contents: list[Any]
    malformed: int = 0

    def followed_by(self, later: Frames) -> Frames:
        """Return these frames, then all of ``later``."""
        return Frames(np.concatenate([self.table, later.table]), self.contents + later.contents, later.malformed)


NO_FRAMES = Frames(np.empty(0, FRAME), [])


def frames_of(messages: Messages) -> Frames:
    """Return the frames among the messages of a box."""
    rows = messages.rows(lambda topic: topic.startswith("/box/") and topic != "/box/console")
    begin, end = messages.begin[rows], messages.end[rows]
    table = np.full(len(rows), NONE, FRAME)
    table["message"] = rows
    usual = _usual_data(messages, begin, end, table) | _usual_syncs(messages, begin, end, table)
    first = begin + _DATA.itemsize
    places = zip(first.tolist(), (first + table["samples_bytes"]).tolist(), strict=True)
    contents: list[Any] = [messages.data[a:b] for a, b in places]
    is_frame = np.ones(len(rows), bool)
    for k in np.flatnonzero(~usual).tolist():
        frame = decode(messages.payload(int(rows[k])))
        if frame is None or is_echo(frame):
            is_frame[k] = False
            continue
        contents[k], table["seq"][k] = frame, frame[1]
        if not conforms(frame):
            continue
        table["type"][k], table["boot_id"][k] = frame[0], boot_id(frame)
        if frame[0] == wire.DATA:
            data = data_of(frame)
            contents[k] = data.samples
            table[_OF_DATA][k] = data.t0_us, data.stream, data.n0, data.period_ns, data.flags, len(data.samples)
    malformed = int(np.count_nonzero(table["type"] == NONE))
    return Frames(table[is_frame], [contents[k] for k in np.flatnonzero(is_frame).tolist()], malformed)


def _usual_data(messages: Messages, begin: Ints, end: Ints, table: NDArray[Any]) -> NDArray[np.bool_]:
    """Enter the data frames of the usual layout in the table; return which messages they are."""
    head, size = heads(messages.data, begin, _DATA), end - begin
    usual = (head["begin"] == 0x88) & (head["type"] == wire.DATA) & (head["m_seq"] == _UINT32)
    usual &= (head["m_n0"] == _UINT64) & (head["m_t0"] == _UINT64) & (head["m_p"] == _UINT32)
    usual &= np.all(head["tag"] == _DATA_TAG, axis=1) & (size <= MAX_PAYLOAD)
    usual &= (size > _DATA.itemsize) & (head["size"] == size - _DATA.itemsize - 1)
    usual &= (head["stream"] < 24) & (head["period_ns"] > 0) & (head["t_us"] < MAX_DEVICE_US) & (head["n0"] < MAX_N0)
    flags = np.frombuffer(messages.data, np.uint8)[np.maximum(end - 1, 0)]
    usual &= flags < 24
    for name in ("seq", "type", "t_us", "stream", "n0", "period_ns"):
        table[name][usual] = head[name][usual]
    table["flags"][usual], table["samples_bytes"][usual] = flags[usual], head["size"][usual]
    return np.asarray(usual)


def _usual_syncs(messages: Messages, begin: Ints, end: Ints, table: NDArray[Any]) -> NDArray[np.bool_]:
    """Enter the sync replies of the usual layout in the table; return which messages they are.

    Their times are those of the exchange on ``/sync``.
    """
    head = heads(messages.data, begin, _SYNC)
    usual = np.all(head["begin"] == _SYNC_BEGIN, axis=1) & np.isin(end - begin, _SYNC_BYTES)
    table["seq"][usual], table["type"][usual] = head["seq"][usual], wire.SYNC_REPLY
    return np.asarray(usual)
