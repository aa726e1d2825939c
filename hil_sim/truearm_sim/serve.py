"""The lab in real time: the box behind a TCP port or a pseudo-terminal, the robot behind a TCP port, on loopback.

Time starts with the first connection. Each tick the box is granted the time that has passed on the wall, with what its client
wrote; while nobody is connected the link takes nothing, and the box counts what it has to drop.
"""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from truearm.record.joint_lines import END
from truearm.record.links import HostClock

from .simbox import SimulatedBox
from .world import World

if TYPE_CHECKING:
    from .rtde_server import RtdeServer

TICK_S = 0.002
LINK_BYTES = 16384  # what the link holds when its reader is slow
RX_BYTES = 256


@dataclass
class Port:
    """A listening TCP port with at most one client, and what waits to be sent to it."""

    listener: socket.socket
    client: socket.socket | None = None
    pending: bytearray = field(default_factory=bytearray)

    @staticmethod
    def listen(host: str, port: int) -> Port:
        """Raises OSError if the port is taken."""
        listener = socket.create_server((host, port), backlog=1)
        listener.setblocking(False)
        return Port(listener)

    @property
    def number(self) -> int:
        return int(self.listener.getsockname()[1])

    def connected(self) -> bool:
        """Whether there is a client; takes a waiting one. A newer client takes the older one's place."""
        try:
            client, _ = self.listener.accept()
        except BlockingIOError:
            return self.client is not None
        client.setblocking(False)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.drop()
        self.client = client
        return True

    def room(self) -> int:
        return max(0, LINK_BYTES - len(self.pending)) if self.client else 0

    def receive(self) -> bytes:
        if self.client is None:
            return b""
        try:
            data = self.client.recv(RX_BYTES)
        except BlockingIOError:
            return b""
        except OSError:
            data = b""
        if not data:
            self.drop()
        return data

    def send(self, data: bytes) -> None:
        self.pending += data
        if self.client is None or not self.pending:
            return
        try:
            del self.pending[: self.client.send(self.pending)]
        except BlockingIOError:
            return
        except OSError:
            self.drop()

    def drop(self) -> None:
        """End the client's connection; what waited for it is lost, as on a real line."""
        if self.client is not None:
            self.client.close()
        self.client = None
        self.pending.clear()

    def close(self) -> None:
        self.drop()
        self.listener.close()


class Terminal:
    """A pseudo-terminal in raw mode, with a port's manners. It counts as connected once somebody has written to it."""

    def __init__(self) -> None:
        import tty  # not on every platform

        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)
        self.pending = bytearray()
        self._seen = False
        self._ahead = b""

    def connected(self) -> bool:
        if not self._seen:
            self._ahead = self.receive()
            self._seen = bool(self._ahead)
        return self._seen

    def room(self) -> int:
        return max(0, LINK_BYTES - len(self.pending)) if self._seen else 0

    def receive(self) -> bytes:
        if self._ahead:
            data, self._ahead = self._ahead, b""
            return data
        try:
            return os.read(self._master, RX_BYTES)
        except BlockingIOError:
            return b""

    def send(self, data: bytes) -> None:
        self.pending += data
        try:
            while self.pending:
                del self.pending[: os.write(self._master, self.pending[:4096])]
        except BlockingIOError:
            return

    def close(self) -> None:
        os.close(self._master)
        os.close(self._slave)


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
    """Run until the robot's program has ended and the box's client has gone, or until ``stop()``.

    ``started`` and ``ended`` are called when time starts and when the robot's program has ended. Then a robot of lines says so and closes
    its stream, a controller goes on to send where it stands.
    ``longest_step_ns``: for a box that may be slower than the wall clock. The lab's time goes on by no more than that at once
    and falls behind, box and robot alike; without it a late box would get longer and longer steps.
    """
    clock = HostClock()  # the recorder's: a slew of the wall clock would show as a drift of the box
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
        t_ns = clock.now_ns() - start_ns
        if longest_step_ns is not None and t_ns > sent_until_ns + longest_step_ns:
            start_ns += t_ns - sent_until_ns - longest_step_ns
            t_ns = sent_until_ns + longest_step_ns
        for tx in box.advance(t_ns, box_port.receive(), box_port.room()):
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
        time.sleep(TICK_S)


def _report(world: World, box: SimulatedBox, robot_port: Port | RtdeServer, since_ns: int, until_ns: int) -> None:
    """Tell the robot's client the readings between two true times."""
    if isinstance(robot_port, Port):
        _, lines = world.robot_lines(since_ns, until_ns, box.output_at)
        robot_port.send(b"".join(lines) if robot_port.client else b"")
    else:
        robot_port.report(world.robot_states(since_ns, until_ns, box.output_at))
