"""The complete lab in virtual time: box, robot and the links between them and the host.

True time is integer nanoseconds from the start of the lab. The host's monotonic clock is true time plus a constant, as
if the computer had run for some hours. Nothing advances automatically: reading a link advances time to the next
arrival, at most by the time-out. The recorder runs unchanged: it takes time from :class:`VirtualClock` and waits only
in ``read``. Latencies come from a seeded generator, so a run is reproducible to the byte.
"""

from __future__ import annotations

import heapq
from collections import deque

import numpy as np

from truearm.errors import LinkClosed, LinkError

from .latency import FROM_BOX, FROM_ROBOT, TO_BOX
from .simbox import SimulatedBox
from .world import World

STEP_NS = 200_000_000  # the box runs at least this often, and whenever it requests to
ROBOT_AHEAD_NS = 1_000_000_000  # the robot's lines are computed one second at a time
HOST_AT_START_NS = 12_345_678_901_234
UTC_NS = 1_767_225_600_000_000_000  # 2026-01-01T00:00:00Z: the virtual lab's calendar


class Lab:
    """Box and robot in virtual time; the recorder is given ``box_link``, ``robot_link`` and ``clock``."""

    def __init__(self, world: World, box: SimulatedBox, seed: int = 0, step_ns: int = STEP_NS) -> None:
        """Create a lab.

        ``step_ns``: if a box sets its trigger output during a step (as the chip does), steps must be shorter than the
        latency of the robot's link (0.3 ms). Otherwise its readings arrive before it is known what the robot saw.
        """
        self.world = world
        self.box = box
        self._step_ns = step_ns
        self.now_ns = 0
        self._rng = np.random.default_rng((seed, 1))
        self._to_box: list[tuple[int, int, bytes]] = []  # heap of (arrival, order, bytes)
        self._order = 0
        self._next_step_ns = 0
        # arrival, sent, bytes
        self._arrivals: dict[str, deque[tuple[int, int, bytes]]] = {"box": deque(), "robot": deque()}
        self._edges_seen = 0  # of the box's output, by the robot
        self._last_ns = {"box": 0, "robot": 0, "to box": 0}
        self._robot_until_ns = 0
        self.clock = VirtualClock(self)
        self.box_link = VirtualLink(self, "box")
        self.robot_link = VirtualLink(self, "robot")

    # -- time

    def read(self, which: str, timeout_s: float) -> list[tuple[int, bytes]]:
        """Return what has arrived on a link; advances time, up to ``timeout_s``, until something has."""
        deadline = self.now_ns + int(timeout_s * 1e9)
        arrivals = self._arrivals[which]
        while not (arrivals and arrivals[0][0] <= self.now_ns) and self.now_ns < deadline:
            self._pass_to(min(deadline, self._next_event_ns(which)))
        if which == "robot" and not arrivals and self.now_ns >= self.world.robot_end_ns:
            raise LinkClosed("the robot's program has ended")
        found = []
        while arrivals and arrivals[0][0] <= self.now_ns:
            t_ns, _, data = arrivals.popleft()
            found.append((self.host_ns(t_ns), data))
        return found

    def write(self, data: bytes) -> int:
        """Send bytes from the host to the box; they arrive in order."""
        at = self._in_order("to box", self.now_ns + TO_BOX.draw(self._rng) - self.box.link_ns)
        self._order += 1
        heapq.heappush(self._to_box, (at, self._order, data))
        return self.host_ns(self.now_ns)

    def host_ns(self, t_ns: int) -> int:
        """Return the host's clock at true time ``t_ns``."""
        return HOST_AT_START_NS + t_ns

    def _next_event_ns(self, which: str) -> int:
        times = [self._next_step_ns]
        if self._to_box:
            times.append(self._to_box[0][0])
        if self.box.wake_ns is not None:
            times.append(self.box.wake_ns)
        if self._arrivals[which]:
            times.append(self._arrivals[which][0][0])
        return max(min(times), self.now_ns)

    def _pass_to(self, t_ns: int) -> None:
        self.now_ns = t_ns
        rx = b""
        while self._to_box and self._to_box[0][0] <= t_ns:
            rx += heapq.heappop(self._to_box)[2]
        wanted = self.box.wake_ns is not None and t_ns >= self.box.wake_ns
        if rx or wanted or t_ns >= self._next_step_ns:
            for tx in self.box.advance(t_ns, rx):
                at = self._in_order("box", t_ns + FROM_BOX.draw(self._rng) - self.box.link_ns)
                self._arrivals["box"].append((at, t_ns, tx))
            if self.world.robot_input is not None:
                self._forget_readings()
        if t_ns >= self._next_step_ns:
            self._next_step_ns = t_ns + self._step_ns
        while self._robot_until_ns <= self._next_step_ns:
            self._robot_speaks()

    def _forget_readings(self) -> None:
        """Discard readings made after an edge of the box's output: their state of the robot's input is wrong."""
        new = self.box.output_edges[self._edges_seen :]
        self._edges_seen += len(new)
        readings = self._arrivals["robot"]
        if not new:
            return
        while readings and readings[-1][1] >= new[0][0]:
            self._robot_until_ns = readings.pop()[1] - 1000  # it was rounded, and must be sent again
        self._last_ns["robot"] = readings[-1][0] if readings else self.now_ns

    def _robot_speaks(self) -> None:
        """Queue the controller's next lines, each with its own delay."""
        since_ns = self._robot_until_ns
        self._robot_until_ns += ROBOT_AHEAD_NS
        times_ns, lines = self.world.robot_lines(since_ns, self._robot_until_ns, self.box.output_at)
        for sent_ns, line in zip(times_ns.tolist(), lines, strict=True):
            at = self._in_order("robot", sent_ns + FROM_ROBOT.draw(self._rng))
            self._arrivals["robot"].append((at, sent_ns, line))

    def _in_order(self, stream: str, t_ns: int) -> int:
        """Return the arrival in a byte stream, which keeps its order: nothing arrives before what was sent earlier."""
        self._last_ns[stream] = max(self._last_ns[stream], t_ns)
        return self._last_ns[stream]


class VirtualClock:
    """The host's clock in the lab."""

    kind = "virtual"

    def __init__(self, lab: Lab) -> None:
        self._lab = lab

    def now_ns(self) -> int:
        return self._lab.host_ns(self._lab.now_ns)

    def utc_anchor(self) -> tuple[int, int]:
        return UTC_NS + self._lab.now_ns, self.now_ns()


class VirtualLink:
    """One of the lab's links, with the interface of the recorder's links (truearm.record.links.Link)."""

    def __init__(self, lab: Lab, which: str) -> None:
        self.name = f"simulated {which}"
        self._lab = lab
        self._which = which

    def read(self, timeout_s: float) -> list[tuple[int, bytes]]:
        return self._lab.read(self._which, timeout_s)

    def write(self, data: bytes) -> int:
        if self._which == "robot":
            raise LinkError("robot: this link is read only")
        return self._lab.write(data)

    def close(self) -> None:
        return
