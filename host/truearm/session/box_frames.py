"""Decode and check the frames of a box (protocol/SPEC.md §4, §5), singly or as columns of a batch.

Nearly all frames are data, heartbeats and sync replies, which have a fixed header layout (protocol/frames.cddl).
``frames_of()`` reads these in one pass. It applies the same tests as for a single payload; a payload that fails them is
decoded singly. Consecutive frames without anything unusual form a **run**, which is accounted for as a unit. Every
other frame is a run of its own.

The functions for single frames decode data, clock exchanges, and documents joined from their pages. The recorder uses
them too. Files are untrusted: each function returns None if its input is invalid.
"""

from __future__ import annotations

import json
import re
import struct
from bisect import bisect_left
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import cbor2
import numpy as np
from numpy.typing import NDArray

from truearm.session.message_columns import Ints, Messages, heads
from truearm_wire import messages as wire
from truearm_wire.messages import PAGE_BYTES, PAGES_MAX

TAG_INT32 = 78
TAG_UINT16 = 69
MAX_PAYLOAD = 250
MAX_DEVICE_US = 2**53  # 285 years: a later time comes from a damaged or hostile file, and ns still fit 63 bits
MAX_N0 = 2**62
MAX_STREAM = 2**62
_FRAMES_PER_NS = 20_000e-9  # fifty times what the fastest box sends
_FRAMES_AT_ONCE = 1000  # on a link that delivers late

# A data frame as the box writes it: array(8), type, seq, stream < 24, n0, t0_us, period_ns, tag 78, byte string of 24 … 255.
_USUAL = struct.Struct(">3sIBBQBQBI3sB")
_USUAL_MARKS = (b"\x88\x10\x1a", 0x1B, 0x1B, 0x1A, b"\xd8\x4e\x58")


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


def usual_data(payload: bytes) -> Data | None:
    """Decode a data frame of the usual layout without a CBOR decoder.

    Nine out of ten frames have this layout; decoding takes 0.8 µs instead of 1.8 µs. Returns None for all others, which
    ``decode`` and ``data_of`` then check. Both ways give the same result (there is a test for it).
    """
    if len(payload) < _USUAL.size + 1 or len(payload) > MAX_PAYLOAD:
        return None
    begin, seq, stream, m_n0, n0, m_t0, t0_us, m_period, period_ns, tag, size = _USUAL.unpack_from(payload)
    flags = payload[-1]
    usual = (begin, m_n0, m_t0, m_period, tag) == _USUAL_MARKS and size == len(payload) - _USUAL.size - 1
    if not usual or stream > 23 or flags > 23 or not period_ns or t0_us >= MAX_DEVICE_US or n0 >= MAX_N0:
        return None
    return Data(seq, stream, n0, t0_us, period_ns, b"", payload[_USUAL.size : -1], flags)


def data_frame(payload: bytes) -> Data | None:
    """Decode a data frame of any layout; None if it is not a data frame."""
    return usual_data(payload) or (None if (frame := decode(payload)) is None else data_of(frame))


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
    if not (0 <= t0_us < MAX_DEVICE_US and n0 < MAX_N0 and _is_array(samples, TAG_INT32)):
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

_TIME_AT = {wire.DATA: 4, wire.HEARTBEAT: 3, wire.SYNC_REPLY: 3}  # index of the device time in a frame


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


def parse_exchange(data: bytes) -> Exchange | None:
    """Parse a ``/sync`` message; None if the request was not answered or the message is invalid."""
    try:
        return _exchange(json.loads(data))
    except (ValueError, RecursionError):
        return None


def parse_exchanges(lines: list[bytes]) -> list[Exchange | None]:
    """Apply ``parse_exchange`` to each of several messages."""
    try:
        documents = json.loads(b"[" + b",".join(lines) + b"]")
    except (ValueError, RecursionError):
        documents = []
    whole = len(documents) == len(lines)
    return [_exchange(document) for document in documents] if whole else [parse_exchange(line) for line in lines]


def _exchange(document: Any) -> Exchange | None:
    if not isinstance(document, dict):
        return None
    t0, t1, t2, t3 = (document.get(name) for name in ("t0_ns", "t1_us", "t2_us", "t3_ns"))
    host = type(t0) is int and type(t3) is int and abs(t0) < MAX_HOST_NS and abs(t3) < MAX_HOST_NS
    device = type(t1) is int and type(t2) is int and 0 <= t1 < MAX_DEVICE_US and 0 <= t2 < MAX_DEVICE_US
    return Exchange(t0, t1, t2, t3) if host and device else None  # type: ignore[arg-type]


def is_echo(frame: list[Any]) -> bool:
    """Return whether a frame has a type that only a host sends (SPEC §6)."""
    return bool(frame[0] == wire.SYNC_REQUEST or 48 <= frame[0] < 64)


