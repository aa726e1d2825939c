"""Decode and check the frames of a box (protocol/SPEC.md §4, §5) as a table: one row per frame, in order of arrival.

Nearly all frames are data and sync replies, whose heads have a fixed layout (protocol/frames.cddl). NumPy reads these in
one pass. All others are decoded singly (``box_frames``) and keep their elements.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from truearm.session.box_frames import (
    MAX_DEVICE_US,
    MAX_N0,
    MAX_PAYLOAD,
    boot_id,
    conforms,
    data_of,
    decode,
    is_echo,
)
from truearm.session.message_columns import Messages, heads
from truearm.types import Ints
from truearm_wire import messages as wire

NONE = -1  # of a frame without this element
FRAME = np.dtype(
    [(name, np.int64) for name in ("message", "t_host_ns", "seq", "type", "t_us", "boot_id")]  # of all frames
    + [
        (name, np.int64) for name in ("stream", "n0", "period_ns", "flags", "buffer", "samples_at", "samples_bytes")
    ]  # of data
)
_TIME_AT = {wire.EVENT: 3, wire.HEARTBEAT: 3}  # index of the device time in a frame without samples

_DATA = np.dtype(
    {
        "names": [
            "begin",
            "type",
            "mark",
            "seq",
            "stream",
            "m_n0",
            "n0",
            "m_t0",
            "t_us",
            "m_p",
            "period_ns",
            "tag",
            "size",
        ],
        "formats": ["u1", "u1", "u1", ">u4", "u1", "u1", ">u8", "u1", ">u8", "u1", ">u4", "3u1", "u1"],
        "offsets": [0, 1, 2, 3, 7, 8, 9, 17, 18, 26, 27, 31, 34],
        "itemsize": 35,
    }
)
_DATA_TAG = np.array([0xD8, 0x4E, 0x58], np.uint8)
_SYNC = np.dtype({"names": ["begin", "seq"], "formats": ["4u1", ">u4"], "offsets": [0, 4], "itemsize": 8})
_SYNC_BEGIN = np.array([0x85, 0x18, wire.SYNC_REPLY, 0x1A], np.uint8)
_SYNC_BYTES = (27, 28, 29, 31)  # by the width of the request's number
_UINT32, _UINT64 = 0x1A, 0x1B  # CBOR: an unsigned integer of this many bits follows


@dataclass(frozen=True, eq=False)
class Frames:
    """The frames (f,) in a batch of messages, which may follow frames of earlier ones. Messages that are not frames are left out.

    ``table`` (f,) of FRAME; ``message`` is an index in the batch, ``samples_at`` is an offset in one of the ``buffers``. The
    period is 0 if the frame states the offset of each sample. ``elements``: of each frame that was decoded singly, by row.
    The type of a frame that violates the specification is NONE; ``malformed`` counts these and the messages that are not
    frames.
    """

    buffers: tuple[bytes, ...]
    table: NDArray[Any]
    elements: dict[int, list[Any]]
    malformed: int

    def held(self, first: int) -> Frames:
        """Return the frames from row ``first`` on, with their samples alone."""
        table = self.table[first:].copy()
        of_data = np.flatnonzero(table["samples_at"] != NONE)
        places = zip(
            *(table[name][of_data].tolist() for name in ("buffer", "samples_at", "samples_bytes")), strict=True
        )
        samples = b"".join(self.buffers[buffer][begin : begin + n] for buffer, begin, n in places)
        size = table["samples_bytes"][of_data]
        table["buffer"][of_data], table["samples_at"][of_data] = 0, np.cumsum(size) - size
        return Frames((samples,), table, {k - first: frame for k, frame in self.elements.items() if k >= first}, 0)

    def followed_by(self, later: Frames) -> Frames:
        """Return these frames, then all of ``later``."""
        count = len(self.table)
        table = np.concatenate([self.table, later.table])
        table["buffer"][count:] += len(self.buffers)
        elements = self.elements | {k + count: frame for k, frame in later.elements.items()}
        return Frames(self.buffers + later.buffers, table, elements, later.malformed)


NO_FRAMES = Frames((), np.empty(0, FRAME), {}, 0)


def frames_of(messages: Messages) -> Frames:
    """Return the frames among the messages of a box."""
    rows = messages.rows(lambda topic: topic.startswith("/box/") and topic != "/box/console")
    begin, end = messages.begin[rows], messages.end[rows]
    table = np.full(len(rows), NONE, FRAME)
    table["message"], table["t_host_ns"], table["buffer"] = rows, messages.t_host_ns[rows], 0
    usual = _usual_data(messages, begin, end, table) | _usual_syncs(messages, begin, end, table)
    elements: dict[int, list[Any]] = {}
    is_frame = np.ones(len(rows), bool)
    malformed = 0
    for k in np.flatnonzero(~usual).tolist():
        payload = messages.payload(int(rows[k]))
        frame = decode(payload)
        if frame is None or is_echo(frame):
            is_frame[k] = False
            malformed += 1
            continue
        elements[k] = frame
        table["seq"][k] = frame[1]
        if not conforms(frame):
            malformed += 1
            continue
        stated = boot_id(frame)
        table["type"][k], table["boot_id"][k] = frame[0], NONE if stated is None else stated
        if frame[0] in _TIME_AT:
            table["t_us"][k] = frame[_TIME_AT[frame[0]]]
        if frame[0] == wire.DATA and (data := data_of(frame)) is not None:
            at = int(begin[k]) + payload.rfind(data.samples)
            table["t_us"][k] = data.t0_us
            for name in ("stream", "n0", "period_ns", "flags"):
                table[name][k] = getattr(data, name)
            table["samples_at"][k], table["samples_bytes"][k] = at, len(data.samples)
    place = (np.cumsum(is_frame) - 1).tolist()
    return Frames((messages.data,), table[is_frame], {place[k]: frame for k, frame in elements.items()}, malformed)


def _usual_data(messages: Messages, begin: Ints, end: Ints, table: NDArray[Any]) -> NDArray[np.bool_]:
    """Enter the data frames of the usual layout in the table; return which messages they are."""
    head, size = heads(messages.data, begin, _DATA), end - begin
    usual = (head["begin"] == 0x88) & (head["type"] == wire.DATA) & (head["mark"] == _UINT32)
    usual &= (head["m_n0"] == _UINT64) & (head["m_t0"] == _UINT64) & (head["m_p"] == _UINT32)
    usual &= np.all(head["tag"] == _DATA_TAG, axis=1) & (size <= MAX_PAYLOAD)
    usual &= (size > _DATA.itemsize) & (head["size"] == size - _DATA.itemsize - 1)
    usual &= (head["stream"] < 24) & (head["period_ns"] > 0) & (head["t_us"] < MAX_DEVICE_US) & (head["n0"] < MAX_N0)
    flags = messages.bytes_u1[np.maximum(end - 1, 0)]
    usual &= flags < 24
    for name in ("seq", "type", "t_us", "stream", "n0", "period_ns"):
        table[name][usual] = head[name][usual]
    table["flags"][usual], table["samples_bytes"][usual] = flags[usual], head["size"][usual]
    table["samples_at"][usual] = begin[usual] + _DATA.itemsize
    return np.asarray(usual)


def _usual_syncs(messages: Messages, begin: Ints, end: Ints, table: NDArray[Any]) -> NDArray[np.bool_]:
    """Enter the sync replies of the usual layout in the table; return which messages they are.

    Their times are those of the exchange on ``/sync``.
    """
    head = heads(messages.data, begin, _SYNC)
    usual = np.all(head["begin"] == _SYNC_BEGIN, axis=1) & np.isin(end - begin, _SYNC_BYTES)
    table["seq"][usual], table["type"][usual] = head["seq"][usual], wire.SYNC_REPLY
    return np.asarray(usual)
