"""The recorder with a box in memory: the protocol, and how recordings end."""

import cbor2
import pytest
from record_box import (
    HOST_0,
    SECOND,
    Box,
    ComingBack,
    Lab,
    Robot,
    Wire,
    array,
    frame,
    ident,
    u32,
)
from record_files import events, received, run, topics

from truearm.errors import LinkClosed, LinkError, ProtocolError
from truearm.record.box_storage import BoxStorage, ClockExchanges
from truearm.record.operator import Counters
from truearm.record.recorder import Hooks, RecordOptions, record
from truearm.record.session_writer import SessionWriter
from truearm.session.session_file import open_session


class TestProtocol:
    def test_no_box_at_all(self, lab, path):
        link = Wire(lab, "nobody")
        with SessionWriter(path, lab) as writer, pytest.raises(LinkError, match="no answer to 'identify'"):
            record(link, writer, lab)
        assert open_session(path).metadata["session-end"]["reason"] == "failed"

    def test_something_else_talks(self, lab, path):
        link = Wire(lab, "a modem")
        lab.at(HOST_0 + SECOND, lambda: link.deliver(b"NO CARRIER\r\n"))
        with SessionWriter(path, lab) as writer, pytest.raises(LinkError):
            record(link, writer, lab)
        assert [m.data for m in topics(path)["/box/console"]] == [b"NO CARRIER\r\n"]

    def test_a_newer_minor_is_accepted(self, lab, path):
        box = Box(lab)
        box.protocol = (1, 9, 3)
        assert run(lab, box, path).counters.samples > 0

    @pytest.mark.parametrize(("protocol", "who"), [((2, 0), "update truearm"), ((0, 9), "update the box")])
    def test_another_major_is_refused(self, lab, path, protocol, who):
        box = Box(lab)
        box.protocol = protocol
        with pytest.raises(ProtocolError, match=who):
            run(lab, box, path)
        assert topics(path)["/box/ident"]

    def test_a_refused_command(self, lab, path):
        box = Box(lab)
        box.refuse = {49: (3, "out of range")}
        with pytest.raises(ProtocolError, match="refuses 'configure 0 128': out"):
            run(lab, box, path, options=RecordOptions(osr=128))

    def test_ids_differ_from_those_of_an_earlier_session(self, tmp_path):
        lab = Lab()
        box = Box(lab)
        run(lab, box, tmp_path / "a", 0.5)
        run(lab, box, tmp_path / "b", 0.5)
        assert len({c[1] for c in box.commands}) == len(box.commands)

    def test_an_answer_to_another_command(self, lab, path):
        short = ident(1)
        short["streams"][0]["channels"] = [{"name": "a", "scale": [1, 0]}]
        with SessionWriter(path, lab) as writer:
            storage = BoxStorage(writer, Counters(), ClockExchanges(writer, Counters()), awaited=5)
            for kind in (64, 65, 19):
                more = [3, "refused"] if kind == 65 else [0, 1, cbor2.dumps(cbor2.dumps(short))]
                storage.take(HOST_0, frame(array(kind, u32(1), 4, *more)))
                assert storage.answer is None
                storage.take(HOST_0, frame(array(kind, u32(1), 5, *more)))
                assert storage.answer == ("refused (error 3)" if kind == 65 else "")
                storage.answer = None


class TestEnds:
    def test_the_robot_closes_its_stream(self, lab, path):
        box = Box(lab)
        robot = Robot(lab, 2.0, LinkClosed("done"))
        summary = run(lab, box, path, None, robot=robot.link)
        assert summary.reason == "robot closed"
        assert [m.data for m in topics(path)["/robot/joints"]] == robot.sent
        assert events(path) == ["start", "robot-closed", "stop"]
        assert not box.streaming

    def test_the_robot_is_lost(self, lab, path):
        summary = run(lab, Box(lab), path, None, robot=Robot(lab, 2.0, LinkError("reset by peer")).link)
        assert (summary.reason, summary.text) == ("robot lost", "reset by peer")

    def test_the_robots_console_and_last_words(self, lab, path):
        robot = Robot(lab, 2.0, LinkClosed("done"))
        lab.at(HOST_0 + SECOND, lambda: robot.link.deliver(b"hello\r\n"))
        lab.at(HOST_0 + 2 * SECOND - 1, lambda: robot.link.deliver(b'{"t": 1'))
        summary = run(lab, Box(lab), path, None, robot=robot.link)
        assert [m.data for m in topics(path)["/robot/console"]] == [b"hello\r", b'{"t": 1']
        assert summary.counters.robot_lines == len(robot.sent)

    def test_until_and_interrupted(self, tmp_path):
        for reason in ("until", "interrupted"):
            lab = Lab()
            box = Box(lab)
            summary = run(
                lab, box, tmp_path / reason, None, hooks=Hooks(**{reason: lambda lab=lab: lab.now > HOST_0 + SECOND})
            )
            assert summary.reason == reason
            assert not box.streaming
            assert events(tmp_path / reason) == ["start", "stop"]

    def test_keyboard_interrupt_in_a_read(self, lab, path):
        box = Box(lab)

        def strike():
            raise KeyboardInterrupt

        lab.at(HOST_0 + 2 * SECOND, strike)
        summary = run(lab, box, path, None)
        assert summary.reason == "interrupted"
        assert not open_session(path).truncated
        assert received(path) == box.sent.replace(b"\0", b"")

    def test_a_link_that_cannot_come_back(self, lab, path):
        box = Box(lab)
        lab.at(HOST_0 + 2 * SECOND, lambda: setattr(box.link, "error", LinkError("unplugged")))
        summary = run(lab, box, path)
        assert (summary.reason, summary.text) == ("link lost", "unplugged")
        assert events(path) == ["start", "link-lost", "stop"]

    @pytest.mark.parametrize("rebooted", [True, False])
    def test_a_link_that_comes_back(self, lab, path, rebooted):
        box = Box(lab, ComingBack)

        def pull():
            box.link.error = LinkError("unplugged")

        def plug():
            box.link.error = None
            if rebooted:
                box.boot(0x3333)

        lab.at(HOST_0 + 2 * SECOND, pull)
        lab.at(HOST_0 + 4 * SECOND, plug)
        summary = run(lab, box, path, 6.0)
        again = ["box-restarted", "start"] if rebooted else []
        assert summary.reason == "duration"
        assert events(path) == ["start", "link-lost", "link-back", *again, "stop"]
        assert topics(path)["/box/adc"][-1].t_host_ns > HOST_0 + 5 * SECOND
        assert rebooted or [c[0] for c in box.commands] == [48, 51, 50, 48, 51]  # asked whether it is the same
        assert (summary.counters.lost_frames > 150) != rebooted  # 2 s of a box that ran on are lost, and counted
