"""Decode and check the frames of a box (protocol/SPEC.md §4, §5) as columns of a batch.

Nearly all frames are data, heartbeats and sync replies, which have a fixed header layout (protocol/frames.cddl).
``frames_of()`` reads these in one pass. It applies the same tests as for a single payload; a payload that fails them is
decoded singly (``box_frames``). Consecutive frames without anything unusual form a **run**, which is accounted for as a
unit. Every other frame is a run of its own.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from truearm.session.box_frames import (
    MAX_DEVICE_US,
    MAX_N0,
    MAX_PAYLOAD,
    MAX_STREAM,
    boot_id,
    data_of,
    decode,
    device_time,
    is_boot,
    is_echo,
)
from truearm.session.message_columns import Messages, heads
from truearm.types import Ints
from truearm_wire import messages as wire

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

    def runs(self) -> Iterator[FrameRun]:
        """Yield the frames run by run."""
        for begin, end in pairwise([*self.run_begins.tolist(), len(self)]):
            yield FrameRun(self, begin, end)


@dataclass(frozen=True, slots=True, eq=False)
class FrameRun:
    """Frames ``begin`` to ``end`` of a batch, at least one. Properties refer to the first frame unless stated
    otherwise.
    """

    frames: Frames
    begin: int
    end: int

    def __len__(self) -> int:
        return self.end - self.begin

    def first(self, n: int) -> FrameRun:
        """Return the first n frames."""
        return FrameRun(self.frames, self.begin, self.begin + n)

    def after(self, head: FrameRun) -> FrameRun:
        """Return the frames that follow these first ones."""
        return FrameRun(self.frames, head.end, self.end)

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
