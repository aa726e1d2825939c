"""Store what a box and a robot send, exactly and in order, then evaluate it.

Of the box, only what the recording itself needs is evaluated: the ident (for the streams' names, the boot id and
faults), answers to commands, clock exchanges, and ``seq`` for counting losses. This takes about 9 µs per data frame, 5
of them for the file. A box that restarts shows a new boot id in its ident or heartbeat, or its frame count steps back.
After the latter, ``suspect`` asks the recorder to have the box identify itself, and its boot id decides.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import msgspec

from truearm.errors import LinkClosed, LinkError, ProtocolError
from truearm.record.links import Arrivals, Backlog, Clock, Link, Reopenable, Runs, backlog_of
from truearm.record.operator import Counters, Operator
from truearm.record.requests import FrameCount, FrameSplitter, Requests
from truearm.record.session_writer import PREVIEW, PREVIEW_NS, ROBOT_PREVIEW, SessionWriter
from truearm.session.frames import Data, Ident, Stream, conforms, data_of, named_elements
from truearm.session.joint_format import UNNUMBERED, JointLine, parse_line
from truearm.session.samples import counts_of, shown
from truearm.session.session_file import LATEST_NS
from truearm.units import MDEGC
from truearm_wire.messages import DATA, ERROR, EVENT, HEARTBEAT, IDENT, REPLY, SYNC_REPLY, TEMPERATURE

SYNC_TIMEOUT_NS = 2_000_000_000


_TOPICS = {
    EVENT: "/box/event",
    TEMPERATURE: "/box/temperature",
    HEARTBEAT: "/box/heartbeat",
    IDENT: "/box/ident",
    SYNC_REPLY: "/box/sync",
    REPLY: "/box/reply",
    ERROR: "/box/reply",
}
_BEAT_WRAP = 2**30  # of a heartbeat's counters
_LARGEST_UNNAMED_STREAM = 255


@dataclass
class BoxStorage:
    """The box's side of a recording. ``requests`` takes the answers to commands.

    Of a clock exchange, t0 is the host time before the request was handed over, t3 the arrival of the reply; the box's
    t1 and t2 lie between them (SPEC §4). A request without an answer within 2 s becomes a row with nulls.
    """

    writer: SessionWriter
    counters: Counters
    requests: Requests
    operator: Operator = field(default_factory=Operator)
    suspect: bool = False  # the box may have restarted
    restarted: bool = False  # it has
    idle: int = 0  # heartbeats in a row that say that it does not stream
    heard_ns: int | None = None  # time of its last message, or since when it could be heard again
    spoke_ns: int | None = None  # time of its last message
    rtt_us: float | None = None  # the shortest clock exchange, without the time within the box
    _asked_ns: dict[int, int] = field(default_factory=dict)  # t0 of the clock requests without an answer, by id
    _frame_count: FrameCount = field(default_factory=FrameCount)
    _beats: dict[int, tuple[int, int]] = field(default_factory=dict)  # last dropped and overruns, by boot
    _next_preview_ns: dict[int, int] = field(default_factory=dict)  # by stream
    _splitter: FrameSplitter = field(default_factory=FrameSplitter)

    def take(self, t_host_ns: int, data: bytes) -> None:
        """Store and evaluate bytes that arrived. Raises ProtocolError for an ident that cannot be used."""
        # A traceback waits for the next delimiter, which may arrive with the next boot: use the time at which the text
        # itself ended.
        t_console_ns = t_host_ns if self.heard_ns is None or data[:1] != b"\0" else self.heard_ns
        self.heard_ns = self.spoke_ns = t_host_ns
        for frame, item in self._splitter.push(data):
            if frame is not None:
                self._take_frame(t_host_ns, frame, item)
            else:
                self._take_console(t_console_ns, item)
            t_console_ns = t_host_ns

    def flush(self) -> None:
        """Store what follows the last delimiter: the stream has ended or was cut."""
        if (remainder := self._splitter.flush()) and self.heard_ns is not None:
            self._take_console(self.heard_ns, remainder)

    @property
    def ident(self) -> Ident | None:
        """The box's latest description of itself."""
        return self.requests.ident

    @property
    def faults(self) -> tuple[str, ...]:
        """Return faults of the box for the operator; () before it has identified itself."""
        return () if self.ident is None else self.ident.faults

    def cleared(self) -> None:
        """Note that the box was asked and has not restarted: its frames are counted from the next one on."""
        self.suspect = False
        self._frame_count.clear()

    def asked(self, number: int, t0_ns: int) -> None:
        """Note a clock request with this id, sent at ``t0_ns``."""
        self._asked_ns[number] = t0_ns
        self.counters.probes += 1

    def expire(self, now_ns: int, older_than_ns: int = SYNC_TIMEOUT_NS) -> None:
        """Give up clock requests older than this."""
        late = [number for number, t0_ns in self._asked_ns.items() if now_ns - t0_ns >= older_than_ns]
        for number in late:
            self.writer.add_json("/sync", now_ns, {"id": number, "t0_ns": self._asked_ns.pop(number)})
            self.counters.unanswered_probes += 1

    def _take_console(self, t_host_ns: int, data: bytes) -> None:
        self.counters.console_bytes += len(data)
        self.writer.add("/box/console", t_host_ns, data)

    def _take_frame(self, t_host_ns: int, frame: list[Any], payload: bytes) -> None:
        kind, seq = frame[:2]
        data = data_of(frame) if kind == DATA and conforms(frame) else None
        stream = None if data is None or self.ident is None else self.ident.streams.get(data.stream)
        topic = _TOPICS.get(kind, "/box/other")
        if stream is not None:
            topic = f"/box/{stream.name}"
        elif data is not None and data.stream <= _LARGEST_UNNAMED_STREAM:
            topic = f"/box/stream{data.stream}"
        self.writer.add(topic, t_host_ns, payload)
        self._count(seq)
        if stream is not None and data is not None:
            self._take_samples(t_host_ns, data, stream)
        elif kind in _TOPICS and (fields := named_elements(frame)) is not None:
            self._interpret(t_host_ns, kind, fields)

    def _take_samples(self, t_host_ns: int, data: Data, stream: Stream) -> None:
        """Pass samples on, and store a block's last one now and then for viewers that cannot read frames."""
        self.counters.samples += len(data.samples) // (4 * len(stream.channels))  # int32
        if t_host_ns >= self._next_preview_ns.get(data.stream, 0) and (counts := counts_of(data, stream)) is not None:
            self._next_preview_ns[data.stream] = t_host_ns + PREVIEW_NS
            pairs = zip(stream.channels, counts[-1].tolist(), strict=True)
            row = dict(shown(*pair) for pair in pairs if not pair[0].fault)
            self.writer.add(PREVIEW + stream.name, t_host_ns, msgspec.json.encode(row))
        self.operator.block(t_host_ns, data)

    def _count(self, seq: int) -> None:
        self.counters.frames += 1
        if not self._frame_count.take(seq):
            self.suspect = True
        self.counters.lost_frames, self.counters.odd_frames = self._frame_count.lost, self._frame_count.odd

    def _interpret(self, t_host_ns: int, kind: int, fields: Mapping[str, Any]) -> None:
        if kind == SYNC_REPLY:
            self._take_exchange(t_host_ns, fields["id"], fields["t1_us"], fields["t2_us"])
        elif kind == HEARTBEAT:
            self._take_heartbeat(fields)
        elif kind in (IDENT, REPLY, ERROR):
            recorded = self.ident
            self.requests.take(kind, fields)
            if self.ident is not None and self.ident is not recorded:
                self._take_ident(t_host_ns, recorded, self.ident)

    def _take_exchange(self, t3_ns: int, number: int, t1_us: int, t2_us: int) -> None:
        """Store a clock exchange, unless it is unknown or too late."""
        t0_ns = self._asked_ns.pop(number, None)
        if t0_ns is not None:
            row = {"id": number, "t0_ns": t0_ns, "t1_us": t1_us, "t2_us": t2_us, "t3_ns": t3_ns}
            self.writer.add("/sync", t3_ns, msgspec.json.encode(row))
            rtt_us = max(0.0, (t3_ns - t0_ns) / 1000 - (t2_us - t1_us))
            self.rtt_us = rtt_us if self.rtt_us is None else min(rtt_us, self.rtt_us)

    def _take_heartbeat(self, fields: Mapping[str, Any]) -> None:
        """Count losses in the box.

        It counts since boot, so losses before this recording first heard of it are not included.
        """
        boot_id, counts = fields["boot_id"], (fields["dropped"], fields["overruns"])
        self.idle = 0 if fields["streaming"] else self.idle + 1
        self.operator.box_temperature(MDEGC.to_si(fields["temperature_mdegc"]))
        if self.ident is not None and boot_id != self.ident.boot_id:
            self.suspect = True
        before = self._beats.get(boot_id, (0, 0) if self._beats else counts)
        dropped, overruns = ((now - then) % _BEAT_WRAP for now, then in zip(counts, before, strict=True))
        if max(dropped, overruns) < _BEAT_WRAP // 2:  # else the count went back
            self._beats[boot_id] = counts
            self.counters.dropped_in_box += dropped
            self.counters.overruns_in_box += overruns

    def _take_ident(self, t_host_ns: int, recorded: Ident | None, ident: Ident) -> None:
        """Compare an ident with the one before.

        Raises ProtocolError if a different box answers: its calibration and its clock differ.
        """
        if recorded is not None:
            uids = [str(document.get("uid", ""))[:32] for document in (ident.document, recorded.document)]
            if uids[0] != uids[1]:
                raise ProtocolError(
                    f"another box answers ({uids[0] or 'without a uid'}; the recording began with {uids[1] or 'one without'}); "
                    "plug in the box of the recording and resume the session"
                )
            if ident.boot_id != recorded.boot_id:
                self.counters.restarts += 1
                self.restarted = True
                self.cleared()
                self.writer.event("box-restarted", t_host_ns, boot_id=ident.boot_id, boot_id_before=recorded.boot_id)
        for text in ident.faults:
            if recorded is None or text not in recorded.faults:
                self.writer.event("box-fault", t_host_ns, text=text)


