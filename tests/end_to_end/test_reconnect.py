"""The box is unplugged and plugged in again, the robot's network fails, and the session continues afterwards."""

import json
import socket
import struct
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from tests.end_to_end.conftest import interpreter, lab_with, record_session, recorded_with_plan

from truearm.cli.main import main
from truearm.model.robot import builtin_robot
from truearm.record.session_writer import SessionWriter
from truearm.session.joint_readings import JointReader
from truearm.session.session_file import open_session
from truearm.session.streams import BoxReader
from truearm.workflows.inputs import Sources, read_sources
from truearm.workflows.session_observations import observations_of_session
from truearm.workflows.session_parts import SETUP, session_parts, with_parts
from truearm_sim.ports import Port, Terminal
from truearm_sim.serve import serve
from truearm_sim.simbox import SimulatedBox
from truearm_sim.world import World, standard_plan

S = 1_000_000_000
CHAIN = builtin_robot("puma560").chain


class Cable:
    """A box and the pseudo-terminal that it shows while it is plugged in, which has another name each time; and the robot's network.

    ``course``: seconds of the lab, and what happens then: "unplug", "plug" (the box boots) or "reset" (of the robot's connection).
    """

    def __init__(self, box, robot, course):
        self._box, self._robot, self._course = box, robot, list(course)
        self.names = []
        self._taken = []
        self._terminal = None
        self._plug()

    def advance(self, t_ns, rx=b"", tx_room=0xFFFF):
        while self._course and t_ns >= self._course[0][0] * S:
            what = self._course.pop(0)[1]
            if what == "unplug":
                self._terminal.close()
                self._terminal = None
            elif what == "plug":
                self._plug()
                self._box.power_cycle(t_ns)
            else:
                self._robot.client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                self._robot.drop()
        return self._box.advance(t_ns, rx, tx_room)

    def output_at(self, *arguments):
        return self._box.output_at(*arguments)

    def _plug(self):
        self._terminal = Terminal()
        while self._terminal.path in self.names:  # somebody else got the name that was free
            self._taken.append(self._terminal)
            self._terminal = Terminal()
        self.names.append(self._terminal.path)

    def connected(self):
        return self._terminal is not None and self._terminal.connected()

    def room(self):
        return 0 if self._terminal is None else self._terminal.room()

    def receive(self):
        return b"" if self._terminal is None else self._terminal.receive()

    def wait(self, timeout_s):
        if self._terminal is None:
            time.sleep(timeout_s)
        else:
            self._terminal.wait(timeout_s)

    def send(self, data):
        if self._terminal is not None:
            self._terminal.send(data)

    def ports(self):
        """As pyserial lists them."""
        if self._terminal is None:
            return []
        return [
            SimpleNamespace(
                device=self._terminal.path, vid=0x2E8A, pid=5, serial_number="E6", product="", description=""
            )
        ]

    def close(self):
        for terminal in filter(None, (self._terminal, *self._taken)):
            terminal.close()


