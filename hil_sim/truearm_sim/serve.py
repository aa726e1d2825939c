"""The lab in real time: the box behind a TCP port or a pseudo-terminal, the robot behind a TCP port, on loopback.

Time starts with the first connection. At each tick, and when its client has written something, the box is granted the
elapsed wall-clock time, with the bytes its client wrote. While no client is connected the link accepts nothing, and the
box counts what it must drop.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from truearm.record.intake import END
from truearm.record.links import HostClock

from .ports import Port, Terminal
from .rtde_server import RtdeServer
from .simbox import SimulatedBox
from .world import World

TICK_S = 0.002


@dataclass(frozen=True)
class Pace:
    """How time passes: the pause between steps [s], and how far the lab's time may lag behind the wall clock [ns].

    ``longest_lag_ns``: for a box that may be slower than the wall clock. Its steps are short. If they lag behind by
    more, the lab's time is delayed, for box and robot alike, and ``delayed`` is called the first time.
    """

    pause_s: float = TICK_S
    longest_lag_ns: int | None = None
    delayed: Callable[[], None] = lambda: None


# An emulated chip takes most of the wall clock's time: a pause before a request would delay the answer. Its first steps
# are slow.
EMULATED = Pace(50e-6, 100_000_000)


def serve(
    world: World,
    box: SimulatedBox,
    box_port: Port | Terminal,
    robot_port: Port | RtdeServer,
    *,
    stop: Callable[[], bool] = lambda: False,
    started: Callable[[], None] = lambda: None,
    ended: Callable[[], None] = lambda: None,
    pace: Pace = Pace(),
) -> None:
    """Run until the robot's program has ended and the box's client has disconnected, or until ``stop()``.

    ``started`` is called when time starts, ``ended`` when the robot's program has ended. Then a robot that sends lines
    reports this and closes its stream; a controller continues to send its position.
    """
    clock = HostClock()  # the recorder's clock: a slew of the wall clock would look like a drift of the box
    start_ns: int | None = None
    sent_until_ns = received_ns = 0
    received = b""
    running, punctual = True, True
    while not stop():
        box_there, robot_there = box_port.connected(), robot_port.connected()
        if start_ns is None:
            if not (box_there or robot_there):
                time.sleep(0.02)
                continue
            for tx in box.advance(0, b"", 0):  # its process starts
                box_port.send(tx)
            start_ns = clock.now_ns()
            started()
        if not received:
            received, received_ns = box_port.receive(), clock.now_ns()
        t_ns = clock.now_ns() - start_ns
        if pace.longest_lag_ns is not None:
            late_ns = max(0, t_ns - sent_until_ns - pace.longest_lag_ns)
            start_ns += late_ns
            t_ns = min(t_ns - late_ns, sent_until_ns + int(1e9 * TICK_S))
            if late_ns and punctual:
                punctual = False
                pace.delayed()
        # nothing reaches the box earlier than it was sent
        rx, received = (received, b"") if start_ns + t_ns >= received_ns else (b"", received)
        for tx in box.advance(t_ns, rx, box_port.room()):
            box_port.send(tx)
        _report(world, box, robot_port, sent_until_ns, t_ns)
        sent_until_ns = t_ns
        if t_ns > world.robot_end_ns:
            if running:
                running = False
                ended()
            if isinstance(robot_port, Port):
                robot_port.send(END + b"\n" if robot_port.client else b"")
                robot_port.drop()
            if not box_port.connected():
                return
        box_port.wait(pace.pause_s)


def _report(world: World, box: SimulatedBox, robot_port: Port | RtdeServer, since_ns: int, until_ns: int) -> None:
    """Send the robot's client the readings between two true times."""
    if isinstance(robot_port, Port):
        _, lines = world.robot_lines(since_ns, until_ns, box.output_at)
        robot_port.send(b"".join(lines) if robot_port.client else b"")
    else:
        robot_port.report(world.robot_states(since_ns, until_ns, box.output_at))
