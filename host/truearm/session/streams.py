"""Assign the frames of a box to its boots, and convert them to blocks of samples and exact losses.

A link neither reorders nor doubles frames (SPEC §4). In a boot, ``seq`` counts up: a gap is a loss, and a frame behind
the count is malformed. A box states its boot id in a heartbeat once a second and in the ident that it sends at boot;
frames are held until then. If it is another, the box restarted where ``seq`` last falls back, or else jumps
farthest ahead. A new ``Segment`` begins there.

The data frames of a batch become ``Blocks``. ``StreamTrack`` counts their samples by ``n0``. Samples missing where
frames were lost are lost with them, others in the box. If ``n0`` falls back, another run began. Losses in the box
before the session's start are not counted.

The box's own counters in its heartbeats (SPEC §4) are summed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from truearm.errors import ProtocolError
from truearm.session.frames import NONE, Channel, Frames, Ident, Pages, Stream, decode_ident, frames_of, parse_exchange
from truearm.session.session_file import Messages
from truearm.types import Ints
from truearm_wire import messages as wire

WRAP = 2**30
_ELEMENTS = [entry.partition(":")[::2] for entry in wire.LAYOUT[wire.HEARTBEAT][1:]]  # name and type, after seq
COUNTERS = tuple(name for name, kind in _ELEMENTS if kind == "counter")
# element → what is kept of it, and the name of the result
EXTREMES: Mapping[str, tuple[Callable[..., Any], str]] = {
    name: (max, name) if kind == "largest" else (min, f"{name}_min")
    for name, kind in _ELEMENTS
    if kind in ("largest", "smallest")
}
# ------------------------------------------------------------------------------------------------------------- accounts


@dataclass(frozen=True)
class Losses:
    """Exact accounting of a session.

    A flipped bit causes one console run and one lost frame, a traceback in the stream one console run. Frames before
    the first one seen cannot be counted, except after a restart, where ``seq`` begins at 0.
    """

    frames: int = 0  # frames of any type received, each counted once
    frames_lost: int = 0  # gaps of seq
    loss_events: int = 0  # places where seq has a gap
    frames_malformed: int = 0  # frames with a valid CRC that violate the specification, or do not count up
    frames_unknown: int = 0  # of types unknown to this version
    blocks: int = 0
    samples: int = 0
    samples_lost: int = 0  # jumps of n0 with a gap of seq: lost with frames
    samples_overrun: int = 0  # jumps of n0 without a gap of seq: lost in the box
    blocks_without_ident: int = 0  # data of a stream without an ident: unusable
    converter_faults: int = 0  # blocks flagged by the box
    console_runs: int = 0  # runs of bytes that were not a frame
    console_text_runs: int = 0  # of these, the runs that are text
    console_bytes: int = 0
    restarts: int = 0
    starts: int = 0  # how often n0 began again without a restart
    sync_requests: int = 0
    sync_unanswered: int = 0
    plan_events_malformed: int = 0  # rows of the plan and events that cannot be used
    # Number of heartbeats, sum of every counter in them since the session began, worst of every extreme; or None
    box: Mapping[str, int | None] = field(default_factory=dict)


@dataclass(frozen=True)
class StreamReport:
    """A stream as received.

    ``period_ns`` is the value in its last block. ``measured_ns`` is the mean period by the box's stamps where nothing
    is missing, or NaN if there is no such part.
    """

    id: int
    name: str
    channels: tuple[str, ...]
    samples: int
    pieces: int  # gap-free pieces: 1 if no sample is missing
    period_ns: int
    measured_ns: float


@dataclass
class StreamTrack:
    """The current position of a stream and its account."""

    next_n0: int | None = None
    frames_lost: int = 0  # on the link, as of the last block
    counted: Counter[str] = field(default_factory=Counter)  # pieces, and entries of Losses
    joined: bool = False  # the box was sampling before the session began and has not been started by it yet
    period_ns: int = 0
    last_t0_us: int = 0
    last_n: int = 0
    whole_us: int = 0  # device time between blocks without a gap, and the samples in it
    whole_samples: int = 0

    def take(self, rows: NDArray[Any]) -> None:
        """Account for blocks (b,) of FRAME of one boot.

        Enters before which of them samples are missing, and the run of each.
        """
        n0, n, t0_us, flags, frames_lost = (rows[name] for name in ("n0", "n", "t_us", "flags", "lost"))
        joins = self.next_n0 is None  # a running box, or one that restarted: then it counts from 0
        with_frames = np.diff(frames_lost, prepend=self.frames_lost) > 0
        expected = np.append(n0[0] * (not with_frames[0]) if self.next_n0 is None else self.next_n0, (n0 + n)[:-1])
        begins = n0 < expected
        missing = np.where(begins, n0, n0 - expected)
        gap = (n0 != expected) | ((flags & wire.FLAG_OVERRUN) != 0)
        gap[0] |= joins
        rows["gap"], rows["run"] = gap, self.counted["starts"] + np.cumsum(begins)
        if joins:
            self.joined = not (self.counted["blocks"] or with_frames[0]) and n0[0] > 0
        of_session = np.ones(len(n0), bool)
        if self.joined and begins.any():  # what a box lost before it was started is not the session's
            of_session[: np.argmax(begins)] = False
            self.joined, self.counted["samples_overrun"], self.counted["pieces"] = False, 0, 0
        self.counted.update(
            blocks=len(n0),
            samples=int(n.sum()),
            samples_lost=int(missing[with_frames].sum()),
            samples_overrun=int(missing[~with_frames & of_session].sum()),
            pieces=int(np.count_nonzero(gap & of_session)),
            converter_faults=int(np.count_nonzero(flags & wire.FLAG_CONVERTER)),
            starts=int(np.count_nonzero(begins)),
        )
        gapless = ~gap
        self.whole_us += int(np.diff(t0_us, prepend=self.last_t0_us)[gapless].sum())
        self.whole_samples += int(np.append(self.last_n, n[:-1])[gapless].sum())
        self.next_n0, self.frames_lost = int(n0[-1] + n[-1]), int(frames_lost[-1])
        self.last_t0_us, self.last_n, self.period_ns = int(t0_us[-1]), int(n[-1]), int(rows["period_ns"][-1])

    def report(self, stream_id: int, described: Stream) -> StreamReport:
        """Return the account, under the name that an ident gives the stream."""
        return StreamReport(
            id=stream_id,
            name=described.name,
            channels=tuple(channel.name for channel in described.channels),
            samples=self.counted["samples"],
            pieces=self.counted["pieces"],
            period_ns=self.period_ns,
            measured_ns=1000.0 * self.whole_us / self.whole_samples if self.whole_samples else float("nan"),
        )


CIRCLE = 2**32  # seq wraps here
MOST_HELD = 8192  # frames without a boot id, which a box states every second


@dataclass(eq=False)
class Blocks:
    """Data frames (b,) of one stream, segment and ident, in order of sending.

    ``table`` (b,) of FRAME: ``n0`` and ``t_us`` are index and device time of the first sample, ``n`` the number of
    samples per channel; before a ``gap`` samples are missing. ``counts`` (Σ n, c): of ``channels``, some or all of the
    stream's.
    """

    segment: int
    ident: Ident
    stream: Stream
    channels: tuple[Channel, ...]
    table: NDArray[Any]
    counts: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.table)

    @cached_property
    def first(self) -> Ints:
        """Offset (b + 1,) of each block in ``counts``, and their length."""
        return np.append(0, np.cumsum(self.table["n"], dtype=np.int64))

    @cached_property
    def reach_ns(self) -> int:
        """The longest time from the first sample of a block to its last."""
        return int(self.table["n"].max()) * max(int(self.table["period_ns"].max()), self.stream.period_ns)

    def within_ns(self) -> Ints:
        """Return the time [ns] from the first sample of its block to each sample.

        The nominal period is used: 1000 ppm over 13 ms is 13 µs.
        """
        place = np.arange(len(self.counts)) - np.repeat(self.first[:-1], self.table["n"])
        return np.asarray(place * np.repeat(self.table["period_ns"], self.table["n"]))

    def gaps(self) -> NDArray[np.bool_]:
        """Return before which samples others are missing."""
        gap = np.zeros(len(self.counts), np.bool_)
        gap[self.first[:-1][self.table["gap"]]] = True
        return gap


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
    last_beat: Mapping[str, int] = field(default_factory=dict)


class BoxReader:
    """Processes the messages of the box and the clock batch by batch.

    ``ident`` describes the streams if the session has no ident frames before the data.
    """

    def __init__(self, ident: Ident | None = None) -> None:
        self.segments = [Segment(0, ident=ident)]
        self._count: Counter[str] = Counter()
        self._box_count: Counter[str] = Counter()
        self._worst: dict[str, int] = {}
        self._next: int | None = None  # seq of the next frame; None before the first
        self._held = Frames()  # until the box states its boot id
        self._messages = 0  # so far
        self._heard: list[Ints] = [np.empty((0, 5), np.int64)]  # message, and times of an exchange
        self._streams: dict[int, StreamTrack] = {}
        self._described: dict[int, Stream] = {}  # the same streams, by the ident of their newest block
        self._pages = Pages()
        # By thermometer, None for the box's: segment, device time [µs], m°C; edges of the output: segment, time, level
        self.temperatures: dict[str | None, list[tuple[int, int, int]]] = {None: []}
        self.output: list[tuple[int, int, int]] = []

    @property
    def segment(self) -> Segment:
        """The segment of the newest frame."""
        return self.segments[-1]

    def feed(self, messages: Messages) -> list[Blocks]:
        """Account for a batch and return the blocks of samples. Messages of other topics are ignored."""
        for data in messages.payloads(messages.rows(lambda topic: topic == "/box/console")):
            self._count.update(console_runs=1, console_bytes=len(data), console_text_runs=int(_is_text(data)))
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
        return self._use(self._held.followed_by(frames), MOST_HELD)

    def finish(self) -> list[Blocks]:
        """Return the blocks that are still held, at the end of the session."""
        return self._use(self._held, 0)

    def exchanges(self, segment: Segment) -> Ints:
        """Return the clock exchanges of a segment (k, 4): times of host write, device receive and send, and arrival."""
        rows = np.concatenate(self._heard)
        return np.asarray(rows[segment_at(self.segments, rows[:, 0]) == segment.index, 1:])

    def losses(self) -> Losses:
        """Return the losses so far."""
        total = sum((stream.counted for stream in self._streams.values()), self._count)
        count = {name: total[name] for name in Losses.__dataclass_fields__ if name != "box"}
        extremes = {key: self._worst.get(key) for _, key in EXTREMES.values()}
        return Losses(**count, box={name: self._box_count[name] for name in ("heartbeats", *COUNTERS)} | extremes)

    def streams(self) -> tuple[StreamReport, ...]:
        """Return the streams so far."""
        return tuple(track.report(k, self._described[k]) for k, track in sorted(self._streams.items()))

    # ------------------------------------------------------------------------------------------------ boots

    def _use(self, frames: Frames, held: int) -> list[Blocks]:
        """Account for frames up to the last that states the boot id and has one behind it; hold at most ``held``."""
        stated = np.flatnonzero(frames.table["boot_id"][: len(frames.table) - bool(held)] != NONE)
        end = max(int(stated[-1]) + 1 if stated.size else 0, len(frames.table) - held)
        self._held = Frames(frames.table[end:].copy(), frames.contents[end:])
        restarts, blocks = self._restarts(frames.table, stated), list[Blocks]()
        for begin, following in pairwise(sorted({0, *restarts, end})):
            if begin in restarts:
                self._begin_segment(int(frames.table["message"][begin]))
            blocks += self._contents(frames, self._in_order(frames.table, begin, following))
        return blocks

    def _restarts(self, table: NDArray[Any], stated: NDArray[np.intp]) -> list[int]:
        """Return the first frame of each further boot.

        It is the last one behind the count, or the farthest ahead, among those before the frame that states another
        boot id, back to the preceding statement.
        """
        seq, restarts = table["seq"], list[int]()
        jump = np.diff(seq, prepend=seq[:1] - 1 if self._next is None else self._next - 1) - 1
        known, begin = self.segment.boot_id, 0
        for row, boot_id in zip(stated.tolist(), table["boot_id"][stated].tolist(), strict=True):
            if boot_id != known:
                behind = np.flatnonzero(jump[begin : row + 1] < 0)
                if behind.size or known is not None:
                    restarts.append(begin + int(behind[-1] if behind.size else np.argmax(jump[begin : row + 1])))
            known, begin = boot_id, row + 1
        return restarts

    def _begin_segment(self, message: int) -> None:
        """Begin another boot, which counts from 0."""
        self._count["restarts"] += 1
        self.segments.append(Segment(len(self.segments), message, booted=True, ident=self.segment.ident))
        self._pages, self._next = Pages(), 0
        for stream in self._streams.values():
            stream.next_n0, stream.frames_lost = None, self._count["frames_lost"]

    def _in_order(self, table: NDArray[Any], begin: int, end: int) -> Ints:
        """Return which frames of one boot count up, and enter the frames lost in the session before each.

        A frame behind the count is malformed, and one ahead of the next frame (SPEC §1) or of the next that states the
        boot id.
        """
        seq, boot_id = table["seq"][begin : end + 1], table["boot_id"][begin:end]
        # A first frame that both following ones are behind is malformed itself.
        odd = self._next is None and end - begin > 2 and bool(np.all((seq[1:3] - seq[0]) % CIRCLE >= CIRCLE // 2))
        expected = seq[int(odd)] if self._next is None else self._next
        ahead = (seq - expected + CIRCLE // 2) % CIRCLE - CIRCLE // 2
        before, following = np.append(-1, ahead)[: end - begin], np.append(ahead, CIRCLE)[1 : end - begin + 1]
        ahead = ahead[: end - begin]
        ahead = np.where((before < following) & (following < ahead), -1, ahead)
        stated = np.flatnonzero(boot_id != NONE)
        stated = stated[ahead[stated] > np.maximum.accumulate(np.append(-1, ahead[stated][:-1]))]
        limit = np.append(ahead[stated], CIRCLE)[np.searchsorted(stated, np.arange(end - begin))]
        ahead = np.where(ahead <= limit, ahead, -1)
        rows = np.flatnonzero(ahead > np.maximum.accumulate(np.append(-1, ahead[:-1])))
        gaps = np.diff(ahead[rows], prepend=-1) - 1
        counted = begin + rows
        table["lost"][counted] = self._count["frames_lost"] + np.cumsum(gaps)
        self._count["frames_malformed"] += end - begin - len(rows)
        self._count.update(frames=len(rows), frames_lost=int(gaps.sum()), loss_events=int(np.count_nonzero(gaps)))
        if len(rows):
            self._next = (int(table["seq"][counted[-1]]) + 1) % CIRCLE
        stated = table["boot_id"][counted]
        if np.any(stated != NONE):
            self.segment.boot_id = int(stated.max())
        return counted

    # ------------------------------------------------------------------------------------------------ contents

    def _contents(self, frames: Frames, index: Ints) -> list[Blocks]:
        """Evaluate frames of one segment."""
        blocks: list[Blocks] = []
        begin = 0
        kinds = frames.table["type"][index]
        for k in np.flatnonzero(~np.isin(kinds, (wire.DATA, wire.SYNC_REPLY, NONE))).tolist():
            elements, kind = frames.contents[int(index[k])], int(kinds[k])
            if kind == wire.IDENT:  # the frames behind it are of another description
                blocks += self._samples(frames, index[begin:k])
                begin = k
                self._describe(elements)
            else:
                self._content(elements, kind)
        return blocks + self._samples(frames, index[begin:])

    def _content(self, elements: list[Any], kind: int) -> None:
        """Take a frame that was decoded singly, except pages of an ident."""
        segment = self.segment
        if kind == wire.HEARTBEAT:
            beat = {name: value for (name, _), value in zip(_ELEMENTS, elements[2:], strict=False)}
            self._take_heartbeat(beat)
            self.temperatures[None].append((segment.index, beat["t_us"], beat["temperature_mdegc"]))
        elif kind == wire.EVENT and elements[2] == wire.OUTPUT_LINE:
            self.output.append((segment.index, elements[3], bool(elements[4])))
        elif kind == wire.TEMPERATURE:
            names = () if segment.ident is None else segment.ident.thermometers
            if 0 <= elements[3] < len(names):
                self.temperatures.setdefault(names[elements[3]], []).append((segment.index, elements[2], elements[4]))
        elif kind not in wire.LAYOUT:
            self._count["frames_unknown"] += 1

    def _take_heartbeat(self, beat: Mapping[str, int]) -> None:
        """Add what a box counted since its last heartbeat, or since its boot if that was in the session."""
        preceding = self.segment.last_beat or ({} if self.segment.booted else beat)
        self.segment.last_beat = beat
        self._box_count["heartbeats"] += 1
        for name in COUNTERS:
            self._box_count[name] += (beat.get(name, 0) - preceding.get(name, 0)) % WRAP
        for name in EXTREMES.keys() & beat.keys():
            extreme, key = EXTREMES[name]
            self._worst[key] = extreme(self._worst.get(key, beat[name]), beat[name])

    def _describe(self, elements: list[Any]) -> None:
        """Take a page of an ident. The box sends one unprompted, with req_id 0, at boot (SPEC §5)."""
        self.segment.booted |= elements[2:4] == [0, 0]
        document = self._pages.push(*elements[2:6])
        if document is None:
            return
        try:
            self.segment.ident = decode_ident(document)
        except ProtocolError:
            self._count["frames_malformed"] += 1

    def _samples(self, frames: Frames, index: Ints) -> list[Blocks]:
        """Account for the data frames of each stream."""
        blocks: list[Blocks] = []
        index, ident = index[frames.table["type"][index] == wire.DATA], self.segment.ident
        of_stream = frames.table["stream"][index]
        for stream_id in np.unique(of_stream).tolist():
            rows = index[of_stream == stream_id]
            if ident is None or stream_id not in ident.streams:
                self._count["blocks_without_ident"] += len(rows)
                continue
            stream = self._described[stream_id] = ident.streams[stream_id]
            n, remainder = np.divmod(frames.table["samples_bytes"][rows], 4 * len(stream.channels))
            complete = (remainder == 0) & (n > 0)  # the frame holds whole samples
            self._count["frames_malformed"] += int(np.count_nonzero(~complete))
            if complete.any():
                table = frames.table[rows[complete]]
                table["n"] = n[complete]
                self._streams.setdefault(stream_id, StreamTrack()).take(table)
                samples = b"".join([frames.contents[k] for k in rows[complete].tolist()])
                counts = np.frombuffer(samples, "<i4").reshape(-1, len(stream.channels))
                blocks.append(Blocks(self.segment.index, ident, stream, stream.channels, table, counts))
        return blocks


def segment_at(segments: Sequence[Segment], message: Ints) -> Ints:
    """Return the index of the segment to which messages (n,) of the session belong, by their index in it."""
    return np.searchsorted([segment.begin for segment in segments[1:]], message, "right")


def _is_text(data: bytes) -> bool:
    """Return whether the bytes are text printed by a program rather than a damaged frame."""
    try:
        text = data.decode()
    except UnicodeDecodeError:
        return False
    return all(character.isprintable() or character.isspace() for character in text)