# ------------------------------------------------------------------------------------------------------------ the robot

MAX_LINE = 8192  # bytes
SILENCE_S = 3.0
END = b'{"end":true}'
EXPECTED = 'expected are lines such as {"t": 1.5, "seq": 3, "q": [0.1, -2.0]}'


class RobotIntake:
    """The robot's side of a recording: the lines of its stream, as received without their line feed.

    A reading is a line that ``parse_line`` accepts, with as many joints as the first. A closed connection does not show
    the reason: a restarted controller, a crashed program and a finished one all close it in the same way. The recorder
    therefore waits for the robot as after any loss. A program that has finished announces this with the line ``END``.

    ``lost``: why it is away, None while it is there. It has ``ended``, or it is away since ``lost_ns`` and may come
    back; its first reading ends the loss, not its link. ``heard_ns``: time of the last reading.
    """

    def __init__(self, link: Link, clock: Clock, writer: SessionWriter, counters: Counters, operator: Operator) -> None:
        self.lost: LinkError | None = None
        self.lost_ns = 0
        self.ended = False
        self.heard_ns: int | None = None
        self.unread = b""  # the first line that is not a reading
        self._link = link
        self._writer = writer
        self._clock = clock
        self._counters = counters
        self._operator = operator
        self._runs = Runs(b"\n", MAX_LINE)
        self._joints = 0  # of the first reading
        self._silent = False
        self._last: JointLine | None = None  # reading
        self._linked = True
        self._next_preview_ns = 0
        self._pieces: deque[tuple[int, bytes]] = deque()  # read, but not stored yet

    def take_until(self, end_ns: int, arrival_end_ns: int = LATEST_NS) -> bool:
        """Store what arrived before ``arrival_end_ns``, without waiting and for no longer than until ``end_ns``.

        Return whether anything was there.
        """
        self._pieces.extend(() if self._pieces else self._read())
        any_pieces = bool(self._pieces)
        while self._pieces and self._pieces[0][0] < arrival_end_ns and self._clock.now_ns() <= end_ns:
            self._take(*self._pieces.popleft())
        return any_pieces

    def _read(self) -> Arrivals:
        """Return what has arrived; nothing after the end or without a link."""
        if self.ended:
            return []
        if not self._linked:  # a lost one is reopened in the background
            self._linked = isinstance(self._link, Reopenable) and self._link.reopen(0.0)
        try:
            return self._link.read(0.0) if self._linked else []
        except LinkError as exc:
            self._lost(exc)
        return []

    def watch(self, now_ns: int) -> None:
        """Note in the file when the robot sends nothing though its link is intact, and when it sends again.

        Also that somebody else sends to its port.
        """
        foreign = self.backlog.foreign
        if foreign and not self._counters.robot_foreign:
            self._writer.event("robot-foreign", now_ns, text="datagrams from other addresses are counted, not stored")
        self._counters.robot_foreign = foreign
        silent = self.lost is None and self._late(now_ns)
        if silent != self._silent:
            self._silent = silent
            if self.lost is None:
                self._writer.event("robot-silent" if silent else "robot-heard", now_ns, heard_ns=self.heard_ns)

    def _late(self, now_ns: int) -> bool:
        """Return whether the next reading is overdue; not while received data waits to be stored."""
        return (self.age_s(now_ns) or 0.0) > SILENCE_S and not self.backlog.waiting

    def absence(self, now_ns: int) -> str:
        """Return that the robot does not send, though it has not ended its stream; "" otherwise.

        Datagrams have no end: a program that has finished and one that was lost are both just silent.
        """
        if self.closed or (self.lost is None and (self.backlog.drops or not self._late(now_ns))):
            return ""
        why = self.lost or "its connection is open"
        return f"the robot sent nothing in the last {self.age_s(now_ns) or 0.0:.1f} s ({why})"

    def age_s(self, now_ns: int) -> float | None:
        """Return the age of the last reading [s]."""
        return None if self.heard_ns is None else (now_ns - self.heard_ns) / 1e9

    def _lost(self, error: LinkError) -> None:
        now_ns = self._clock.now_ns()
        self.flush(now_ns)
        self._linked = False
        never = isinstance(error, LinkClosed) and self.heard_ns is None  # no reading yet: not a source
        self.ended = not isinstance(self._link, Reopenable) or isinstance(error, ProtocolError) or never
        if not self.ended:
            if self.lost is not None:  # the link was back, but not the robot
                return
            self.lost_ns = now_ns
            self._counters.robot_losses += not isinstance(error, LinkClosed)
        self.lost = error
        self._writer.event("robot-closed" if self.closed else "robot-lost", now_ns, text=str(error))

    def _back(self, t_host_ns: int, reading: JointLine) -> None:
        """Note the first reading after a loss: how long it was, and how many were lost if the robot counts them."""
        self.lost = None
        away_s = None if self.heard_ns is None else round((t_host_ns - self.heard_ns) / 1e9, 3)
        self._writer.event("robot-back", t_host_ns, away_s=away_s, lost=_missing(self._last, reading))

    @property
    def backlog(self) -> Backlog:
        """Return what waits to be stored, here too, and how often the robot's reader had to wait for the recorder."""
        linked = backlog_of(self._link)
        return linked._replace(waiting=linked.waiting + len(self._pieces))

    @property
    def closed(self) -> bool:
        """Whether the robot ended its stream deliberately, as a program that ends does, and has not come back."""
        return isinstance(self.lost, LinkClosed)

    def _take(self, t_host_ns: int, data: bytes) -> None:
        for is_whole, line in self._runs.push(data):
            reading = parse_line(line) if is_whole else None
            if reading is not None:
                self._joints = self._joints or len(reading.q)
                if len(reading.q) == self._joints:
                    self._take_reading(t_host_ns, line, reading)
                    continue
                self._counters.robot_other_joints += 1
            self._store_console(t_host_ns, line)
            if line.strip().replace(b" ", b"") == END and not self.ended:
                text = f"{self._link.name}: the robot reported that its program has ended"
                self.ended, self.lost = True, LinkClosed(text)
                self._writer.event("robot-closed", t_host_ns, text=text)

    def _take_reading(self, t_host_ns: int, line: bytes, reading: JointLine) -> None:
        if self.lost is not None and not self.ended:
            self._back(t_host_ns, reading)
        elif self.backlog.held_up and self._last is not None:  # readings may be lost because they could not be stored
            self._counters.robot_missing += _missing(self._last, reading) or 0
            self._counters.robot_dropped |= self.backlog.drops and UNNUMBERED in (self._last.seq, reading.seq)
        self._counters.robot_lines += 1
        numeric = getattr(self._link, "numeric", False)  # stored as columns, with ten lines a second for viewers
        self._writer.add_reading(t_host_ns, None if numeric else line, reading)
        if numeric and t_host_ns >= self._next_preview_ns:
            self._next_preview_ns = t_host_ns + PREVIEW_NS
            self._writer.add(ROBOT_PREVIEW, t_host_ns, line)
        self.heard_ns, self._last = t_host_ns, reading
        self._operator.reading(t_host_ns, reading)

    def flush(self, t_host_ns: int) -> None:
        """Store what came behind the last line feed."""
        if remainder := self._runs.flush():
            self._store_console(t_host_ns, remainder)

    def _store_console(self, t_host_ns: int, data: bytes) -> None:
        self._counters.robot_console_bytes += len(data)
        self.unread = self.unread or data
        self._writer.add("/robot/console", t_host_ns, data)


def _missing(last: JointLine | None, reading: JointLine) -> int | None:
    """Return how many readings are missing between two, by their numbers; None if these do not show it."""
    if last is None or UNNUMBERED in (last.seq, reading.seq) or reading.t <= last.t or reading.seq <= last.seq:
        return None
    return reading.seq - last.seq - 1
