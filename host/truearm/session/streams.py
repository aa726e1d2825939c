"""Assign the frames of a box to its boots, and convert them to blocks of samples and exact losses.

A link neither reorders nor doubles frames (SPEC §4). Within a boot, ``seq`` therefore counts up, and a gap is a loss. A
box states its boot id in a heartbeat once a second, and in the ident that it sends at boot. Frames are held until then,
so that where batches end changes nothing.

- If the boot id is another one, the box **restarted** where ``seq`` departs most from the count. A new **segment**
  begins there, and its frames count from 0.
- Of the frames of one boot, the longest rising subsequence is used. The others are behind the count or out of place:
  **malformed**. They are counted and not used.

A batch of messages becomes ``Blocks``: tables with one row per data frame of one stream, segment and ident. Device time
is valid within a segment. Samples are complete within a **run** (from one ``start`` to the next) between blocks marked
``gap``.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise, product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from truearm.errors import ProtocolError
from truearm.session.box_ident import Channel, Ident, Stream, decode_ident
from truearm.session.frames import NO_FRAMES, NONE, Frames, Pages, frames_of, is_boot, is_text, parse_exchange
from truearm.session.losses import COUNTED, Heartbeats, Losses, StreamReport, StreamTrack, summary_of
from truearm.session.session_file import Messages
from truearm.types import Ints
from truearm_wire import messages as wire

CIRCLE = 2**32  # seq wraps here
MOST_HELD = 8192  # frames without a boot id, which a box states every second
FELL_US = 10_000_000  # frames of one boot are sent in the order of their times, to within less than this


BLOCK = np.dtype(
    [("n0", "i8"), ("t_us", "i8"), ("period_ns", "u4"), ("n", "i4"), ("run", "i4"), ("flags", "u1"), ("gap", "?")]
)


@dataclass(eq=False)
class Blocks:
    """Data frames (b,) of one stream, segment and ident, in order of sending.

    ``table`` (b,) of BLOCK: index and device time of the first sample, period, number of samples per channel, run, flags,
    and whether samples before the block are missing. ``counts`` (Σ n, c): of the stream's channels at ``columns``.
    ``stated_ns`` (Σ n,): time from the block's first sample to each sample; (0,) if the periods give it.
    """

    segment: int
    ident: Ident
    stream: Stream
    columns: tuple[int, ...]
    table: NDArray[Any]
    counts: NDArray[np.int32]
    stated_ns: Ints

    def __len__(self) -> int:
        return len(self.table)

    @property
    def channels(self) -> tuple[Channel, ...]:
        """The channels in the columns of ``counts``."""
        return tuple(self.stream.channels[column] for column in self.columns)

    @cached_property
    def first(self) -> Ints:
        """Offset (b + 1,) of each block in ``counts``, and their length."""
        return np.append(0, np.cumsum(self.table["n"], dtype=np.int64))

    @cached_property
    def reach_ns(self) -> int:
        """The longest time from the first sample of a block to its last."""
        by_period = int(self.table["n"].max()) * max(int(self.table["period_ns"].max()), self.stream.period_ns)
        return int(self.stated_ns.max(initial=0)) or by_period

    def within_ns(self, rows: slice = slice(None)) -> Ints:
        """Return the time [ns] from the first sample of its block to each sample of some blocks.

        The nominal period is used: 1000 ppm over 13 ms is 13 µs.
        """
        table, first = self.table[rows], self.first[:-1][rows]
        if self.stated_ns.size:
            return self.stated_ns[first[0] : first[-1] + table["n"][-1]]
        place = np.arange(table["n"].sum()) - np.repeat(first - first[0], table["n"])
        return np.asarray(place * np.repeat(table["period_ns"], table["n"]))


@dataclass
class Segment:
    """The time of the box from one boot to the next.

    ``begin``: its first message of the session. All messages up to the next segment's first are of this boot, as a link
    does not reorder: the reply to a clock request stands before its row on ``/sync``.
    """

    index: int
    begin: int = 0
    booted: bool = False  # the box booted within the session
    boot_id: int | None = None
    ident: Ident | None = None
    heartbeats: Heartbeats = field(default_factory=Heartbeats)
    output: list[tuple[int, bool]] = field(default_factory=list)  # edges of the trigger output: device time [µs], level
    temperatures: dict[str | None, list[tuple[int, int]]] = field(
        default_factory=dict
    )  # by thermometer, None for the box's own: device time [µs], m°C


class BoxReader:
    """Processes the messages of the box and the clock batch by batch.

    ``ident`` describes the streams if the session has no ident frames before the data.
    """

    def __init__(self, ident: Ident | None = None) -> None:
        self.segments = [Segment(0, ident=ident)]
        self._count: Counter[str] = Counter()
        self._next: int | None = None  # seq of the next frame; None before the first
        self._held = NO_FRAMES  # until the box states its boot id
        self._messages = 0  # so far
        self._heard: list[Ints] = [np.empty((0, 5), np.int64)]  # message, and times of an exchange
        self._streams: dict[int, StreamTrack] = {}
        self._described: dict[int, Stream] = {}  # the same streams, by the ident of their newest block
        self._pages = Pages()

    @property
    def segment(self) -> Segment:
        """The segment of the newest frame."""
        return self.segments[-1]

    def feed(self, messages: Messages) -> list[Blocks]:
        """Account for a batch and return the blocks of samples. Messages of other topics are ignored."""
        for data in messages.payloads(messages.rows(lambda topic: topic == "/box/console")):
            self._count.update(console_runs=1, console_bytes=len(data), console_text_runs=int(is_text(data)))
        replies = messages.rows(lambda topic: topic == "/sync")
        exchanges = map(parse_exchange, messages.payloads(replies))
        numbered = zip((replies + self._messages).tolist(), exchanges, strict=True)
        answered = [(k, *exchange) for k, exchange in numbered if exchange is not None]
        self._count.update(sync_requests=len(replies), sync_unanswered=len(replies) - len(answered))
        self._heard.append(np.array(answered, np.int64).reshape(-1, 5))
        frames = frames_of(messages)
        frames.table["message"] += self._messages
        self._messages += len(messages)
        self._count["frames_malformed"] += frames.malformed
        frames = self._held.followed_by(frames)
        bounds = _bounds(frames.table)
        if self._continues(frames.table[: bounds[-1]]):
            bounds = [0, bounds[-1]]
        self._held = frames.held(bounds[-1])
        return self._use(frames, bounds)

    def finish(self) -> list[Blocks]:
        """Return the blocks that are still held, at the end of the session."""
        frames, self._held = self._held, NO_FRAMES
        return self._use(frames, [0, len(frames.table)])

    def exchanges(self, segment: Segment) -> Ints:
        """Return the clock exchanges of a segment (k, 4): times of host write, device receive, device send and arrival."""
        heard = np.concatenate(self._heard)
        return np.asarray(heard[segment_at(self.segments, heard[:, 0]) == segment.index, 1:])

    def losses(self) -> Losses:
        """Return the losses so far."""
        count = {name: self._count[name] for name in Losses.__dataclass_fields__ if name != "box"}
        count |= {name: sum(getattr(stream, name) for stream in self._streams.values()) for name in COUNTED}
        return Losses(**count, box=summary_of([(segment.heartbeats, segment.booted) for segment in self.segments]))

    def streams(self) -> tuple[StreamReport, ...]:
        """Return the streams so far."""
        return tuple(track.report(k, self._described[k]) for k, track in sorted(self._streams.items()))

    # ------------------------------------------------------------------------------------------------ boots

    def _use(self, frames: Frames, bounds: Sequence[int]) -> list[Blocks]:
        """Account for groups of frames, each from one of the bounds to the next."""
        blocks: list[Blocks] = []
        due: list[tuple[Ints, Ints]] = []  # rows of this segment, and the frames lost before each
        for begin, end in pairwise(bounds):
            restart = self._restart(frames.table[begin:end])
            if restart is not None:
                due.append(self._in_order(frames.table, begin, begin + restart))
                blocks += self._contents(frames, due)
                begin, due = begin + restart, []
                self._begin_segment(int(frames.table["message"][begin]))
            due.append(self._in_order(frames.table, begin, end))
        return blocks + self._contents(frames, due)

    def _continues(self, table: NDArray[Any]) -> bool:
        """Return whether frames continue the count and are all of the same boot."""
        if self._next is None or self.segment.boot_id is None or not len(table):
            return False
        same_boot = (table["boot_id"] == NONE) | (table["boot_id"] == self.segment.boot_id)
        return bool(np.all(np.diff(table["seq"], prepend=self._next - 1) == 1) and np.all(same_boot))

    def _restart(self, group: NDArray[Any]) -> int | None:
        """Return the first frame of another boot, None if there is none: before and behind it, most frames count up.

        If that does not decide, it is where ``seq`` departs most from the count.
        """
        stated = group[group["boot_id"] != NONE]
        if not len(stated) or stated["boot_id"][-1] == self.segment.boot_id:
            return None
        timed = group["t_us"][group["t_us"] != NONE]
        if self.segment.boot_id is None and not np.any(np.diff(timed) < -FELL_US):
            return None
        before = np.append(0, _rise_lengths(*self._ahead(group["seq"])))[:-1]
        behind = _rise_lengths(-group["seq"][::-1], -stated["seq"][-1])[::-1]
        usable = np.maximum.accumulate(before) + np.maximum.accumulate(behind[::-1])[::-1]
        expected = group["seq"][0] if self._next is None else self._next
        departure = np.abs(np.diff(group["seq"], prepend=expected - 1) - 1)
        return int(np.argmax(np.where(usable == usable.max(), departure, NONE)))

    def _ahead(self, seq: Ints) -> tuple[Ints, int]:
        """Return how far frames (n,) are ahead of the count, and the least that continues it."""
        expected = seq[:1] if self._next is None else self._next
        return (seq - expected + CIRCLE // 2) % CIRCLE - CIRCLE // 2, -CIRCLE if self._next is None else 0

    def _begin_segment(self, message: int) -> None:
        """Begin another boot, which counts from 0."""
        self._count["restarts"] += 1
        self.segments.append(Segment(len(self.segments), message, booted=True, ident=self.segment.ident))
        self._pages, self._next = Pages(), 0
        for stream in self._streams.values():
            stream.restart(self._count["frames_lost"])

    def _in_order(self, table: NDArray[Any], begin: int, end: int) -> tuple[Ints, Ints]:
        """Return which frames of one boot count up, and the frames lost in the session before each."""
        seq = table["seq"][begin:end]
        ahead, least = self._ahead(seq)
        rows = np.arange(len(seq))
        if np.any(ahead != rows):
            # Frames ahead of one that states the boot id, behind which a group ends, are out of place too.
            most = ahead[-1] if table["boot_id"][end - 1] != NONE and ahead[-1] >= least else CIRCLE
            rows = _longest_rise(np.where(ahead <= most, ahead, least - 1), least)
        used, ahead = begin + rows, ahead[rows]
        gaps = np.diff(ahead, prepend=ahead[:1] - 1 if self._next is None else -1) - 1
        lost = self._count["frames_lost"] + np.cumsum(gaps)
        self._count["frames_malformed"] += len(seq) - len(rows)
        self._count.update(frames=len(rows), frames_lost=int(gaps.sum()), loss_events=int(np.count_nonzero(gaps)))
        if len(rows):
            self._next = (int(table["seq"][used[-1]]) + 1) % CIRCLE
        stated = table["boot_id"][used]
        if np.any(stated != NONE):
            self.segment.boot_id = int(stated.max())
        return used, lost

    # ------------------------------------------------------------------------------------------------ contents

    def _contents(self, frames: Frames, due: Sequence[tuple[Ints, Ints]]) -> list[Blocks]:
        """Evaluate frames of one segment: their rows, and the frames lost before each."""
        if not due:
            return []
        index, lost = map(np.concatenate, zip(*due, strict=True))
        blocks: list[Blocks] = []
        begin = 0
        for k in np.flatnonzero(np.isin(index, list(frames.elements))).tolist():
            elements, kind = frames.elements[int(index[k])], int(frames.table["type"][index[k]])
            if kind == wire.IDENT:  # the frames behind it are of another description
                blocks += self._samples(frames, index[begin:k], lost[begin:k])
                begin = k
                self._describe(elements)
            elif kind != NONE:
                self._content(elements, kind)
        return blocks + self._samples(frames, index[begin:], lost[begin:])

    def _content(self, elements: list[Any], kind: int) -> None:
        """Take a frame that was decoded singly, except pages of an ident."""
        segment = self.segment
        if kind == wire.HEARTBEAT:
            segment.heartbeats.take(elements[2:])
            mdegc = elements[2:][_TEMPERATURE_AT]
            segment.temperatures.setdefault(None, []).append((elements[3], mdegc))
        elif kind == wire.EVENT and elements[2] == wire.OUTPUT_LINE:
            segment.output.append((elements[3], bool(elements[4])))
        elif kind == wire.TEMPERATURE:
            names = () if segment.ident is None else segment.ident.thermometers
            if 0 <= elements[3] < len(names):
                segment.temperatures.setdefault(names[elements[3]], []).append((elements[2], elements[4]))
        elif kind not in wire.LAYOUT:
            self._count["frames_unknown"] += 1

    def _describe(self, elements: list[Any]) -> None:
        """Take a page of an ident."""
        self.segment.booted |= is_boot(elements)
        document = self._pages.push(*elements[2:6])
        if document is None:
            return
        try:
            self.segment.ident = decode_ident(document)
        except ProtocolError:
            self._count["frames_malformed"] += 1

    def _samples(self, frames: Frames, index: Ints, lost: Ints) -> list[Blocks]:
        """Account for the data frames of each stream; ``lost``: frames lost before each, in the session."""
        blocks: list[Blocks] = []
        table, ident = frames.table[index], self.segment.ident
        data = table["type"] == wire.DATA
        for stream_id, buffer in product(np.unique(table["stream"][data]).tolist(), range(len(frames.buffers))):
            rows = np.flatnonzero(data & (table["stream"] == stream_id) & (table["buffer"] == buffer))
            if ident is None or stream_id not in ident.streams:
                self._count["blocks_without_ident"] += len(rows)
            elif len(rows := self._whole(frames, index, rows, ident.streams[stream_id])):
                blocks.append(self._blocks(frames, index[rows], lost[rows], ident, ident.streams[stream_id]))
        return blocks

    def _whole(self, frames: Frames, index: Ints, rows: Ints, stream: Stream) -> Ints:
        """Return the rows of the data frames that hold as many samples as they say."""
        table = frames.table[index[rows]]
        n, rest = np.divmod(table["samples_bytes"], 4 * len(stream.channels))
        whole = (rest == 0) & (n > 0)
        for k in np.flatnonzero(table["period_ns"] == 0).tolist():
            whole[k] &= len(frames.elements[int(index[rows[k]])][5].value) == 2 * n[k]
        self._count["frames_malformed"] += int(np.count_nonzero(~whole))
        return np.asarray(rows[whole])

    def _blocks(self, frames: Frames, index: Ints, lost: Ints, ident: Ident, stream: Stream) -> Blocks:
        rows = frames.table[index]
        channels = len(stream.channels)
        n = rows["samples_bytes"] // (4 * channels)
        track = self._streams.setdefault(stream.id, StreamTrack())
        self._described[stream.id], track.period_ns = stream, int(rows["period_ns"][-1])
        table = np.empty(len(rows), BLOCK)
        table["gap"], table["run"] = track.take(rows["n0"], n, rows["t_us"], rows["flags"], lost)
        table["n0"], table["t_us"], table["period_ns"], table["n"] = rows["n0"], rows["t_us"], rows["period_ns"], n
        table["flags"] = rows["flags"] & 0xFF
        counts = np.empty((int(n.sum()), channels), np.int32)
        blocks = Blocks(self.segment.index, ident, stream, tuple(range(channels)), table, counts, np.empty(0, np.int64))
        data = np.frombuffer(frames.buffers[rows["buffer"][0]], np.uint8)
        for length in np.unique(n).tolist():
            alike = np.flatnonzero(n == length)
            window = np.lib.stride_tricks.sliding_window_view(data, 4 * length * channels)
            samples = np.asarray(window[rows["samples_at"][alike]]).view("<i4")
            counts[blocks.first[alike][:, None] + np.arange(length)] = samples.reshape(len(alike), length, channels)
        single = np.flatnonzero(rows["period_ns"] == 0)
        if single.size:
            blocks.stated_ns = blocks.within_ns()
            for k in single.tolist():
                offsets = np.frombuffer(frames.elements[int(index[k])][5].value, "<u2")
                blocks.stated_ns[blocks.first[k] : blocks.first[k + 1]] = 1000 * offsets.astype(np.int64)
        return blocks


_TEMPERATURE_AT = wire.names(wire.HEARTBEAT)[1:].index("temperature_mdegc")


def segment_at(segments: Sequence[Segment], message: Ints) -> Ints:
    """Return the index of the segment to which messages (n,) of the session belong, by their index in it."""
    return np.searchsorted([segment.begin for segment in segments[1:]], message, "right")


def _bounds(table: NDArray[Any]) -> list[int]:
    """Return 0 and where groups of frames end.

    That is behind a frame that states the boot id, if the count continues behind it or the next one states another id.
    """
    stated = np.flatnonzero(table["boot_id"] != NONE)
    boot_id = table["boot_id"][stated]
    following = table["seq"][np.minimum(stated + 1, len(table) - 1)]
    ends = (following == (table["seq"][stated] + 1) % CIRCLE) | (np.diff(boot_id, append=boot_id[-1:]) != 0)
    bounds = [0]
    for end in [*(stated[ends] + 1).tolist(), len(table)]:
        bounds += [*range(bounds[-1] + MOST_HELD, end, MOST_HELD), end]
    return bounds[:-1]


def _rise_lengths(numbers: Ints, least: int) -> Ints:
    """Return the length of the longest rising subsequence that ends at each number; 0 at those below ``least``."""
    lowest: list[int] = []  # last number of a rising subsequence, by its length
    lengths = np.zeros(len(numbers), np.int64)
    for row in np.flatnonzero(numbers >= least).tolist():
        place = bisect_left(lowest, numbers[row])
        lowest[place : place + 1] = [numbers[row]]
        lengths[row] = place + 1
    return lengths


def _longest_rise(numbers: Ints, least: int) -> Ints:
    """Return the rows of the longest rising subsequence of the numbers from ``least`` on, the lowest one of several."""
    lengths = _rise_lengths(numbers, least)
    rows: list[int] = []
    for row in np.flatnonzero(lengths)[::-1].tolist():
        if lengths[row] == lengths.max() - len(rows) and (not rows or numbers[row] < numbers[rows[-1]]):
            rows.append(row)
    return np.array(rows[::-1], np.int64)
