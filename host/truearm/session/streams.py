"""Assign the frames of a box to its boots, and convert them to blocks of samples and exact losses.

A link neither reorders nor doubles frames (SPEC §4). Within a boot, ``seq`` therefore counts up, and a gap is a loss. A
frame that does not continue the count is held until the box states its boot id: heartbeats do once a second, and so does
the ident that a box sends at boot.

- If the boot id is another one, the box **restarted** at the held frame with the least ``seq``. A new **segment** begins
  there, and its frames count from 0.
- If it is the same, the held frames follow a loss.
- If the count continues first, the held frames were out of place.

A frame behind the count or out of place is **malformed**. It is counted and not used.

A batch of messages becomes ``Blocks``: tables with one row per data frame of one stream, segment and ident. Device time
is valid within a segment. Samples are complete within a **run** (from one ``start`` to the next) between blocks marked
``gap``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby, pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from truearm.errors import ProtocolError
from truearm.session.box_frames import Pages, is_boot, is_text, parse_exchange
from truearm.session.box_ident import Ident, Stream, decode_ident
from truearm.session.frames import NONE, Frames, frames_of
from truearm.session.losses import COUNTED, Heartbeats, Losses, StreamReport, StreamTrack, summary_of
from truearm.session.message_columns import Messages
from truearm.types import Ints
from truearm_wire import messages as wire

CIRCLE = 2**32  # seq wraps here
MOST_HELD = 8192  # frames without a boot id, which a box states every second
FELL_US = 10_000_000  # frames of one boot are sent in the order of their times, to within less than this


@dataclass(frozen=True, eq=False)
class Blocks:
    """Data frames (b,) of one stream, segment and ident, in order of sending: ``n`` samples per channel each.

    ``frames`` (b,) of FRAME. ``gap``: samples before the block are missing. If its period is 0, the block's
    ``offsets_us`` hold the sample times.
    """

    segment: int
    ident: Ident
    stream: Stream
    data: bytes
    frames: NDArray[Any]
    n: Ints
    gap: NDArray[np.bool_]
    run: Ints
    offsets_us: dict[int, bytes]

    def __len__(self) -> int:
        return len(self.n)

    @property
    def first(self) -> Ints:
        """Offset of each block in ``counts``."""
        return np.asarray(np.cumsum(self.n) - self.n)

    def counts(self) -> NDArray[np.int32]:
        """Return all samples as (Σ n, channels)."""
        channels = len(self.stream.channels)
        found = np.empty((int(self.n.sum()), channels), np.int32)
        for n in np.unique(self.n).tolist():
            alike = np.flatnonzero(self.n == n)
            window = np.lib.stride_tricks.sliding_window_view(np.frombuffer(self.data, np.uint8), 4 * n * channels)
            samples = np.asarray(window[self.frames["samples_at"][alike]]).view("<i4")
            if len(alike) == len(self):
                return samples.reshape(-1, channels)
            found[self.first[alike][:, None] + np.arange(n)] = samples.reshape(len(alike), n, channels)
        return found

    def within_ns(self) -> Ints:
        """Return the time from the first sample of its block to each sample [ns].

        The nominal period is used: 1000 ppm over 13 ms is 13 µs.
        """
        place = np.arange(int(self.n.sum())) - np.repeat(self.first, self.n)
        within: Ints = place * np.repeat(self.frames["period_ns"], self.n)
        for block, offsets in self.offsets_us.items():
            begin = int(self.first[block])
            within[begin : begin + int(self.n[block])] = 1000 * np.frombuffer(offsets, "<u2").astype(np.int64)
        return within


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


@dataclass(frozen=True, eq=False)
class _Run:
    """Consecutive frames ``begin`` to ``end`` of a batch, at least one, with at most one boot id."""

    frames: Frames
    begin: int
    end: int

    @property
    def message(self) -> int:
        return int(self.frames.table["message"][self.begin])

    @property
    def seq(self) -> int:
        return int(self.frames.table["seq"][self.begin])

    @property
    def next_seq(self) -> int:
        return (self.seq + self.end - self.begin) % CIRCLE

    @property
    def times_us(self) -> Ints:
        """Device times of the frames that have one."""
        t_us = self.frames.table["t_us"][self.begin : self.end]
        return np.asarray(t_us[t_us != NONE])

    @property
    def boot_id(self) -> int:
        return int(self.frames.table["boot_id"][self.begin : self.end].max())


class BoxReader:
    """Processes the messages of the box and the clock batch by batch.

    ``ident`` describes the streams if the session has no ident frames before the data.
    """

    def __init__(self, ident: Ident | None = None) -> None:
        self.segments = [Segment(0, ident=ident)]
        self._count: Counter[str] = Counter()
        self._next: int | None = None  # seq of the next frame; None before the first
        self._newest_us = 0  # newest device time of the boot
        self._held: list[_Run] = []
        self._due: list[tuple[_Run, int]] = []  # in order, and the frames lost before each
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
        blocks: list[Blocks] = []
        for run in self._runs(frames):
            blocks += self._take(run)
        return blocks + self._account()

    def finish(self) -> list[Blocks]:
        """Return the blocks that are still held, at the end of the session."""
        return [*self._settle(), *self._account()]

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

    def _runs(self, frames: Frames) -> list[_Run]:
        """Divide frames where ``seq`` does not count on, another boot id is stated, or the device time falls back."""
        table = frames.table
        if not len(table):
            return []
        cut = np.append(True, table["seq"][1:] != (table["seq"][:-1] + 1) % CIRCLE)
        stated = np.flatnonzero(table["boot_id"] != NONE)
        cut[stated[1:][np.diff(table["boot_id"][stated]) != 0]] = True
        timed = np.flatnonzero(table["t_us"] != NONE)
        cut[timed[1:][np.diff(table["t_us"][timed]) < -FELL_US]] = True
        bounds = [*np.flatnonzero(cut).tolist(), len(table)]
        return [_Run(frames, begin, end) for begin, end in pairwise(bounds)]

    def _take(self, run: _Run) -> list[Blocks]:
        """Use a run that continues the count; hold any other one until the box states its boot id."""
        follows_held = self._held and run.seq == self._held[-1].next_seq
        ours = run.boot_id in (NONE, self.segment.boot_id) or self.segment.boot_id is None
        if not follows_held and self._next in (None, run.seq) and ours and not self._fell(run):
            self._count["frames_malformed"] += _frames_in(self._held)
            self._held = []
            self._use(run)
            return []
        self._held.append(run)
        held = sum(run.end - run.begin for run in self._held)
        # A single frame decides nothing: if the count continues behind it, it was out of place.
        return (
            self._settle() if (held > 1 and any(run.boot_id != NONE for run in self._held)) or held > MOST_HELD else []
        )

    def _fell(self, run: _Run) -> bool:
        """Return whether the device time falls back with a run."""
        return bool(np.any(run.times_us[:1] < self._newest_us - FELL_US))

    def _settle(self) -> list[Blocks]:
        """Use the held frames: after a loss, or those of a new boot from where the count begins again."""
        held, self._held = self._held, []
        stated = next((run.boot_id for run in reversed(held) if run.boot_id != NONE), self.segment.boot_id)
        first = min(range(len(held)), key=lambda k: held[k].seq, default=0)  # a boot counts from 0
        ahead = not held or _ahead(held[first].seq, self._next or 0) >= 0
        if stated == self.segment.boot_id or (self.segment.boot_id is None and ahead):
            self._use_ahead(held)
            return []
        self._use_ahead(held[:first])
        blocks = self._account()
        self._count["restarts"] += 1
        self.segments.append(Segment(len(self.segments), held[first].message, booted=True, ident=self.segment.ident))
        self._pages, self._next, self._newest_us = Pages(), 0, 0
        for stream in self._streams.values():
            stream.restart(self._count["frames_lost"])
        self._use_ahead(held[first:])
        return blocks

    def _use_ahead(self, runs: Sequence[_Run]) -> None:
        """Use the frames that are ahead of the count, in order; those ahead of the newest run are out of place."""
        for run in runs:
            next_seq = self._next or 0
            behind = min(max(0, -_ahead(run.seq, next_seq)), run.end - run.begin)
            if _ahead(run.seq, runs[-1].seq) > 0 and _ahead(runs[-1].next_seq, next_seq) > 0:
                behind = run.end - run.begin
            self._count["frames_malformed"] += behind
            if behind < run.end - run.begin:
                self._use(replace(run, begin=run.begin + behind))

    def _use(self, run: _Run) -> None:
        """Account for a run that is next in order."""
        lost = 0 if self._next is None else (run.seq - self._next) % CIRCLE
        self._count.update(frames=run.end - run.begin, frames_lost=lost, loss_events=int(lost > 0))
        self._next = run.next_seq
        self._newest_us = int(run.times_us.max(initial=self._newest_us))
        if run.boot_id != NONE:
            self.segment.boot_id = run.boot_id
        self._due.append((run, self._count["frames_lost"]))

    # ------------------------------------------------------------------------------------------------ contents

    def _account(self) -> list[Blocks]:
        """Evaluate the frames that are due, all of one segment."""
        due, self._due = self._due, []
        blocks: list[Blocks] = []
        for _, several in groupby(due, key=lambda run: id(run[0].frames)):
            runs = list(several)
            frames = runs[0][0].frames
            index = np.concatenate([np.arange(run.begin, run.end) for run, _ in runs])
            lost = np.repeat([lost for _, lost in runs], [run.end - run.begin for run, _ in runs])
            begin = 0
            for k in np.flatnonzero(np.isin(index, list(frames.elements))).tolist():
                elements, kind = frames.elements[int(index[k])], int(frames.table["type"][index[k]])
                if kind == wire.IDENT:  # the frames behind it are of another description
                    blocks += self._samples(frames, index[begin:k], lost[begin:k])
                    begin = k
                    self._describe(elements)
                elif kind != NONE:
                    self._content(elements, kind)
            blocks += self._samples(frames, index[begin:], lost[begin:])
        return blocks

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
        for stream_id in np.unique(table["stream"][data]).tolist():
            rows = np.flatnonzero(data & (table["stream"] == stream_id))
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
        table = frames.table[index]
        n = table["samples_bytes"] // (4 * len(stream.channels))
        track = self._streams.setdefault(stream.id, StreamTrack())
        self._described[stream.id], track.period_ns = stream, int(table["period_ns"][-1])
        gap, run = track.take(table["n0"], n, table["t_us"], table["flags"], lost)
        single = np.flatnonzero(table["period_ns"] == 0).tolist()
        offsets = {k: frames.elements[int(index[k])][5].value for k in single}
        return Blocks(self.segment.index, ident, stream, frames.data, table, n, gap, run, offsets)


_TEMPERATURE_AT = wire.names(wire.HEARTBEAT)[1:].index("temperature_mdegc")


def segment_at(segments: Sequence[Segment], message: Ints) -> Ints:
    """Return the index of the segment to which messages (n,) of the session belong, by their index in it."""
    return np.searchsorted([segment.begin for segment in segments[1:]], message, "right")


def _frames_in(runs: Sequence[_Run]) -> int:
    return sum(run.end - run.begin for run in runs)


def _ahead(seq: int, before: int) -> int:
    """Return how far a seq is ahead of another, around the circle."""
    return (seq - before + CIRCLE // 2) % CIRCLE - CIRCLE // 2