def device_time(frame: list[Any]) -> tuple[int, int] | None:
    """Return the kind of device time in a frame (a stream id, or a negative number) and its value.

    None if the frame has no device time.
    """
    kind = frame[0]
    if kind not in _TIME_AT or len(frame) <= _TIME_AT[kind]:
        return None
    stream, value = frame[2], frame[_TIME_AT[kind]]
    if type(value) is not int or not 0 <= value < MAX_DEVICE_US:
        return None
    if kind == wire.DATA:
        return (stream, value) if type(stream) is int and 0 <= stream < MAX_STREAM else None
    return -kind, value


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


# ---------------------------------------------------------------------------------------------------- frames as columns

NO_TIME = -1  # kind of a frame without device time
NO_BOOT = -1
CIRCLE = 2**32  # seq wraps here

_DATA = np.dtype(
    {
        "names": ["begin", "type", "mark", "seq", "stream", "m_n0", "n0", "m_t0", "t0", "m_p", "period", "tag", "size"],
        "formats": ["u1", "u1", "u1", ">u4", "u1", "u1", ">u8", "u1", ">u8", "u1", ">u4", "3u1", "u1"],
        "offsets": [0, 1, 2, 3, 7, 8, 9, 17, 18, 26, 27, 31, 34],
        "itemsize": 35,
    }
)
_DATA_TAG = np.array([0xD8, 0x4E, 0x58], np.uint8)
_SYNC = np.dtype(
    {
        "names": ["begin", "type", "mark", "seq", "id", "times"],
        "formats": ["u1", "2u1", "u1", ">u4", "u1", "V27"],
        "offsets": [0, 1, 3, 4, 8, 8],
        "itemsize": 35,
    }
)
_HEARTBEAT_VALUES = len(wire.names(wire.HEARTBEAT)) - 1  # without seq
_HEARTBEAT_NEEDED = wire.needed(wire.HEARTBEAT) - 1  # of a box with any minor version
_UINT8, _UINT32, _UINT64 = 0x18, 0x1A, 0x1B  # CBOR: an unsigned integer of this many bits follows
_ID_BYTES = {0x18: 2, 0x19: 3, 0x1A: 5}  # of an unsigned integer of 24 or more


@dataclass(frozen=True, eq=False)
class Frames:
    """The frames (f,) in a batch of messages, in order of arrival; messages that are not frames are left out.

    ``kind`` is the kind of the device time ``t_us``: the stream number for data, minus the type for other frames,
    NO_TIME for frames without a time. n0, period (0: ``offsets_us`` holds the times), flags and the position of the
    samples are set for data frames and 0 otherwise. ``single`` holds the elements of a frame that is neither data nor a
    usual heartbeat or sync reply. ``heartbeats`` holds the values of heartbeats without seq.
    """

    messages: Messages
    row: NDArray[np.intp]  # of messages
    t_host_ns: Ints
    seq: Ints
    kind: Ints
    t_us: Ints
    boot_id: Ints  # of a heartbeat; NO_BOOT for other frames
    is_data: NDArray[np.bool_]
    n0: Ints
    period_ns: Ints
    flags: Ints
    samples_at: Ints
    samples_bytes: Ints
    offsets_us: dict[int, bytes]
    single: dict[int, list[Any]]
    heartbeats: dict[int, list[int]]
    run_begins: NDArray[np.intp]  # a run ends where the next one begins
    of_kind: dict[int, list[int]]  # the frames that have a time, by kind
    beats: list[int]  # the frames that are in ``heartbeats``
    malformed: int

    def __len__(self) -> int:
        return len(self.row)

    def runs(self) -> Iterator[Run]:
        """Yield the frames run by run."""
        for begin, end in pairwise([*self.run_begins.tolist(), len(self)]):
            yield Run(self, begin, end)


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """Frames ``begin`` to ``end`` of a batch, at least one. Properties refer to the first frame unless stated
    otherwise.
    """

    frames: Frames
    begin: int
    end: int

    def __len__(self) -> int:
        return self.end - self.begin

    def first(self, n: int) -> Run:
        """Return the first n frames."""
        return Run(self.frames, self.begin, self.begin + n)

    def after(self, head: Run) -> Run:
        """Return the frames that follow these first ones."""
        return Run(self.frames, head.end, self.end)

    @property
    def row(self) -> int:
        """Index of the message in the batch."""
        return int(self.frames.row[self.begin])

    @property
    def seq(self) -> int:
        """Sequence number."""
        return int(self.frames.seq[self.begin])

    @property
    def t_host_ns(self) -> int:
        """Arrival time on the host [ns]."""
        return int(self.frames.t_host_ns[self.begin])

    @property
    def last_host_ns(self) -> int:
        """Arrival time of the last frame on the host [ns]."""
        return int(self.frames.t_host_ns[self.end - 1])

    @property
    def born_ns(self) -> int | None:
        """Host time of device time 0 [ns] if the frame did not take any time to arrive; None without a device time."""
        return self._born_ns(self.begin)

    @property
    def last_born_ns(self) -> int | None:
        """``born_ns`` of the last frame that has a device time."""
        timed = (frame for frame in range(self.end - 1, self.begin - 1, -1) if self.frames.kind[frame] != NO_TIME)
        return self._born_ns(next(timed, self.begin))

    def _born_ns(self, frame: int) -> int | None:
        if self.frames.kind[frame] == NO_TIME:
            return None
        return int(self.frames.t_host_ns[frame]) - 1000 * int(self.frames.t_us[frame])

    @property
    def payload(self) -> bytes:
        """Payload bytes."""
        return self.frames.messages.payload(self.row)

    @property
    def is_boot(self) -> bool:
        """Whether the frame is the first page of the ident that a box sends unprompted at boot."""
        elements = self.frames.single.get(self.begin)
        return elements is not None and is_boot(elements)

    def times(self) -> list[tuple[int, int, int, int]]:
        """Return the kind, the first frame, its time and the last time for each kind of device time in the run."""
        found = []
        for kind, frames in self.frames.of_kind.items():
            first = bisect_left(frames, self.begin)
            if first < len(frames) and frames[first] < self.end:
                last = bisect_left(frames, self.end, first) - 1
                t_us = self.frames.t_us
                found.append((kind, frames[first], int(t_us[frames[first]]), int(t_us[frames[last]])))
        return found

    def first_heartbeat(self) -> tuple[int, int | None]:
        """Return the first heartbeat of the run and its boot id; None if there is none.

        All heartbeats of a run have the same boot id.
        """
        alone = self.frames.single.get(self.begin)
        if alone is not None:
            return self.begin, boot_id(alone)
        beats = self.frames.beats
        first = bisect_left(beats, self.begin)
        if first == len(beats) or beats[first] >= self.end:
            return self.end, None
        return beats[first], int(self.frames.boot_id[beats[first]])


