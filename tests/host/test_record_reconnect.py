"""Links that are lost and return: what is reopened, reported and counted, and how long the recorder waits."""

import json
import os
import signal
import threading
import time

import pytest
from record_box import HOST_0, MS, SECOND, Box, ComingBack, Robot
from record_files import events, run, topics
from record_real import PATIENCE_S, OnTerminals, real_time_box
from tests.refusals import shown

from truearm.cli.main import main
from truearm.errors import LinkClosed, LinkError, ProtocolError
from truearm.record.joint_lines import END
from truearm.record.links import Backlog
from truearm.record.recorder import PATIENCE_S as WAITS_S
from truearm.record.recorder import Hooks, RecordOptions
from truearm.record.reopening import Reopening
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
    def test_back_after_two_seconds(self, lab, path):
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

    def test_a_close_in_order_is_not_called_a_loss(self, lab, path):
        """So a program that ends closes its connection, and a controller that is started again. The next one is recorded too."""
        robot = Robot(lab, 6.0, link=ComingBack)
        lose(lab, robot.link, 2.0, 4.0, LinkClosed("closed"))
        summary = run(lab, Box(lab), path, None, robot=robot.link)
        assert summary.reason == "robot closed"
        assert summary.duration_s == pytest.approx(6.0, abs=0.1)
        assert summary.counters.robot_losses == 0
        assert events(path) == ["start", "robot-closed", "robot-back", "robot-closed", "stop"]
        assert joints_of(path).restarts == 1
        assert [m.data for m in topics(path)["/robot/console"]] == [END]

    def test_a_close_in_order_that_was_the_end(self, lab, path):
        robot = Robot(lab, 2.0, LinkClosed("closed"), link=ComingBack)
        seen = []
        summary = run(
            *(lab, Box(lab), path, None),
            robot=robot.link,
            options=RecordOptions(patience_s=5.0),
            hooks=Hooks(progress=lambda status: seen.append((status.robot_ok, status.robot_closed))),
        )
        assert set(seen) == {(True, False), (False, True)}
        assert (summary.reason, summary.text[:6]) == ("robot closed", "closed")
        assert summary.duration_s == pytest.approx(7.0, abs=0.1)

    def test_a_link_without_readings_is_not_the_robot(self, lab, path):
        """It is taken by a controller whose program does not run."""
        robot = Robot(lab, 20.0, link=ComingBack)
        lose(lab, robot.link, 2.0, 3.0)
        lab.at(HOST_0 + 2 * SECOND, lambda: setattr(robot.link, "deliver", lambda data: None))
        summary = run(lab, Box(lab), path, None, robot=robot.link, options=RecordOptions(patience_s=5.0))
        assert (summary.reason, summary.duration_s) == ("robot lost", pytest.approx(7.0, abs=0.1))
        assert events(path) == ["start", "robot-lost", "stop"]

    @pytest.mark.parametrize(
        "line", [b'{"end": false}', b'{"end": true, "q": 1}', b'["end"]', b'{"end": ' + b"[" * 5000]
    )
    def test_what_is_no_word_of_its_end(self, lab, path, line):
        robot = Robot(lab, 2.0, link=ComingBack)
        lab.at(HOST_0 + SECOND, lambda: robot.link.deliver(line + b"\n"))
        assert run(lab, Box(lab), path, None, robot=robot.link).duration_s == pytest.approx(2.0, abs=0.1)

    def test_a_robot_that_does_not_count(self, lab, path):
        robot = Robot(lab, 4.0, counts=False, link=ComingBack)
        lose(lab, robot.link, 1.0, 2.0)
        run(lab, Box(lab), path, None, robot=robot.link)
        assert "lost" not in events(path, "robot-back")[0]
        assert joints_of(path).lost is None

    def test_what_is_no_loss_of_the_link_is_not_tried_again(self, lab, path):
        robot = Robot(lab, 20.0, link=ComingBack)
        lab.at(HOST_0 + SECOND, lambda: setattr(robot.link, "error", ProtocolError("is not RTDE")))
        summary = run(lab, Box(lab), path, None, robot=robot.link)
        assert (summary.reason, summary.text) == ("robot lost", "is not RTDE")

    def test_silence_is_noted(self, lab, path):
        robot = Robot(lab, 10.0, link=ComingBack)
        deliver = robot.link.deliver
        lab.at(HOST_0 + SECOND, lambda: setattr(robot.link, "deliver", lambda data: None))
        lab.at(HOST_0 + 6 * SECOND, lambda: setattr(robot.link, "deliver", deliver))
        seen = []
        run(
            lab,
            Box(lab),
            path,
            8.0,
            robot=robot.link,
            hooks=Hooks(progress=lambda s: seen.append(s.robot_age_s or 0.0)),
        )
        assert events(path) == ["start", "robot-silent", "robot-heard", "stop"]
        assert max(seen) == pytest.approx(5.0, abs=0.3)
        assert seen[-1] < 0.1


class TestBox:
    def test_not_for_ever(self, lab, path):
        box = Box(lab, ComingBack)
        lose(lab, box.link, 2.0, 1e6, LinkError("unplugged"))
        summary = run(lab, box, path, None, options=RecordOptions(patience_s=5.0))
        assert summary.reason == "link lost"
        assert summary.text.startswith("unplugged")
        assert WAITS_S == 600.0

    def test_ctrl_c_while_it_is_away(self, lab, path):
        box = Box(lab, ComingBack)
        lose(lab, box.link, 2.0, 1e6)
        summary = run(lab, box, path, None, hooks=Hooks(interrupted=lambda: lab.now > HOST_0 + 3 * SECOND))
        assert summary.reason == "interrupted"
        assert events(path) == ["start", "link-lost", "stop"]

    def test_another_box_is_refused(self, lab, path):
        box = Box(lab, ComingBack)
        lose(lab, box.link, 2.0, 3.0)

        def exchange():
            box.uid = b"\x09\x09"
            box.boot(0x3333)

        lab.at(HOST_0 + int(2.5 * SECOND), exchange)
        with pytest.raises(ProtocolError, match=r"another box answers \(0909.*01020304\)"):
            run(lab, box, path, 6.0)
        assert open_session(path).metadata["session-end"]["reason"] == "failed"
        assert topics(path)["/box/adc"][-1].t_host_ns < HOST_0 + 2 * SECOND + 50 * MS

    def test_under_another_name(self, tmp_path, monkeypatch, capsys):
        """A USB cable is pulled and plugged in again: the box, without power meanwhile, has booted, and its port has another name."""
        lab, box = real_time_box()
        usb = OnTerminals(box, lab)
        first = usb.device
        monkeypatch.setattr("truearm.record.ports.list_ports.comports", usb.ports)
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
