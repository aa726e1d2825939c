"""The reader of single messages, the reference for the reader of columns: the same rules, each written for one frame.

Box messages in the order of their arrival → blocks of samples, clock exchanges and exact losses.

``frame_order`` puts the frames into the order of sending, reports what is missing between them and where the box
restarted. A new **segment** begins there.

``n0`` counts samples. At a jump with frames lost since the stream's last block, the samples were lost with them;
without lost frames, the box overran. An ``n0`` that decreases without a restart is a new ``start``, a new **run**.
Device time belongs to a segment; within a run samples are complete between blocks marked ``gap``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from oracle_frame_order import Frame, FrameOrder, Placed

from truearm.errors import ProtocolError
from truearm.session.box_frames import (
    MAX_DEVICE_US,
    Data,
    Exchange,
    Pages,
    boot_id,
    data_of,
    decode,
    device_time,
    is_boot,
    is_echo,
    is_text,
    parse_exchange,
    usual_data,
)
from truearm.session.box_ident import Ident, Stream, decode_ident
from truearm.session.losses import COUNTED, Heartbeats, Losses, StreamReport
from truearm.types import Message
from truearm_wire import messages as wire

_HEARTBEAT_VALUES = len(wire.names(wire.HEARTBEAT)) - 1  # without seq
_HEARTBEAT_NEEDED = wire.needed(wire.HEARTBEAT) - 1  # from a box of any minor version


class Block(NamedTuple):
    """The samples of one data frame: ``n`` of ``channels`` channels. ``gap``: samples before this block are missing."""

    segment: int
    run: int
    gap: bool
    n: int
    channels: int
    t_host_ns: int
    data: Data
    ident: Ident  # in force when the block was sent

    @property
    def counts(self) -> NDArray[np.int32]:
        """Return the samples as (n, channels)."""
        return np.frombuffer(self.data.samples, "<i4").reshape(self.n, self.channels)


@dataclass
class Segment:
    """One life of the box, from boot to reboot."""

    index: int
    booted: bool = False  # within the session
    boot_id: int | None = None
    ident: Ident | None = None
    exchanges: list[Exchange] = field(default_factory=list)
    output: list[tuple[int, bool]] = field(default_factory=list)  # edges of the trigger output: device time [µs], level
    temperatures: dict[str, list[tuple[int, int]]] = field(default_factory=dict)  # device time [µs], m°C


@dataclass
class StreamTrack:
    """The state of a stream, and its account."""

    next_n0: int | None = None
    frames_lost: int = 0  # on the link, when the last block arrived
    run: int = 0
    pieces: int = 0
    blocks: int = 0
    samples: int = 0
    samples_lost: int = 0
    samples_overrun: int = 0
    converter_faults: int = 0
    starts: int = 0
    joined: bool = False  # the box was sampling before the session began, and was not yet started by it
    period_ns: int = 0
    last_t0_us: int = 0
    last_n: int = 0
    whole_us: int = 0  # device time between blocks without a gap, and the number of samples in it
    whole_samples: int = 0

    def take(self, data: Data, n: int, frames_lost: int) -> bool:
        """Account for a block of n samples; return whether samples are missing before it."""
        gap = not (data.n0 == self.next_n0 and frames_lost == self.frames_lost and not data.flags)
        gap = gap and self._unusual(data, frames_lost)
        if gap:
            self.pieces += 1
        else:
            self.whole_us += data.t0_us - self.last_t0_us
            self.whole_samples += self.last_n
        self.blocks += 1
        self.samples += n
        self.next_n0, self.last_t0_us, self.last_n, self.period_ns = data.n0 + n, data.t0_us, n, data.period_ns
        return gap

    def restart(self, frames_lost: int) -> None:
        """Account for a restart of the box; ``n0`` counts from 0 again."""
        self.next_n0, self.frames_lost = None, frames_lost

    def _unusual(self, data: Data, frames_lost: int) -> bool:
        """Account for what is missing before a block; return whether anything is."""
        with_frames, self.frames_lost = frames_lost != self.frames_lost, frames_lost
        self.converter_faults += bool(data.flags & wire.FLAG_CONVERTER)
        expected = self.next_n0
        if expected is None:
            # Joined, or restarted. Without a lost frame the box had been sampling before the session began.
            missing = data.n0 if with_frames else 0
            self.joined = not (self.blocks or with_frames) and data.n0 > 0
        elif data.n0 < expected:
            self.starts += 1
            self.run += 1
            if self.joined:
                self.joined, self.samples_overrun, self.pieces = False, 0, 0
            missing = data.n0
        else:
            missing = data.n0 - expected
        if with_frames:
            self.samples_lost += missing
        else:
            self.samples_overrun += missing
        return data.n0 != expected or bool(data.flags & wire.FLAG_OVERRUN)

    def report(self, stream_id: int, described: Stream) -> StreamReport:
        """Return the account, under the stream's name in an ident."""
        return StreamReport(
            id=stream_id,
            name=described.name,
            channels=tuple(channel.name for channel in described.channels),
            samples=self.samples,
            pieces=self.pieces,
            period_ns=self.period_ns,
            measured_ns=1000.0 * self.whole_us / self.whole_samples if self.whole_samples else float("nan"),
        )


