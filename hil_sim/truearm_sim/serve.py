"""The lab in real time: the box behind a TCP port or a pseudo-terminal, the robot behind a TCP port, on loopback.

Time starts with the first connection. At each tick, and when its client has written something, the box is granted the
elapsed wall-clock time, with the bytes its client wrote. While no client is connected the link accepts nothing, and the box counts what it must drop.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from truearm.record.joint_lines import END
from truearm.record.links import HostClock

from .ports import Port, Terminal
from .rtde_server import RtdeServer
from .simbox import SimulatedBox
from .world import World

TICK_S = 0.002


def serve(
    world: World,
    box: SimulatedBox,
    box_port: Port | Terminal,
    robot_port: Port | RtdeServer,
    *,
    stop: Callable[[], bool] = lambda: False,
    started: Callable[[], None] = lambda: None,
    ended: Callable[[], None] = lambda: None,
    longest_step_ns: int | None = None,
) -> None:
    """Run until the robot's program has ended and the box's client has disconnected, or until ``stop()``.

    ``started`` is called when time starts, ``ended`` when the robot's program has ended. Then a robot that sends lines
    reports this and closes its stream; a controller continues to send its position. ``longest_step_ns``: for a box that
    may be slower than the wall clock. The lab's time advances by at most this much at once and falls behind, for box
    and robot alike. Without it a late box would get longer and longer steps.
    """
    clock = HostClock()  # the recorder's clock: a slew of the wall clock would look like a drift of the box
    start_ns: int | None = None
    sent_until_ns = 0
    running = True
    while not stop():
        box_there, robot_there = box_port.connected(), robot_port.connected()
        if start_ns is None:
            if not (box_there or robot_there):
                time.sleep(0.02)
                continue
            start_ns = clock.now_ns()
            started()
        received = box_port.receive()  # before the clock is read: nothing reaches the box earlier than it was sent
        t_ns = clock.now_ns() - start_ns
        if longest_step_ns is not None and t_ns > sent_until_ns + longest_step_ns:
            start_ns += t_ns - sent_until_ns - longest_step_ns
            t_ns = sent_until_ns + longest_step_ns
        for tx in box.advance(t_ns, received, box_port.room()):
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
        box_port.wait(TICK_S)


def _report(world: World, box: SimulatedBox, robot_port: Port | RtdeServer, since_ns: int, until_ns: int) -> None:
    """Send the robot's client the readings between two true times."""
    if isinstance(robot_port, Port):
        _, lines = world.robot_lines(since_ns, until_ns, box.output_at)
        robot_port.send(b"".join(lines) if robot_port.client else b"")
    else:
        robot_port.report(world.robot_states(since_ns, until_ns, box.output_at))