def test_cable_and_network(tmp_path, monkeypatch):
    """In real time over a pseudo-terminal and TCP. What is lost is said; what is not lost is whole, and read back."""
    world = World(5, standard_plan(9, 5))
    box, robot = SimulatedBox(world, interpreter(), seed=5), Port.listen("127.0.0.1", 0)
    cable = Cable(box, robot, [(2.0, "unplug"), (2.5, "plug"), (5.5, "reset")])
    stop = threading.Event()
    thread = threading.Thread(
        target=serve, args=(world, cable, cable, robot), kwargs={"stop": stop.is_set}, daemon=True
    )
    thread.start()
    monkeypatch.setattr("truearm.record.ports.list_ports.comports", cable.ports)
    out = tmp_path / "s.mcap"
    try:
        address = f"tcp://127.0.0.1:{robot.number}"
        assert main(["record", "--address", address, "--duration-s", "8", "--out", str(out)]) == 0
    finally:
        stop.set()
        thread.join(20)
        box.close()
        cable.close()
        robot.close()
    assert len(set(cable.names)) == 2
    rows = [json.loads(m.data) for m in open_session(out).messages(["/events"])]
    wanted = ("start", "link-lost", "link-back", "box-restarted", "robot-lost", "robot-back", "stop")
    kinds = [row["kind"] for row in rows if row["kind"] in wanted]
    assert kinds == ["start", "link-lost", "link-back", "box-restarted", "start", "robot-lost", "robot-back", "stop"]
    back = {row["kind"]: row for row in rows}
    assert back["link-back"]["device"] == cable.names[1]
    reader, joints = BoxReader(), JointReader()
    blocks = []
    for messages in open_session(out).batches():
        joints.take(messages)
        blocks += reader.feed(messages)
    blocks += reader.finish()
    assert {block.segment for block in blocks} == {0, 1}
    assert (reader.losses().samples_overrun, reader.losses().restarts) == (0, 1)
    for segment in (0, 1):  # each life of the box is whole: n0 counts on from block to block
        n0 = np.concatenate([some.table["n0"] for some in blocks if some.segment == segment])
        n = np.concatenate([some.table["n"] for some in blocks if some.segment == segment])
        assert n0[0] == 0
        assert np.array_equal(n0[1:], n0[:-1] + n[:-1])
    stream = joints.finish()
    assert (
        back["robot-back"]["lost"] == stream.lost
    )  # none if the link is back before the first reading of the new life
    assert stream.lost <= 50 * (back["robot-back"]["away_s"] + 0.1)  # 50 readings a second
    assert stream.restarts == 1


@pytest.fixture(scope="module")
def in_parts(tmp_path_factory):
    """One robot's program, recorded as a whole and, by a recorder that was stopped in between, in two parts."""
    folder = tmp_path_factory.mktemp("parts")
    whole = record_session(folder / "whole.mcap", 18, osr=16384)
    first = folder / "s.mcap"
    with lab_with(World(1, standard_plan(18, 1))) as lab:
        for path, setup, seconds in ((first, {}, 60.0), (folder / "s.2.mcap", {"of": "s.mcap", "part": "2"}, None)):
            summary = recorded_with_plan(lab, path, osr=16384, duration_s=seconds, head=[(SETUP, setup)])
            assert summary.reason == ("duration" if seconds else "robot closed")
            for _ in range(40):
                lab.box_link.read(0.1)  # the break: four seconds
    return whole.path, first


def test_parts_are_one_session(in_parts):
    """All dwells of both parts, of which the break cost one or two; their lengths are those of the whole recording to its noise."""
    whole, first = in_parts
    assert [path.name for path in session_parts(first)] == ["s.mcap", "s.2.mcap"]
    reference = observations_of_session(whole).table
    _, table, *_ = read_sources(Sources(tuple(with_parts([first]))), CHAIN)
    assert len(reference) - 3 <= len(table) < len(reference)
    assert {str(source).split(" ")[0].split(":")[0] for source in table.source} >= {"s.mcap", "s.2.mcap"}
    apart = np.max(np.abs(table.q[:, None, :] - reference.q[None, :, :]), axis=2)
    same = np.argmin(apart, axis=1)
    assert np.all(apart[np.arange(len(table)), same] < 1e-3)
    assert np.array_equal(table.bar, reference.bar[same])
    # the same dwells of the same world: they differ by the samples that are used, each mean good to a micron or so
    assert np.max(np.abs(table.value - reference.value[same])) < 2e-5


def test_an_empty_part_is_no_fault(in_parts, tmp_path):
    """Stopped before the first dwell: the other parts count."""
    _, first = in_parts
    for path in session_parts(first):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    short = tmp_path / "s.3.mcap"
    session = open_session(first)
    with SessionWriter(short, _Clock(session)) as writer:
        writer.metadata(SETUP, {"of": "s.mcap", "part": "3"})
        writer.attach("rig.toml", session.attachments["rig.toml"])
    _, two, *_ = read_sources(Sources(tuple(with_parts([first]))), CHAIN)
    _, three, *_ = read_sources(Sources(tuple(with_parts([tmp_path / "s.mcap"]))), CHAIN)
    assert len(with_parts([tmp_path / "s.mcap"])) == 3
    assert np.array_equal(two.value, three.value)


class _Clock:
    kind = "virtual"

    def __init__(self, session):
        self._now = int(session.metadata["session-end"]["monotonic_ns"])

    def now_ns(self):
        return self._now

    def utc_anchor(self):
        return self._now, self._now