class BoxReader:
    """Takes the messages of box and clock one by one in log order; the module's text has the rules.

    ``ident`` describes the streams if the session contains no ident frames before the data. ``keep_exchanges`` False
    omits the exchanges (a second pass does not need them).
    """

    def __init__(self, ident: Ident | None = None, keep_exchanges: bool = True) -> None:
        self._segment = Segment(0, ident=ident)
        self.segments = [self._segment]
        self._keep_exchanges = keep_exchanges
        self._count: Counter[str] = Counter()
        self._order = FrameOrder()
        self._aside: list[bytes] = []  # exchanges that arrived while it was undecided whether the box had restarted
        self._streams: dict[int, StreamTrack] = {}
        self._described: dict[int, Stream] = {}
        self._layout: dict[int, tuple[int, StreamTrack]] = {}  # channels and track by the current ident
        self._pages = Pages()
        self._heartbeats = Heartbeats()

    @property
    def segment(self) -> Segment:
        """The segment of the last message."""
        return self._segment

    def feed(self, message: Message) -> Sequence[Block]:
        """Account for one message; return the blocks of samples that are due. Messages of other topics are ignored."""
        topic = message.topic
        if topic.startswith("/box/"):
            if topic != "/box/console":
                return self._frame(message)
            self._console(message.data)
        elif topic == "/sync":
            if self._order.undecided:
                self._aside.append(message.data)
            else:
                self._exchange(message.data)
        return ()

    def finish(self) -> Sequence[Block]:
        """Return the blocks that were held back for late frames, at the end of the session."""
        return self._placed(self._order.finish())

    def losses(self) -> Losses:
        """Return the current account."""
        box = self._heartbeats.summary({s.index for s in self.segments if s.booted})
        order = self._order
        count = self._count + Counter(
            frames_duplicated=order.doubled, frames_late=order.late, frames_malformed=order.malformed
        )
        known = {name: count[name] for name in Losses.__dataclass_fields__ if name != "box"}
        for name in COUNTED:
            known[name] = sum(getattr(stream, name) for stream in self._streams.values())
        return Losses(**known, box=box)

    def streams(self) -> tuple[StreamReport, ...]:
        """Return the current streams."""
        return tuple(stream.report(k, self._described[k]) for k, stream in sorted(self._streams.items()))

    # ------------------------------------------------------------------------------------------------ frames

    def _frame(self, message: Message) -> Sequence[Block]:
        payload = message.data
        data = usual_data(payload)
        if data is not None:
            stamp = data.stream, data.t0_us
            if self._order.follows(data.seq, stamp, message.t_host_ns, payload):
                self._count["frames"] += 1
                block = self._data(data, message.t_host_ns)
                return () if block is None else (block,)
            return self._take(Frame(data.seq, stamp, False, None, message.t_host_ns, payload, data))
        frame = decode(payload)
        if frame is None or is_echo(frame):
            self._count["frames_malformed"] += 1
            return ()
        return self._take(
            Frame(frame[1], device_time(frame), is_boot(frame), boot_id(frame), message.t_host_ns, payload, frame)
        )

    def _take(self, frame: Frame) -> Sequence[Block]:
        return self._placed(self._order.take(frame))

    def _placed(self, due: Iterable[Placed]) -> list[Block]:
        """Account for frames in their order; return the blocks among them."""
        blocks = []
        for frame, lost, restarts in due:
            if restarts:
                self._restart()
            self._count["frames"] += 1
            self._count["frames_lost"] += lost
            self._count["loss_events"] += lost > 0
            self._segment.booted |= frame.is_boot
            block = self._content(frame)
            if block is not None:
                blocks.append(block)
        if self._aside and not self._order.undecided:
            exchanges, self._aside = self._aside, []
            for data in exchanges:
                self._exchange(data)
        return blocks

    def _content(self, frame: Frame) -> Block | None:
        if isinstance(frame.content, Data):
            return self._data(frame.content, frame.t_host_ns)
        kind = frame.content[0]
        if kind == wire.DATA:
            return self._data(data_of(frame.content), frame.t_host_ns)
        if kind == wire.HEARTBEAT:
            self._heartbeat(frame.content)
        elif kind == wire.EVENT:
            self._event(frame.content)
        elif kind == wire.TEMPERATURE:
            self._temperature(frame.content)
        elif kind == wire.IDENT:
            self._ident_page(frame.content)
        elif kind not in wire.LAYOUT:
            self._count["frames_unknown"] += 1
        return None

    def _restart(self) -> None:
        self._count["restarts"] += 1
        self._segment = Segment(len(self.segments), booted=True, ident=self.segment.ident)
        self.segments.append(self._segment)
        self._pages = Pages()
        for stream in self._streams.values():
            stream.restart(self._count["frames_lost"])

    def _boot_id(self, boot_id: int) -> None:
        if self.segment.boot_id not in (None, boot_id):
            self._restart()
        self.segment.boot_id = boot_id
        self._order.new_boot(boot_id)

    # ------------------------------------------------------------------------------------------------ contents

    def _data(self, data: Data | None, t_host_ns: int) -> Block | None:
        if data is None:
            self._count["frames_malformed"] += 1
            return None
        channels, stream = self._layout.get(data.stream) or self._described_now(data.stream)
        if stream is None:
            self._count["blocks_without_ident"] += 1
            return None
        n, rest = divmod(len(data.samples), 4 * channels)
        if rest or n == 0 or not (data.period_ns or len(data.offsets_us) == 2 * n):
            self._count["frames_malformed"] += 1
            return None
        gap = stream.take(data, n, self._count["frames_lost"])
        assert self._segment.ident is not None  # which describes the stream
        return Block(self._segment.index, stream.run, gap, n, channels, t_host_ns, data, self._segment.ident)

    def _described_now(self, stream_id: int) -> tuple[int, StreamTrack | None]:
        """Return a stream's number of channels by the current ident, and its track; none if the ident lacks it."""
        ident = self._segment.ident
        described = None if ident is None else ident.streams.get(stream_id)
        if described is None:
            return 0, None
        found = len(described.channels), self._streams.setdefault(stream_id, StreamTrack())
        self._described[stream_id] = described
        self._layout[stream_id] = found
        return found

    def _heartbeat(self, frame: list[Any]) -> None:
        values = frame[2 : 2 + _HEARTBEAT_VALUES]
        if len(values) < _HEARTBEAT_NEEDED or any(type(value) is not int for value in values):
            self._count["frames_malformed"] += 1
            return
        self._boot_id(values[0])
        self._heartbeats.take(self.segment.index, values)

    def _event(self, frame: list[Any]) -> None:
        if len(frame) < 5 or any(type(v) is not int for v in frame[2:5]) or not 0 <= frame[3] < MAX_DEVICE_US:
            self._count["frames_malformed"] += 1
        elif frame[2] == wire.OUTPUT_LINE and self._keep_exchanges:
            self.segment.output.append((frame[3], bool(frame[4])))

    def _temperature(self, frame: list[Any]) -> None:
        if len(frame) < 5 or any(type(v) is not int for v in frame[2:5]) or not 0 <= frame[2] < MAX_DEVICE_US:
            self._count["frames_malformed"] += 1
            return
        names = () if self.segment.ident is None else self.segment.ident.thermometers
        if self._keep_exchanges and 0 <= frame[3] < len(names):
            self.segment.temperatures.setdefault(names[frame[3]], []).append((frame[2], frame[4]))

    def _ident_page(self, frame: list[Any]) -> None:
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
        self._boot_id(ident.boot_id)
        self.segment.ident = ident
        self._layout.clear()

    # ------------------------------------------------------------------------------------------------ not frames

    def _console(self, data: bytes) -> None:
        self._count.update(console_runs=1, console_bytes=len(data), console_text_runs=int(is_text(data)))

    def _exchange(self, data: bytes) -> None:
        exchange = parse_exchange(data)
        self._count.update(sync_requests=1, sync_unanswered=exchange is None)
        if exchange is not None and self._keep_exchanges:
            self.segment.exchanges.append(exchange)
