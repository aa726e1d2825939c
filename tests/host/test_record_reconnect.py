"""Links that are lost and return: what is reopened, reported and counted, and how long the recorder waits."""

import json
import os
import signal
import threading
import time

import pytest
from record_box import HOST_0, SECOND, Box, ComingBack, Robot
from record_files import events, run, topics
from record_real import PATIENCE_S, OnTerminals, real_time_box
from tests.refusals import shown

from truearm.cli.main import main
from truearm.errors import LinkError
from truearm.record.links import Backlog, Reopening
from truearm.session.joint_readings import JointReader
from truearm.session.session_file import open_session


def joints_of(path):
    reader = JointReader()
    for messages in open_session(path).batches():
        reader.take(messages)
    return reader.finish()


def lose(lab, link, since_s, until_s, error=None):
    lab.at(HOST_0 + int(since_s * SECOND), lambda: setattr(link, "error", error or LinkError("reset by peer")))
    lab.at(HOST_0 + int(until_s * SECOND), lambda: setattr(link, "error", None))


class TestRobot:
    def test_readings_that_are_lost_are_counted(self, lab, path):
        """8 ms a reading: those between 2 and 4 s are lost, exactly; a segment begins, and the rest is whole."""
        robot = Robot(lab, 6.0, link=ComingBack)
        lose(lab, robot.link, 2.0, 4.0)
        summary = run(lab, Box(lab), path, None, robot=robot.link)
        assert summary.reason == "robot closed"
        assert summary.counters.robot_losses == 1
        assert events(path) == ["start", "robot-lost", "robot-back", "robot-closed", "stop"]
        received = [json.loads(m.data)["seq"] for m in topics(path)["/robot/joints"]]
        missing = sorted(set(range(len(robot.sent))) - set(received))
        assert missing == list(range(missing[0], missing[-1] + 1))
        assert len(missing) == pytest.approx(250, abs=7)  # 50 ms between attempts
        (back,) = events(path, "robot-back")
        assert back["lost"] == len(missing)
        assert back["away_s"] == pytest.approx(0.008 * (len(missing) + 1), abs=0.001)
        joints = joints_of(path)
        assert (joints.lost, joints.restarts, len(joints.clocks)) == (len(missing), 1, 2)

    def test_a_robot_that_does_not_count(self, lab, path):
        robot = Robot(lab, 4.0, counts=False, link=ComingBack)
        lose(lab, robot.link, 1.0, 2.0)
        run(lab, Box(lab), path, None, robot=robot.link)
        assert "lost" not in events(path, "robot-back")[0]
        assert joints_of(path).lost is None


class TestBox:
    def test_under_another_name(self, tmp_path, monkeypatch, capsys):
        """A USB cable is pulled and plugged in again: the box, without power meanwhile, has booted, and its port has another name."""
        lab, box = real_time_box()
        usb = OnTerminals(box, lab)
        first = usb.device
        monkeypatch.setattr("truearm.record.links.list_ports.comports", usb.ports)
        held = []

        def handle():
            wait_for(lambda: box.blocks >= 30)
            usb.unplug()
            time.sleep(0.6)
            while not any(other.device == first for other in held):  # somebody else has the name now
                held.append(OnTerminals(*reversed(real_time_box())))
            box.boot(0x4444)
            usb.plug()
            blocks = box.blocks
            wait_for(lambda: box.blocks >= blocks + 30)
            os.kill(os.getpid(), signal.SIGINT)  # however long it took

        thread = threading.Thread(target=handle)
        thread.start()
        out = tmp_path / "s.mcap"
        assert main(["record", "--box", first, "--duration-s", "60", "--out", str(out)]) == 130
        thread.join(PATIENCE_S)
        assert usb.device != first
        assert events(out) == ["start", "link-lost", "link-back", "box-restarted", "start", "stop"]
        assert events(out, "link-back")[0]["device"] == usb.device
        usb.unplug()
        assert all(other.box.commands == [] for other in held)  # nobody asked the others
        for other in held:
            other.unplug()
        assert shown["recording-disturbed"]["link_losses"] == 1


def wait_for(true):
    deadline = time.monotonic() + PATIENCE_S
    while not true() and time.monotonic() < deadline:
        time.sleep(0.01)
    assert true()


class Slow:
    """A link that takes long to open."""

    name = "slow"

    def __init__(self, opened, closed):
        opened.wait(PATIENCE_S)
        self._closed = closed
        self.backlog = Backlog(3, 2)

    def close(self):
        self._closed.append(self)


class TestReopening:
    def test_who_waits_is_not_kept_waiting(self):
        opened, closed = threading.Event(), []
        opened.set()
        link = Reopening(lambda: Slow(opened, closed))
        assert link.backlog == Backlog(3, 2)
        opened.clear()
        before = time.monotonic()
        assert not link.reopen(0.0)
        assert not link.reopen(0.02)
        assert time.monotonic() - before < 1.0
        assert link.backlog == Backlog(0, 2)
        opened.set()
        assert link.reopen(PATIENCE_S)
        assert link.backlog == Backlog(3, 4)
        link.close()
        assert len(closed) == 2

    def test_what_opens_after_the_end_is_closed(self):
        opened, closed = threading.Event(), []
        opened.set()
        link = Reopening(lambda: Slow(opened, closed))
        opened.clear()
        assert not link.reopen(0.0)
        link.close()
        opened.set()
        wait_for(lambda: len(closed) == 2)