def frames_of(messages: Messages) -> Frames:
    """Return the frames among the messages of a box."""
    rows = messages.rows(lambda topic: topic.startswith("/box/") and topic != "/box/console")
    begin, end = messages.begin[rows], messages.end[rows]
    n, size = len(rows), end - begin
    seq, t_us, n0, period_ns, flags, samples_bytes = (np.zeros(n, np.int64) for _ in range(6))
    kind, boot = np.full(n, NO_TIME, np.int64), np.full(n, NO_BOOT, np.int64)
    samples_at = begin + _DATA.itemsize
    is_data = _usual_data(messages, begin, end)
    head = heads(messages.data, begin[is_data], _DATA)
    seq[is_data], kind[is_data], n0[is_data] = head["seq"], head["stream"], head["n0"]
    t_us[is_data], period_ns[is_data] = head["t0"], head["period"]
    flags[is_data], samples_bytes[is_data] = messages.bytes_u1[end[is_data] - 1], head["size"]
    is_sync, sync_seq, t1_us = _usual_syncs(messages, begin, size)
    seq[is_sync], kind[is_sync], t_us[is_sync] = sync_seq, -wire.SYNC_REPLY, t1_us

    offsets_us: dict[int, bytes] = {}
    single: dict[int, list[Any]] = {}
    heartbeats: dict[int, list[int]] = {}
    whole = np.ones(n, bool)
    for i in np.flatnonzero(~(is_data | is_sync)).tolist():
        payload = messages.payload(int(rows[i]))
        elements = decode(payload)
        if elements is None or is_echo(elements):
            whole[i] = False
            continue
        seq[i] = elements[1]
        stamp = device_time(elements)
        if stamp is not None:
            kind[i], t_us[i] = stamp
        data = data_of(elements) if elements[0] == wire.DATA else None
        values = heartbeat_values(elements) if elements[0] == wire.HEARTBEAT else None
        if data is not None and data.stream < MAX_STREAM and data.flags < 2**62:
            is_data[i] = True
            n0[i], period_ns[i], flags[i], samples_bytes[i] = data.n0, data.period_ns, data.flags, len(data.samples)
            samples_at[i] = begin[i] + payload.rfind(data.samples)
            if not data.period_ns:
                offsets_us[i] = data.offsets_us
        else:
            boot_of_it = boot_id(elements)
            if boot_of_it is not None and values is not None and kind[i] != NO_TIME and 0 <= boot_of_it < CIRCLE:
                boot[i] = boot_of_it
                heartbeats[i] = values
            else:
                single[i] = elements
    malformed = int(np.count_nonzero(~whole))
    if malformed:
        place = (np.cumsum(whole) - 1).tolist()
        offsets_us = {place[i]: value for i, value in offsets_us.items()}
        single = {place[i]: value for i, value in single.items()}
        heartbeats = {place[i]: value for i, value in heartbeats.items()}
        rows, is_data = rows[whole], is_data[whole]
        numbers = (seq, kind, t_us, boot, n0, period_ns, flags, samples_at, samples_bytes)
        seq, kind, t_us, boot, n0, period_ns, flags, samples_at, samples_bytes = (column[whole] for column in numbers)
    of_kind = {int(k): np.flatnonzero(kind == k) for k in np.unique(kind) if k != NO_TIME}
    return Frames(
        messages=messages,
        row=rows,
        t_host_ns=messages.t_host_ns[rows],
        seq=seq,
        kind=kind,
        t_us=t_us,
        boot_id=boot,
        is_data=is_data,
        n0=n0,
        period_ns=period_ns,
        flags=flags,
        samples_at=samples_at,
        samples_bytes=samples_bytes,
        offsets_us=offsets_us,
        single=single,
        heartbeats=heartbeats,
        run_begins=_run_begins(seq, t_us, boot, of_kind, single),
        of_kind={kind: frames.tolist() for kind, frames in of_kind.items()},
        beats=sorted(heartbeats),
        malformed=malformed,
    )


