"""The simulated controller before a client that is not ours: ``RTDEReceiveInterface`` of the package ur-rtde (SDU Robotics).

It takes a host name and no port, so each test listens on port 30004 of a loopback address of its own. It runs in another process:
while its constructor waits it lets no other Python thread run.
"""

import importlib.util
import json
import os
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from truearm.record.robots import rtde
from truearm.record.robots.rtde import PORT
from truearm_sim.ports import Port
from truearm_sim.rtde_server import RtdeServer
from truearm_sim.world import Setup, World, standard_plan

WORLD = World(1, standard_plan(9, 1), setup=Setup(robot_rate=500.0))
HOST = f"127.30.{os.getpid() % 250 + 1}.4"
linux = pytest.mark.skipif(sys.platform != "linux", reason="needs all of 127/8 as loopback")
peer = pytest.mark.skipif(
    importlib.util.find_spec("rtde_receive") is None,
    reason="ur-rtde has wheels for Python 3.11 and 3.12 on Linux, x86-64",
)

CLIENT = """
import json, sys, time
from rtde_receive import RTDEReceiveInterface
host, hz, names = json.loads(sys.argv[1])
robot = RTDEReceiveInterface(host, hz, names)
rows, seen, end = [], set(), time.monotonic() + 20.0
while len(seen) < 60 and time.monotonic() < end:  # as long as that takes on a machine that is busy
    rows.append([robot.getTimestamp(), robot.getActualQ(), robot.getTargetQ(), robot.getActualQd(), robot.getRobotMode()])
    seen.add(tuple(rows[-1][1]))
    time.sleep(0.004)
print(json.dumps([robot.isConnected(), rows]))
robot.disconnect()
"""


@pytest.fixture
def lab():
    """Run the controller in real time from the beginning of its longest move; return what it has sent so far."""
    server = RtdeServer(Port.listen(HOST, PORT), 500.0)
    told, stop = [], threading.Event()
    move = np.argmax(WORLD.controller.arrive - WORLD.controller.move_start)
    at_ns = round(1e9 * WORLD.controller.move_start[move])

    def run():
        start_ns = last_ns = None
        while not stop.is_set():
            server.connected()
            if start_ns is None and server.running:
                start_ns = time.perf_counter_ns()
            now_ns = at_ns if start_ns is None else at_ns + time.perf_counter_ns() - start_ns
            last_ns = last_ns or now_ns
            told.append(WORLD.robot_states(last_ns, now_ns))
            server.report(told[-1])
            last_ns = now_ns
            time.sleep(0.002)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    yield told
    stop.set()
    thread.join()
    server.close()


def joined(told):
    return [np.concatenate(column) for column in zip(*told, strict=True)]


def rows_of(known):
    return {row.tobytes() for row in np.ascontiguousarray(known)}


@linux
@peer
@pytest.mark.parametrize("names", [[], ["timestamp", "actual_q", "target_q", "actual_qd", "robot_mode"]])
def test_an_independent_client_reads_the_joints(lab, names):
    """Every vector that it read is, bit for bit, one that the World told; asked for no names, it wants all 58 that it knows."""
    argument = json.dumps([HOST, 500.0, names])
    done = subprocess.run([sys.executable, "-c", CLIENT, argument], capture_output=True, text=True, timeout=30)
    assert done.returncode == 0, done.stderr
    connected, rows = json.loads(done.stdout)
    assert connected
    _, t_robot, _, q, q_cmd, qd, _, _ = joined(lab)
    for read, known in zip(list(zip(*rows, strict=True))[:4], (t_robot, q, q_cmd, qd), strict=True):
        assert rows_of(np.array(read)) <= rows_of(known)
        assert len(rows_of(np.array(read))) > 50  # it moved, and the client saw it move
    assert {row[4] for row in rows} == {7}


class Asked:
    """A Port without a network: it receives what the client wrote and keeps what is sent."""

    def __init__(self):
        self.client, self.sent, self.asked = object(), b"", b""

    def connected(self):
        return True

    def receive(self):
        asked, self.asked = self.asked, b""
        return asked

    def send(self, data):
        self.sent += data

    def room(self):
        return 1 << 16

    def drop(self):
        self.client = None


def ask(server, *requests, until_ns=0):
    server.port.asked, server.port.sent = b"".join(requests), b""
    server.report(WORLD.robot_states(0, until_ns))
    return rtde.Packages().push(server.port.sent)


class TestProtocol:
    def test_a_name_that_does_not_exist(self):
        server = RtdeServer(Asked(), 500.0)
        ((kind, payload),) = ask(server, rtde.request_outputs(["timestamp", "no_such"], 500.0))
        assert (kind, payload) == (rtde.OUTPUTS, b"\0DOUBLE,NOT_FOUND")
        assert ask(server, rtde.packed(rtde.START)) == [(rtde.START, b"\0")]

    def test_another_version_is_refused(self):
        assert ask(RtdeServer(Asked(), 500.0), bytes.fromhex("0005560001")) == [(rtde.VERSION, b"\0")]

    def test_start_pause_and_a_lower_rate(self):
        server = RtdeServer(Asked(), 500.0)
        set_up = rtde.request_outputs(["timestamp"], 100.0)
        ask(server, set_up)
        told = ask(server, rtde.packed(rtde.START), until_ns=1_000_000_000)
        assert told[0] == (rtde.START, b"\1")
        assert len(told) == pytest.approx(101, abs=1)
        assert ask(server, rtde.packed(rtde.PAUSE), until_ns=1_000_000_000) == [(rtde.PAUSE, b"\1")]

    @settings(max_examples=200, deadline=None)
    @given(
        st.lists(st.tuples(st.sampled_from(b"VvOSPUMI"), st.binary(max_size=40)), max_size=6), st.binary(max_size=40)
    )
    def test_any_requests(self, packages, rest):
        server = RtdeServer(Asked(), 500.0)
        requests = [rtde.packed(kind, payload) for kind, payload in packages]
        told = ask(server, *requests, rest, until_ns=100_000_000)
        assert [kind for kind, _ in told if kind != rtde.DATA][: len(packages)] == [
            kind if kind in b"VvOSP" else rtde.TEXT for kind, _ in packages
        ]

    @pytest.mark.parametrize("hz", [float("nan"), float("inf"), -1.0, 0.0, 1e-300, 1e300])
    def test_impossible_rates(self, hz):
        """Refused, or as fast as the controller can."""
        server = RtdeServer(Asked(), 500.0)
        told = ask(server, rtde.request_outputs(["timestamp"], hz), rtde.packed(rtde.START), until_ns=100_000_000)
        assert len(told) == (2 if not hz >= 1.0 else 52)

    def test_rubbish_ends_the_connection(self):
        server = RtdeServer(Asked(), 500.0)
        ask(server, b"\0\0\0\0")
        assert server.port.client is None
