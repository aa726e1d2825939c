"""A robot's joint readings: JSON lines over a link, told apart from everything else that a robot may print.

Like a box's bytes they are stored before anything is made of them, line by line as they came.
"""

from __future__ import annotations

from truearm.errors import LinkClosed, LinkError
from truearm.record.frames import Runs
from truearm.record.links import Arrivals, Clock, Link
from truearm.record.session_writer import SessionWriter
from truearm.record.status import Counters
from truearm.sensors.joints import parse_reading

MAX_LINE = 8192  # bytes
MAX_RUBBISH = 1 << 20  # bytes without a reading between them; a robot that sends so many is none
EXPECTED = 'expected are lines such as {"t": 1.5, "seq": 3, "q": [0.1, -2.0]}'


class JointLines:
    """Lines of a robot's stream, exactly as received without their line feed.

    A joint line is what ``parse_reading`` takes, of as many joints as the first. About 4 µs a line of six joints.
    """

    def __init__(self) -> None:
        self._runs = Runs(b"\n", MAX_LINE)
        self._n_joints: int | None = None
        self.other_joints = 0  # readings of another number of joints than the first

    def push(self, data: bytes) -> list[tuple[bool, bytes]]:
        """``(True, line)`` for joint lines, ``(False, bytes)`` for all else, in order."""
        return [(whole and self._is_joints(line), line) for whole, line in self._runs.push(data)]

    def flush(self) -> bytes:
        """What came behind the last line feed, when the stream has ended."""
        return self._runs.flush()

    def _is_joints(self, line: bytes) -> bool:
        reading = parse_reading(line)
        if reading is None:
            return False
        if self._n_joints is None:
            self._n_joints = len(reading.q)
        fits = len(reading.q) == self._n_joints
        self.other_joints += not fits
        return fits


class RobotIntake:
    """The robot's side of a recording. ``end`` is the error that ended its stream, None while it runs."""

    def __init__(self, link: Link, writer: SessionWriter, clock: Clock, counters: Counters) -> None:
        self.end: LinkError | None = None
        self._link = link
        self._writer = writer
        self._clock = clock
        self._counters = counters
        self._lines = JointLines()
        self._rubbish = 0  # bytes since the last reading

    def read(self) -> Arrivals:
        """What has arrived, without waiting; nothing after the end, or of a stream that is none."""
        if self.end is not None or self.rubbish:
            return []
        try:
            return self._link.read(0.0)
        except LinkError as exc:
            self.end = exc
        now_ns = self._clock.now_ns()
        self.flush(now_ns)
        self._writer.event("robot-closed" if self.closed else "robot-lost", now_ns, text=str(self.end))
        return []

    @property
    def rubbish(self) -> str:
        """Says so if what the robot sends is no stream of readings, else ""."""
        if self._rubbish <= MAX_RUBBISH:
            return ""
        return f"{self._link.name}: {self._rubbish} bytes without a joint reading; {EXPECTED}"

    @property
    def closed(self) -> bool:
        """Whether the robot ended its stream in order."""
        return isinstance(self.end, LinkClosed)

    def take(self, t_host_ns: int, data: bytes) -> None:
        """Store bytes that arrived."""
        for is_joints, line in self._lines.push(data):
            if is_joints:
                self._rubbish = 0
                self._counters.robot_lines += 1
                self._writer.add("/robot/joints", t_host_ns, line)
            else:
                self._store_console(t_host_ns, line)
        self._counters.robot_other_joints = self._lines.other_joints

    def flush(self, t_host_ns: int) -> None:
        """Store what came behind the last line feed."""
        rest = self._lines.flush()
        if rest:
            self._store_console(t_host_ns, rest)

    def _store_console(self, t_host_ns: int, data: bytes) -> None:
        self._rubbish += len(data)
        self._counters.robot_console_bytes += len(data)
        self._writer.add("/robot/console", t_host_ns, data)
