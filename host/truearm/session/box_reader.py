"""Convert box messages in order of arrival to blocks of samples, clock exchanges and exact losses.

``FrameOrder`` restores the order of sending and reports missing frames and restarts of the box. Each restart begins a
new **segment**. A batch of messages becomes columns with one row per data frame of one stream, one segment and one
ident.

``n0`` counts samples. If it jumps and frames were lost since the stream's last block, the samples were lost with them;
if no frames were lost, the box overran. If ``n0`` falls back without a restart, a new ``start`` began, and with it a
new **run**. Device time is valid within a segment. Samples are complete within a run between blocks marked ``gap``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from truearm.errors import ProtocolError
from truearm.session.box_frames import MAX_DEVICE_US, Pages, data_of, is_text, parse_exchanges
from truearm.session.box_ident import Ident, Stream, decode_ident
from truearm.session.frame_columns import FrameRun, Frames, frames_of, heartbeat_values
from truearm.session.frame_order import FrameOrder, Placed
from truearm.session.losses import COUNTED, Heartbeats, Losses, StreamReport, StreamTrack
from truearm.session.message_columns import Messages
from truearm.types import Ints
from truearm_wire import messages as wire


@dataclass(frozen=True, eq=False)
class Blocks:
    """Data frames (b,) of one stream, segment and ident, in order of sending: ``n`` samples per channel, from number
    ``n0`` on.

    ``gap``: samples before the block are missing. If ``period_ns`` is 0, the block's ``offsets_us`` hold the sample
    times. ``at``: index of the message in the batch that released the block.
    """

    segment: int
    ident: Ident
    stream: Stream
    run: Ints
    gap: NDArray[np.bool_]
    n: Ints
    n0: Ints
    t0_us: Ints
    period_ns: Ints
    flags: Ints
    t_host_ns: Ints
    at: Ints
    data: bytes
    samples_at: Ints
    offsets_us: dict[int, bytes]

    def __len__(self) -> int:
        return len(self.n)

    @property
    def first(self) -> Ints:
        """Offset of each block in ``counts``."""
        return np.asarray(np.cumsum(self.n) - self.n)

    def part(self, begin: int, end: int) -> Blocks:
        """Return the blocks in a range."""
        cut = slice(begin, end)
        columns = ("run", "gap", "n", "n0", "t0_us", "period_ns", "flags", "t_host_ns", "at", "samples_at")
        offsets = {k - begin: value for k, value in self.offsets_us.items() if begin <= k < end}
        return replace(self, **{name: getattr(self, name)[cut] for name in columns}, offsets_us=offsets)

    def counts(self) -> NDArray[np.int32]:
        """Return all samples as (Σ n, channels)."""
        channels = len(self.stream.channels)
        sizes = np.unique(self.n)
        if len(sizes) == 1:
            return self._counts_at(self.samples_at, int(sizes[0])).reshape(-1, channels)
        found = np.empty((int(self.n.sum()), channels), np.int32)
        for size in sizes.tolist():
            alike = np.flatnonzero(self.n == size)
            rows = self.first[alike][:, None] + np.arange(size)
            found[rows] = self._counts_at(self.samples_at[alike], size).reshape(len(alike), size, channels)
        return found

    def _counts_at(self, at: Ints, n: int) -> NDArray[np.int32]:
        window = np.lib.stride_tricks.sliding_window_view(
            np.frombuffer(self.data, np.uint8), 4 * n * len(self.stream.channels)
        )
        return np.asarray(window[at]).view("<i4")

    def within_ns(self) -> Ints:
        """Return the time from the first sample of its block to each sample [ns].

        The nominal period is used: 1000 ppm over 13 ms is 13 µs.
        """
        place = np.arange(int(self.n.sum())) - np.repeat(self.first, self.n)
        within = place * np.repeat(self.period_ns, self.n)
        for block, offsets in self.offsets_us.items():
            begin = int(self.first[block])
            within[begin : begin + int(self.n[block])] = 1000 * np.frombuffer(offsets, "<u2").astype(np.int64)
        return within


@dataclass
class Segment:
    """The time of the box from one boot to the next."""

    index: int
    booted: bool = False  # the box booted within the session
    boot_id: int | None = None
    ident: Ident | None = None
    heard: list[Ints] = field(
        default_factory=list
    )  # (k, 4) each: times of host write, device receive, device send, host arrival
    output: list[tuple[int, bool]] = field(default_factory=list)  # edges of the trigger output: device time [µs], level
    temperatures: dict[str, list[tuple[int, int]]] = field(
        default_factory=dict
    )  # by thermometer: device time [µs], m°C

    @property
    def exchanges(self) -> Ints:
        """Clock exchanges (k, 4): times of host write, device receive, device send and host arrival."""
        return np.concatenate([np.empty((0, 4), np.int64), *self.heard])


class BoxReader:
    """Processes the messages of the box and the clock batch by batch; see the module docstring for the rules.

    ``ident`` describes the streams if the session has no ident frames before the data. Set ``keep_exchanges`` to False
    to leave out the exchanges, which a second pass does not need.
    """

    def __init__(self, ident: Ident | None = None, keep_exchanges: bool = True) -> None:
        self._segment = Segment(0, ident=ident)
        self.segments = [self._segment]
        self._keep_exchanges = keep_exchanges
        self._count: Counter[str] = Counter()
        self._order = FrameOrder()
        self._exchanges = _Exchanges()
        self._aside: list[Ints] = []  # exchanges that arrived while it was undecided whether the box had restarted
        self._restarted_at: list[int] = []  # messages of the newest batch that begin segments
        self._streams: dict[int, StreamTrack] = {}
        self._described: dict[int, Stream] = {}  # the same streams, by the ident of their newest block
        self._pages = Pages()
        self._heartbeats = Heartbeats()
        self._placed: list[
            tuple[Placed, int]
        ] = []  # usual frames still to be accounted for, and the frames lost before each
        self._blocks: list[Blocks] = []
        self._batch: Messages | None = None

    @property
    def segment(self) -> Segment:
        """The segment of the last message."""
        return self._segment

    def feed(self, messages: Messages) -> list[Blocks]:
        """Account for a batch and return the blocks of samples that are now due. Messages of other topics are ignored."""
        self._batch = messages
        frames = frames_of(messages)
        self._count["frames_malformed"] += frames.malformed
        self._console(messages)
        self._restarted_at = []
        if self._keep_exchanges:
            requests, unanswered = self._exchanges.take(messages)
            self._count.update(sync_requests=requests, sync_unanswered=unanswered)
        for run in frames.runs():
            for part in self._order.parts(run):
                self._hear_until(part.row)
                for placed in self._order.take(part):
                    self._place(placed, part)
                if self._aside and not self._order.undecided:
                    self._hear_aside()
        self._hear_until(len(messages))
        return self._accounted()

    def finish(self) -> list[Blocks]:
        """Return the blocks held back for late frames, at the end of the session."""
        end = 0 if self._batch is None else len(self._batch)
        for placed in self._order.finish(end):
            self._place(placed, None)
        self._hear_aside()
        return self._accounted()

    def segment_at(self, rows: NDArray[np.intp]) -> Ints:
        """Return the current segment at messages (k,) of the newest batch."""
        begun = len(self._restarted_at)
        return self._segment.index - begun + np.searchsorted(self._restarted_at, rows, side="right")

    def losses(self) -> Losses:
        """Return the losses so far."""
        box = self._heartbeats.summary({s.index for s in self.segments if s.booted})
        order = self._order
        count = self._count + Counter(
            frames_duplicated=order.doubled, frames_late=order.late, frames_malformed=order.malformed
        )
        known = {name: count[name] for name in Losses.__dataclass_fields__ if name != "box"}
        for name in COUNTED:
            known[name] = sum(getattr(stream, name) for stream in self._streams.values())
        return Losses(**known, box=box)

    def temperatures(self) -> Mapping[int, Sequence[tuple[int, int]]]:
        """Return the box temperatures from the heartbeats of each segment so far: device time [µs] and m°C."""
        return self._heartbeats.temperatures

    def streams(self) -> tuple[StreamReport, ...]:
        """Return the streams so far."""
        return tuple(track.report(k, self._described[k]) for k, track in sorted(self._streams.items()))

    # ------------------------------------------------------------------------------------------------ frames

    def _place(self, placed: Placed, arriving: FrameRun | None) -> None:
        """Account for frames in their order: usual frames together later, others now."""
        if placed.restarts:
            self._account()
            self._restart(placed.at, None if placed.waited else arriving)
        self._count["frames"] += len(placed.run)
        self._count["frames_lost"] += placed.lost
        self._count["loss_events"] += placed.lost > 0
        run = placed.run
        elements = run.frames.single.get(run.begin)
        if elements is not None:
            self._account()
            self._segment.booted |= run.is_boot
            self._content(elements, placed.at, arriving)
            return
        beat, boot_id = run.first_heartbeat()
        if boot_id is not None:
            if self.segment.boot_id not in (None, boot_id) and beat > run.begin:
                self._placed.append(
                    (placed._replace(run=FrameRun(run.frames, run.begin, beat)), self._count["frames_lost"])
                )
                placed = placed._replace(run=FrameRun(run.frames, beat, run.end))
            at = max(placed.at, int(run.frames.row[beat])) if run.frames.messages is self._batch else placed.at
            self._boot_id(boot_id, at, arriving)
        self._placed.append((placed, self._count["frames_lost"]))

    def _content(self, elements: list[Any], at: int, arriving: FrameRun | None) -> None:
        kind = elements[0]
        if kind == wire.DATA:
            self._count["frames_malformed" if data_of(elements) is None else "blocks_without_ident"] += 1
        elif kind == wire.HEARTBEAT:
            values = heartbeat_values(elements)
            if values is None:
                self._count["frames_malformed"] += 1
            else:
                self._boot_id(values[0], at, arriving)
                self._heartbeats.take(self.segment.index, values)
        elif kind == wire.EVENT:
            self._event(elements)
        elif kind == wire.TEMPERATURE:
            self._temperature(elements)
        elif kind == wire.IDENT:
            self._ident_page(elements, at, arriving)
        elif kind not in wire.LAYOUT:
            self._count["frames_unknown"] += 1

    def _restart(self, at: int, arriving: FrameRun | None) -> None:
        if arriving is not None:
            if at > arriving.row and not self._order.undecided:
                self._hear_aside()
            self._hear_until(at)
        self._restarted_at.append(at)
        self._count["restarts"] += 1
        self._segment = Segment(len(self.segments), booted=True, ident=self.segment.ident)
        self.segments.append(self._segment)
        self._pages = Pages()
        for stream in self._streams.values():
            stream.restart(self._count["frames_lost"])

    def _boot_id(self, boot_id: int, at: int, arriving: FrameRun | None) -> None:
        if self.segment.boot_id not in (None, boot_id):
            self._account()
            self._restart(at, arriving)
        self.segment.boot_id = boot_id
        self._order.new_boot(boot_id)

    # ------------------------------------------------------------------------------------------------ contents

    def _accounted(self) -> list[Blocks]:
        self._account()
        blocks, self._blocks = self._blocks, []
        return blocks

    def _account(self) -> None:
        """Account for the usual frames that are in order."""
        waiting, self._placed = self._placed, []
        for _, parts in groupby(waiting, key=lambda part: id(part[0].run.frames)):
            self._account_for(list(parts))

    def _account_for(self, parts: list[tuple[Placed, int]]) -> None:
        """Account for runs of one batch."""
        frames = parts[0][0].run.frames
        index = np.concatenate([np.arange(placed.run.begin, placed.run.end) for placed, _ in parts])
        n = [len(placed.run) for placed, _ in parts]
        lost = np.repeat([lost for _, lost in parts], n)
        at = np.repeat([placed.at for placed, _ in parts], n)
        if frames.messages is self._batch:
            at = np.maximum(at, frames.row[index])
        for beat in index[frames.boot_id[index] >= 0].tolist() if frames.beats else ():
            self._heartbeats.take(self.segment.index, frames.heartbeats[beat])
        kind = np.where(frames.is_data[index], frames.kind[index], -1)
        ident = self._segment.ident
        for stream_id in np.unique(kind[kind >= 0]).tolist():
            mine = np.flatnonzero(kind == stream_id)
            if ident is None or stream_id not in ident.streams:
                self._count["blocks_without_ident"] += len(mine)
            else:
                self._stream(frames, index[mine], lost[mine], at[mine], ident, ident.streams[stream_id])

    def _stream(self, frames: Frames, index: Ints, lost: Ints, at: Ints, ident: Ident, stream: Stream) -> None:
        """Account for the data frames of one stream."""
        n, rest = np.divmod(frames.samples_bytes[index], 4 * len(stream.channels))
        period_ns = frames.period_ns[index]
        whole = (rest == 0) & (n > 0)
        for k in np.flatnonzero(period_ns == 0).tolist():
            whole[k] &= len(frames.offsets_us[int(index[k])]) == 2 * n[k]
        if not whole.all():
            self._count["frames_malformed"] += int(np.count_nonzero(~whole))
            index, lost, at, n, period_ns = index[whole], lost[whole], at[whole], n[whole], period_ns[whole]
        track = self._streams.setdefault(stream.id, StreamTrack())
        self._described[stream.id] = stream
        if not len(index):
            return
        n0, t0_us, flags = frames.n0[index], frames.t_us[index], frames.flags[index]
        gap, run = track.take(n0, n, t0_us, flags, lost)
        track.period_ns = int(period_ns[-1])
        offsets = {k: frames.offsets_us[int(index[k])] for k in np.flatnonzero(period_ns == 0).tolist()}
        self._blocks.append(
            Blocks(
                segment=self._segment.index,
                ident=ident,
                stream=stream,
                run=run,
                gap=gap,
                n=n,
                n0=n0,
                t0_us=t0_us,
                period_ns=period_ns,
                flags=flags,
                t_host_ns=frames.t_host_ns[index],
                at=at,
                data=frames.messages.data,
                samples_at=frames.samples_at[index],
                offsets_us=offsets,
            )
        )

    def _event(self, frame: list[Any]) -> None:
        if len(frame) < 5 or any(type(v) is not int for v in frame[2:5]) or not 0 <= frame[3] < MAX_DEVICE_US:
            self._count["frames_malformed"] += 1
        elif frame[2] == wire.OUTPUT_LINE and self._keep_exchanges:
            self.segment.output.append((frame[3], bool(frame[4])))

    def _temperature(self, frame: list[Any]) -> None:
        if len(frame) < 5 or any(type(v) is not int for v in frame[2:5]) or not 0 <= frame[2] < MAX_DEVICE_US:
            self._count["frames_malformed"] += 1
            return
        _, _, t_us, number, mdegc = frame[:5]
        names = () if self.segment.ident is None else self.segment.ident.thermometers
        if self._keep_exchanges and 0 <= number < len(names):
            self.segment.temperatures.setdefault(names[number], []).append((t_us, mdegc))

    def _ident_page(self, frame: list[Any], at: int, arriving: FrameRun | None) -> None:
        if len(frame) < 6 or any(type(v) is not int for v in frame[2:5]) or type(frame[5]) is not bytes:
            self._count["frames_malformed"] += 1
            return
        document = self._pages.push(*frame[2:6])
        if document is None:
            return
        try:
            ident = decode_ident(document)
        except ProtocolError:
            self._count["frames_malformed"] += 1
            return
        self._boot_id(ident.boot_id, at, arriving)
        self.segment.ident = ident

    # ------------------------------------------------------------------------------------------------ not frames

    def _console(self, messages: Messages) -> None:
        for data in messages.payloads(messages.rows(lambda topic: topic == "/box/console")):
            self._count.update(console_runs=1, console_bytes=len(data), console_text_runs=int(is_text(data)))

    def _hear_until(self, row: int) -> None:
        """Assign the clock exchanges before a message to the current segment, if that segment is known."""
        exchanges = self._exchanges.before(row)
        if self._order.undecided:
            self._aside.append(exchanges)
        elif len(exchanges):
            self.segment.heard.append(exchanges)

    def _hear_aside(self) -> None:
        """Assign the exchanges that arrived while it was undecided whether the box had restarted."""
        self.segment.heard += [exchanges for exchanges in self._aside if len(exchanges)]
        self._aside = []


class _Exchanges:
    """The clock exchanges of a batch."""

    def __init__(self) -> None:
        self._rows: Ints = np.empty(0, np.int64)
        self._times: Ints = np.empty((0, 4), np.int64)
        self._next = 0

    def take(self, messages: Messages) -> tuple[int, int]:
        """Return the number of exchanges and how many of them were unanswered."""
        rows = messages.rows(lambda topic: topic == "/sync")
        found = parse_exchanges(messages.payloads(rows))
        answered = np.array([i for i, one in enumerate(found) if one is not None], dtype=np.intp)
        self._times = np.array([one for one in found if one is not None], dtype=np.int64).reshape(-1, 4)
        self._rows, self._next = rows[answered], 0
        return len(rows), len(rows) - len(answered)

    def before(self, row: int) -> Ints:
        """Return the times (k, 4) of the exchanges before a message that have not been returned yet."""
        first, self._next = self._next, max(self._next, int(np.searchsorted(self._rows, row)))
        return self._times[first : self._next]
