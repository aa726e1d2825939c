"""Box messages in the order of their arrival → blocks of samples, clock exchanges and exact losses.

Every frame from the box counts in one ``seq`` (SPEC §4), so each is looked at, whatever its type:

- ``seq`` one on: the next frame. A jump ahead by less than half the circle: frames lost on the link.
- a ``seq`` of one of the last 64 frames with the same bytes: a frame that was doubled, ignored.
- any other step back, the ident that a box sends unasked at boot, device time that runs backward within one kind of
  frame, or a new boot id: the box restarted.
  A new **segment** begins; its ``seq`` counts from 0, so frames missing at its beginning are known too.

``n0`` counts samples. A jump with frames lost since the stream's last block: the samples went with them; without: the box
overran. ``n0`` that falls back without a restart is a new ``start``, a new **run**. Device time belongs to a segment;
samples are whole within a run between blocks marked ``gap``.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.errors import ProtocolError
from truearm.session.box_ident import Ident, Stream, decode_ident
from truearm.session.box_messages import Exchange, device_time, is_boot, is_echo, is_text, parse_exchange
from truearm.session.data_frames import MAX_DEVICE_US, Data, data_of, decode, too_many, usual_data
from truearm.session.heartbeats import Heartbeats
from truearm.session.losses import Losses
from truearm.session.pages import Pages
from truearm.session.sample_streams import COUNTED, StreamReport, StreamTrack
from truearm.types import Message
from truearm_wire import messages as wire

REMEMBERED = 64  # frames that a doubled one may lag behind
HALF_CIRCLE = 2**31

_HEARTBEAT_VALUES = len(wire.names(wire.HEARTBEAT)) - 1  # without seq
_HEARTBEAT_NEEDED = wire.needed(wire.HEARTBEAT) - 1  # of a box of any minor version


class Block(NamedTuple):
    """The samples of one data frame: ``n`` of ``channels`` channels. ``gap``: samples before this block are missing."""

    segment: int
    run: int
    gap: bool
    n: int
    channels: int
    t_host_ns: int
    data: Data

    @property
    def counts(self) -> NDArray[np.int32]:
        """The samples as (n, channels)."""
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


class BoxReader:
    """Takes the box's and the clock's messages one by one in log order; see the module's text for the rules.

    ``ident`` describes the streams where the session itself holds no ident frames before the data. ``keep_exchanges``
    False leaves the exchanges out (a second pass needs them no more).
    """

    def __init__(self, ident: Ident | None = None, keep_exchanges: bool = True) -> None:
        self._segment = Segment(0, ident=ident)
        self.segments = [self._segment]
        self._keep_exchanges = keep_exchanges
        self._count: Counter[str] = Counter()
        self._last_seq: int | None = None
        self._last_host_ns = 0  # when that frame arrived
        self._far_seq: int | None = None  # of the frame before, if it was too far ahead
        self._recent: list[bytes] = [b""] * REMEMBERED
        self._times: dict[int, int] = {}
        self._streams: dict[int, StreamTrack] = {}
        self._layout: dict[int, tuple[int, StreamTrack]] = {}  # channels and track by the ident in force
        self._pages = Pages()
        self._heartbeats = Heartbeats()

    @property
    def segment(self) -> Segment:
        """The segment that the last message belongs to."""
        return self._segment

    def feed(self, message: Message) -> Block | None:
        """Account for one message; the block of samples if it is one. Messages of other topics are ignored."""
        topic = message.topic
        if topic.startswith("/box/"):
            if topic != "/box/console":
                return self._frame(message)
            self._console(message.data)
        elif topic == "/sync":
            self._exchange(message.data)
        return None

    def losses(self) -> Losses:
        """The account so far."""
        box = self._heartbeats.counters({s.index for s in self.segments if s.booted})
        known = {name: self._count[name] for name in Losses.__dataclass_fields__ if name != "box"}
        for name in COUNTED:
            known[name] = sum(getattr(stream, name) for stream in self._streams.values())
        return Losses(**known, box=box)

    def streams(self) -> tuple[StreamReport, ...]:
        """The streams so far."""
        return tuple(stream.report(k, self._described(k)) for k, stream in sorted(self._streams.items()))

    def _described(self, stream_id: int) -> Stream:
        """A stream is only counted while an ident describes it, but the last boot may have said none."""
        idents = [s.ident for s in self.segments if s.ident is not None and stream_id in s.ident.streams]
        return idents[-1].streams[stream_id]

    # ------------------------------------------------------------------------------------------------ frames

    def _frame(self, message: Message) -> Block | None:
        data = usual_data(message.data)
        if data is not None:
            new = self._follows(data, message) or self._new(data.seq, (data.stream, data.t0_us), message, False)
            return self._data(data, message) if new else None
        frame = decode(message.data)
        if frame is None or is_echo(frame):
            self._count["frames_malformed"] += 1
            return None
        kind, boot = frame[0], is_boot(frame)
        if not self._new(frame[1], device_time(frame), message, boot):
            return None
        self._segment.booted |= boot
        if kind == wire.DATA:
            return self._data(data_of(frame), message)
        if kind == wire.HEARTBEAT:
            self._heartbeat(frame)
        elif kind == wire.EVENT:
            self._event(frame)
        elif kind == wire.IDENT:
            self._ident_page(frame)
        elif kind not in wire.LAYOUT:
            self._count["frames_unknown"] += 1
        return None

    def _follows(self, data: Data, message: Message) -> bool:
        """Whether a frame is simply the next one, as nearly all are; then it is accounted for as ``_new`` would."""
        seq, stream, t0_us = data.seq, data.stream, data.t0_us
        if self._last_seq is None or seq != self._last_seq + 1 or self._far_seq is not None:
            return False
        if t0_us < self._times.get(stream, 0):
            return False
        self._last_seq, self._last_host_ns = seq, message.t_host_ns
        self._recent[seq % REMEMBERED] = message.data
        self._times[stream] = t0_us
        self._count["frames"] += 1
        return True

    def _new(self, seq: int, stamp: tuple[int, int] | None, message: Message, boot: bool) -> bool:
        """Account for a frame; False for a doubled or foreign one."""
        if self._foreign(seq, message.t_host_ns, boot):
            self._count["frames_malformed"] += 1
            return False
        new = self._advance(seq, stamp, message.data, boot)
        self._count["frames" if new else "frames_duplicated"] += 1
        self._last_host_ns = message.t_host_ns
        return new

    def _foreign(self, seq: int, t_host_ns: int, boot: bool) -> bool:
        """Whether ``seq`` lies further ahead than can be; if it goes on from such a one, a new segment begins before it."""
        step = 1 if self._last_seq is None or boot else (seq - self._last_seq) & 0xFFFFFFFF
        far = step < HALF_CIRCLE and too_many(step, t_host_ns - self._last_host_ns)
        before, self._far_seq = self._far_seq, seq if far else None
        if not far or before is None or seq != (before + 1) & 0xFFFFFFFF:
            return far
        self._restart()
        self._last_seq, self._far_seq = before, None
        return False

    def _advance(self, seq: int, stamp: tuple[int, int] | None, data: bytes, boot: bool) -> bool:
        """Account for ``seq`` and device time; False for a doubled frame."""
        last = self._last_seq
        step = 1 if last is None else (seq - last) & 0xFFFFFFFF
        if step != 1 and self._recent[seq % REMEMBERED] == data:
            return False
        backward = stamp is not None and stamp[1] < self._times.get(stamp[0], 0)
        if last is not None and (backward or step == 0 or step >= HALF_CIRCLE or (boot and step != 1)):
            self._restart()
            step = seq + 1
        if step != 1:
            self._count["frames_lost"] += step - 1
            self._count["loss_events"] += 1
        self._last_seq = seq
        self._recent[seq % REMEMBERED] = data
        if stamp is not None:
            self._times[stamp[0]] = stamp[1]
        return True

    def _restart(self) -> None:
        self._count["restarts"] += 1
        self._segment = Segment(len(self.segments), booted=True, ident=self.segment.ident)
        self.segments.append(self._segment)
        self._times.clear()
        self._pages = Pages()
        self._recent = [b""] * REMEMBERED
        for stream in self._streams.values():
            stream.restart(self._count["frames_lost"])

    def _boot_id(self, boot_id: int) -> None:
        if self.segment.boot_id not in (None, boot_id):
            self._restart()
        self.segment.boot_id = boot_id

    # ------------------------------------------------------------------------------------------------ contents

    def _data(self, data: Data | None, message: Message) -> Block | None:
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
        return Block(self._segment.index, stream.run, gap, n, channels, message.t_host_ns, data)

    def _described_now(self, stream_id: int) -> tuple[int, StreamTrack | None]:
        """How many channels a stream has by the ident in force, and its track; none where it does not know the stream."""
        ident = self._segment.ident
        described = None if ident is None else ident.streams.get(stream_id)
        if described is None:
            return 0, None
        found = len(described.channels), self._streams.setdefault(stream_id, StreamTrack())
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
