"""Receive a robot's joint readings: JSON lines over a link, distinguished from anything else that a robot may print.

Like a box's bytes, lines are stored exactly as received before they are evaluated.

A closed connection does not show the reason: a controller that is restarted, a program that crashed and one that has
finished all close it in the same way. The recorder therefore waits for the robot as after any loss. A program that has
finished announces this beforehand with the line ``END``.
"""

from __future__ import annotations

from collections import deque

from truearm.errors import LinkClosed, LinkError, ProtocolError
from truearm.record.frame_splitter import Runs
from truearm.record.links import Arrivals, Backlog, Clock, Link, Reopenable, backlog_of
from truearm.record.operator import Counters, Operator
from truearm.record.session_schemas import PREVIEW_NS, ROBOT_PREVIEW
from truearm.record.session_writer import SessionWriter
from truearm.session.joint_format import UNNUMBERED, JointLine, parse_line
from truearm.session.session_file import LATEST_NS

MAX_LINE = 8192  # bytes
SILENCE_S = 3.0
END = b'{"end":true}'
EXPECTED = 'expected are lines such as {"t": 1.5, "seq": 3, "q": [0.1, -2.0]}'


class RobotIntake:
    """The robot's side of a recording: the lines of its stream, as received without their line feed.

    A reading is a line that ``parse_line`` accepts, with as many joints as the first.

    ``lost``: why it is away, None while it is there. It has ``ended``, or it is away since ``lost_ns`` and may come back;
    its first reading ends the loss, not its link. ``heard_ns``: time of the last reading.
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
        """Note in the file when the robot sends nothing though its link is intact, and when it sends again; and that
        somebody else sends to its port.
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
        """Note the first reading after a loss: its duration, and the number of lost readings if the robot counts them."""
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
