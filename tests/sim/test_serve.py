"""The lab behind ports: how it ends, and how long a box that an emulator computes takes to answer."""

import json
import socket
import threading
from dataclasses import replace
from types import SimpleNamespace

import pytest

import truearm_sim.serve
from truearm_sim.ports import Port
from truearm_sim.serve import EMULATED, TICK_S, serve

END_NS = 200_000_000


def lab():
    """Return a lab with a silent box and a robot whose program ends soon."""
    world = SimpleNamespace(
        robot_end_ns=END_NS, robot_lines=lambda since, until, level: ([], [b"reading\n"] * (until <= END_NS))
    )
    return world, SimpleNamespace(advance=lambda t_ns, rx, room: [], output_at=None)


def test_a_robot_of_lines_says_that_it_has_ended_and_closes():
    """Also to who comes later; the lab ends when the box's client has gone."""
    box_port, robot_port = Port.listen("127.0.0.1", 0), Port.listen("127.0.0.1", 0)
    ended = threading.Event()
    thread = threading.Thread(
        target=serve, args=(*lab(), box_port, robot_port), kwargs={"ended": ended.set}, daemon=True
    )
    thread.start()
    with socket.create_connection(("127.0.0.1", box_port.number)):
        for _ in range(2):
            with socket.create_connection(("127.0.0.1", robot_port.number), timeout=5) as robot:
                said = robot.makefile("rb").read()  # until it closes
            assert json.loads(said.splitlines()[-1]) == {"end": True}
        assert ended.is_set()
        assert b"reading" not in said
        assert thread.is_alive()
    thread.join(5)
    assert not thread.is_alive()
    box_port.close()
    robot_port.close()


class Emulated:
    """A box whose time costs ``slow`` times as much wall-clock time, a step 60 µs more. It is its own port, and the wall clock.

    Its client sends a request 23 ms after each answer. The box answers after 1.5 ms.
    """

    def __init__(self, slow):
        self.slow = slow
        self.wall_ns = self.t_ns = 0
        self.sent_ns = self.due_ns = None  # the request that waits, its answer
        self.next_ns = 23_000_000
        self.late_ns = []

    def now_ns(self):
        return self.wall_ns

    def connected(self):
        return True

    def room(self):
        return 1000

    def receive(self):
        if self.sent_ns is not None or self.wall_ns < self.next_ns:
            return b""
        self.sent_ns = self.next_ns
        return b"?"

    def wait(self, timeout_s):
        self.wall_ns = max(self.wall_ns + 1000, min(self.wall_ns + round(1e9 * timeout_s), self.next_ns))

    def send(self, data):
        if data:
            self.late_ns.append(self.wall_ns - self.sent_ns - 1_500_000)
            self.sent_ns, self.next_ns = None, self.wall_ns + 23_000_000

    def _run(self, until_ns):
        self.wall_ns += round(self.slow * (until_ns - self.t_ns))
        self.t_ns = until_ns

    def advance(self, t_ns, rx, room):
        self.wall_ns += 60_000
        if self.due_ns is not None and self.due_ns <= t_ns:
            self._run(self.due_ns)
            self.due_ns = None
            yield b"!"
        self._run(t_ns)
        if rx:
            self.due_ns = t_ns + 1_500_000


def answers(monkeypatch, slow):
    """Return how late a hundred answers are [ms], and how often time was delayed."""
    box = Emulated(slow)
    monkeypatch.setattr(truearm_sim.serve, "HostClock", lambda: box)
    delays = []
    world = SimpleNamespace(robot_end_ns=1 << 62, robot_states=lambda since, until, level: [])
    box.output_at, robot = None, SimpleNamespace(connected=lambda: False, report=lambda states: None)
    pace = replace(EMULATED, delayed=lambda: delays.append(1))
    serve(world, box, box, robot, stop=lambda: len(box.late_ns) == 100, pace=pace)
    return [1e-6 * late for late in box.late_ns], len(delays)


@pytest.mark.parametrize(("slow", "late_ms"), [(0.3, 0.2), (0.5, 0.3), (0.9, 2.0)])
def test_an_emulated_box_answers_as_soon_as_it_can(monkeypatch, slow, late_ms):
    late, delays = answers(monkeypatch, slow)
    assert 0.0 <= min(late) < late_ms
    assert delays == 0


def test_an_emulated_box_that_is_too_slow_is_reported_once(monkeypatch):
    """Its time falls behind, by so much that an answer is never later than the longest lag and two ticks."""
    late, delays = answers(monkeypatch, 1.6)
    assert delays == 1
    assert min(late) >= 0.0
    assert max(late) < 1e-6 * EMULATED.longest_lag_ns + 2e3 * TICK_S * 1.6