def heartbeat_values(elements: list[Any]) -> list[int] | None:
    """Return the values of a heartbeat after seq; None if they violate the specification."""
    values = elements[2 : 2 + _HEARTBEAT_VALUES]
    if len(values) < _HEARTBEAT_NEEDED or any(type(value) is not int for value in values):
        return None
    return values


def _usual_data(messages: Messages, begin: Ints, end: Ints) -> NDArray[np.bool_]:
    """Return which payloads are data frames of the usual layout (``usual_data``)."""
    head = heads(messages.data, begin, _DATA)
    size = end - begin
    usual = (head["begin"] == 0x88) & (head["type"] == wire.DATA) & (head["mark"] == _UINT32)
    usual &= (head["m_n0"] == _UINT64) & (head["m_t0"] == _UINT64) & (head["m_p"] == _UINT32)
    usual &= np.all(head["tag"] == _DATA_TAG, axis=1) & (size <= MAX_PAYLOAD)
    usual &= (size > _DATA.itemsize) & (head["size"] == size - _DATA.itemsize - 1)
    usual &= (head["stream"] < 24) & (head["period"] > 0) & (head["t0"] < MAX_DEVICE_US) & (head["n0"] < MAX_N0)
    last = messages.bytes_u1[np.maximum(end - 1, 0)]
    return np.asarray(usual & (last < 24))


def _usual_syncs(messages: Messages, begin: Ints, size: Ints) -> tuple[NDArray[np.bool_], Ints, Ints]:
    """Return which payloads are sync replies of the usual layout, with their seq and t1 [µs]."""
    head = heads(messages.data, begin, _SYNC)
    usual = (head["begin"] == 0x85) & (head["type"][:, 0] == _UINT8) & (head["type"][:, 1] == wire.SYNC_REPLY)
    usual &= head["mark"] == _UINT32
    id_bytes = np.ones(len(begin), np.int64)
    for mark, width in _ID_BYTES.items():
        id_bytes[head["id"] == mark] = width
    usual &= (head["id"] < 24) | (id_bytes > 1)
    usual &= size == 8 + id_bytes + 18
    times_at = begin + 8 + id_bytes
    times = np.dtype(
        {"names": ["m1", "t1", "m2"], "formats": ["u1", ">u8", "u1"], "offsets": [0, 1, 9], "itemsize": 18}
    )
    found = heads(messages.data, np.where(usual, times_at, 0), times)
    usual &= (found["m1"] == _UINT64) & (found["m2"] == _UINT64) & (found["t1"] < MAX_DEVICE_US)
    return usual, head["seq"][usual].astype(np.int64), found["t1"][usual].astype(np.int64)


def _run_begins(
    seq: Ints, t_us: Ints, boot: Ints, of_kind: dict[int, NDArray[np.intp]], single: dict[int, list[Any]]
) -> NDArray[np.intp]:
    """Return where a frame does not simply follow the previous one."""
    if not len(seq):
        return np.empty(0, np.intp)
    cut = np.ones(len(seq) + 1, bool)
    cut[1:-1] = seq[1:] != (seq[:-1] + 1) % CIRCLE
    for frames in of_kind.values():
        cut[frames[1:][np.diff(t_us[frames]) < 0]] = True
    beats = np.flatnonzero(boot != NO_BOOT)
    cut[beats[1:][np.diff(boot[beats]) != 0]] = True
    alone = np.array(list(single), dtype=np.intp)
    cut[alone] = cut[alone + 1] = True
    return np.flatnonzero(cut[:-1])
