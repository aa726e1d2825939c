"""The recorder against a box in memory, in virtual time: everything is kept, and faults are what they were."""

import json

import cbor2
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from record_box import (
    HOST_0,
    LATENCY,
    MS,
    PERIOD_NS,
    SECOND,
    Box,
    Lab,
    N,
    Robot,
    Wire,
    array,
    frame,
    ident,
    run_of,
    u32,
)

from truearm.errors import LinkClosed, LinkError, ProtocolError
from truearm.record.intake import Answer, Intake
from truearm.record.probes import Probes
from truearm.record.recorder import record
from truearm.record.robot import MAX_LINE, JointLines
from truearm.record.session import open_session
from truearm.record.session_writer import SessionWriter
from truearm.record.status import Counters
from truearm.sensors.ident import parse_ident_json
from truearm.sync.joints import JointReader


@pytest.fixture
def lab():
    return Lab()


@pytest.fixture
def path(tmp_path):
    return tmp_path / "s.mcap"


def run(lab, box, path, seconds=3.0, **options):
    with SessionWriter(path, lab) as writer:
        return record(box.link, writer, lab, duration_s=seconds, **options)


def topics(path):
    """Messages by topic; the file must be complete."""
    found: dict[str, list] = {}
    for message in open_session(path).messages():
        found.setdefault(message.topic, []).append(message)
    return found


def events(path, kind=None):
    rows = [json.loads(m.data) for m in topics(path).get("/events", [])]
    return [row["kind"] for row in rows] if kind is None else [row for row in rows if row["kind"] == kind]


def received(path):
    """All bytes of the box in the order of the file, delimiters aside."""
    messages = [m for m in open_session(path).messages() if m.topic.startswith("/box/")]
    return b"".join(m.data if m.topic == "/box/console" else run_of(m.data) for m in messages)


class TestCleanRun:
    def test_what_is_in_the_file(self, lab, path):
        box = Box(lab)
        summary = run(lab, box, path)
        found = topics(path)
        blocks = [cbor2.loads(m.data) for m in found["/box/adc"]]
        assert received(path) == box.sent.replace(b"\0", b"")
        assert [b[3] for b in blocks] == list(range(0, N * len(blocks), N))
        assert len(blocks) == box.blocks == pytest.approx(3 * SECOND / (N * PERIOD_NS), abs=3)
        assert [c[0] for c in box.commands] == [48, 51, 50, 51]
        assert summary.reason == "duration"
        assert summary.counters.samples == N * len(blocks)
        assert summary.counters.lost_frames == summary.counters.console_bytes == 0
        assert summary.duration_s == pytest.approx(3.0, abs=0.05)
        assert not box.streaming

    def test_metadata(self, lab, path):
        run(lab, Box(lab), path)
        session = open_session(path)
        said = json.loads(session.metadata["box"]["ident"])
        assert said["uid"] == "01020304"
        assert said["streams"][0]["name"] == "adc"
        assert session.metadata["session"]["clock"] == "virtual"
        assert session.metadata["session-end"]["reason"] == "duration"
        assert int(session.metadata["session-end"]["samples"]) > 0
        assert events(path) == ["start", "stop"]

    def test_log_time_never_runs_back(self, lab, path):
        box = Box(lab)
        robot = Robot(lab, 2.0, LinkClosed("done"))
        run(lab, box, path, None, robot=robot.link)
        times = [m.t_host_ns for m in open_session(path).messages()]
        assert times == sorted(times)

    def test_arrival_times(self, lab, path):
        box = Box(lab)
        run(lab, box, path)
        for message in topics(path)["/box/adc"]:
            t0_us = cbor2.loads(message.data)[4]
            assert message.t_host_ns == pytest.approx(box.born + 1000 * t0_us + LATENCY, abs=1000)

    def test_clock_exchanges(self, lab, path):
        """Four a second; the bounds hold: the box's time lies between t0 and t3."""
        box = Box(lab)
        summary = run(lab, box, path, 5.0)
        rows = [json.loads(m.data) for m in topics(path)["/sync"]]
        assert len(rows) == summary.counters.probes == pytest.approx(20, abs=1)
        assert len({row["id"] for row in rows}) == len(rows)
        for row in rows:
            assert row["t3_ns"] - row["t0_ns"] == 2 * LATENCY
            assert row["t0_ns"] < box.born + 1000 * row["t1_us"] + 1000
            assert box.born + 1000 * row["t2_us"] < row["t3_ns"]
        assert summary.rtt_us == pytest.approx(2 * LATENCY / 1000)

    def test_two_runs_are_the_same(self, tmp_path):
        for name in ("a", "b"):
            lab = Lab()
            run(lab, Box(lab), tmp_path / name)
        assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()

    def test_configure_only_if_it_differs(self, lab, path):
        box = Box(lab)
        run(lab, box, path, osr=2048)
        assert [c[0] for c in box.commands] == [48, 51, 49, 48, 50, 51]
        assert box.commands[2][2:] == [0, 2048]
        assert json.loads(open_session(path).metadata["box"]["ident"])["streams"][0]["osr"] == 2048

    def test_plan_rig_and_mounting_come_first(self, lab, path):
        poses = [{"pose": i, "shell": "s", "bar": "b", "chuck": "c", "sphere": "p", "q": [0.1, i]} for i in range(3)]
        run(lab, Box(lab), path, plan=poses, rig_toml=b"# rig\n", mounted={"bar": "b", "chuck": "c"})
        assert [json.loads(m.data) for m in topics(path)["/plan"]] == poses
        assert open_session(path).attachments == {"rig.toml": b"# rig\n"}
        assert events(path, "mounted") == [{"kind": "mounted", "bar": "b", "chuck": "c"}]

    def test_progress(self, lab, path):
        seen = []
        run(lab, Box(lab), path, progress=lambda s: seen.append((s.state, s.counters.samples, s.rtt_us, s.robot_ok)))
        assert len(seen) == pytest.approx(12, abs=2)
        assert seen[0] == ("identifying", 0, None, None)
        assert seen[-1][0] == "recording"
        assert seen[-1][1] > 2500

    def test_a_box_left_streaming_by_a_killed_recorder(self, lab, path):
        box = Box(lab)
        box.streaming = True
        box._block(box.boot_id, 0)
        for _ in range(2000):
            lab.step(HOST_0 + SECOND)
        run(lab, box, path)
        found = topics(path)
        assert [c[0] for c in box.commands] == [48, 51, 50, 51]
        assert found["/box/stream0"]  # what came before the ident gave the stream a name
        firsts = [cbor2.loads(m.data)[3] for m in found["/box/adc"]]
        assert firsts.count(0) == 1


class TestFaults:
    @pytest.mark.parametrize("change", [{"scale": "abc"}, {"scale": [1]}, {"calibration": {"poly": [[1, 0]] * 17}}])
    def test_a_faulty_calibration_is_said_at_once_and_nothing_is_refused(self, lab, path, change):
        box = Box(lab)
        box.lvdt = change
        seen = []
        summary = run(lab, box, path, osr=2048, progress=lambda status: seen.append(status.faults))
        (fault,) = summary.faults
        assert fault.startswith("channel 'c0' of stream adc: ")
        assert seen[1] == (fault,)
        assert events(path, "box-fault") == [{"kind": "box-fault", "text": fault}]
        assert len(topics(path)["/box/adc"]) == box.blocks > 100
        assert parse_ident_json(open_session(path).metadata["box"]["ident"]).faults == (fault,)

    def test_a_robot_that_does_not_count_its_readings(self, lab, path):
        """Recorded, and read back by sync: all readings, and losses that nobody knows."""
        robot = Robot(lab, 3.0, LinkClosed("done"), counts=False)
        summary = run(lab, Box(lab), path, None, robot=robot.link)
        reader = JointReader()
        for message in open_session(path).messages():
            reader.feed(message)
        joints = reader.finish()
        assert summary.counters.robot_lines == joints.readings == len(robot.sent) == 375
        assert (joints.lost, joints.malformed, joints.duplicated) == (None, 0, 0)
        assert joints.bins.n.sum() == 375

    def test_a_lost_frame_and_a_doubled_one(self, lab, path):
        box = Box(lab)
        box.mangle = lambda i, raw: b"" if i == 100 else raw * 2 if i == 150 else raw
        summary = run(lab, box, path)
        assert summary.counters.lost_frames == 1
        assert summary.counters.doubled_frames == 1
        assert summary.counters.restarts == 0
        assert received(path) == box.sent.replace(b"\0", b"")

    def test_a_flipped_bit_is_kept_as_console(self, lab, path):
        box = Box(lab)
        flipped = {}

        def flip(index, raw):
            if index == 120:
                flipped["raw"] = raw[:30] + bytes([raw[30] ^ 0x40 or 0x41]) + raw[31:]
                return flipped["raw"]
            return raw

        box.mangle = flip
        summary = run(lab, box, path)
        assert [m.data for m in topics(path)["/box/console"]] == [flipped["raw"].strip(b"\0")]
        assert summary.counters.lost_frames == 1

    def test_a_traceback_in_the_stream(self, lab, path):
        box = Box(lab)
        text = b'Traceback (most recent call last):\n  File "main.py", line 7\nMemoryError: \n'
        lab.at(HOST_0 + 2 * SECOND, lambda: box.send_raw(text))
        summary = run(lab, box, path)
        assert [m.data for m in topics(path)["/box/console"]] == [text]
        assert summary.counters.lost_frames == 0

    @pytest.mark.parametrize("speaks_again", [True, False])
    def test_a_traceback_bears_the_time_of_its_end(self, lab, path, speaks_again):
        """It may wait long for a delimiter: for the next boot, or for ever."""
        box = Box(lab)

        def crash():
            box.streaming = False
            box.send_raw(b"Traceback")
            box.mangle = lambda i, raw: b""

        lab.at(HOST_0 + SECOND, crash)
        if speaks_again:
            lab.at(HOST_0 + 3 * SECOND, lambda: setattr(box, "mangle", lambda i, raw: raw))
        run(lab, box, path, 5.0)
        (message,) = topics(path)["/box/console"]
        assert message == ("/box/console", HOST_0 + SECOND + LATENCY, b"Traceback")

    @settings(max_examples=15, deadline=None)
    @given(
        st.dictionaries(st.integers(1, 250), st.binary(max_size=300), max_size=20), st.randoms(use_true_random=False)
    )
    def test_whatever_comes_is_kept(self, tmp_path_factory, insertions, random):
        """Junk anywhere, in the middle of frames too, in pieces of any size: the file holds every byte."""
        lab = Lab()
        path = tmp_path_factory.mktemp("junk") / "s.mcap"
        box = Box(lab)

        def insert(index, raw):
            at = random.randrange(len(raw))
            return raw[:at] + insertions.get(index, b"") + raw[at:]

        box.mangle = insert
        run(lab, box, path, 2.0)
        assert received(path) == box.sent.replace(b"\0", b"")

    def test_a_late_frame_is_no_restart(self, lab, path):
        box = Box(lab)
        held = []

        def hold(index, raw):
            if index == 100:
                held.append(raw)
                return b""
            return raw + held.pop() if index == 105 else raw

        box.mangle = hold
        summary = run(lab, box, path)
        assert summary.counters.restarts == 0
        assert [c[0] for c in box.commands] == [48, 51, 50, 48, 51]  # asked once who it is
        assert len(topics(path)["/box/adc"]) == box.blocks

    def test_a_restart_in_the_middle(self, lab, path):
        box = Box(lab)

        def reset():
            box.boot(0x2222)
            box.send_ident(0)

        lab.at(HOST_0 + 2 * SECOND, reset)
        summary = run(lab, box, path, 4.0, osr=2048)
        assert summary.counters.restarts == 1
        assert summary.counters.lost_frames == 0
        assert events(path) == ["start", "box-restarted", "start", "stop"]
        assert events(path, "box-restarted")[0]["boot_id"] == 0x2222
        assert [c[0] for c in box.commands if c[0] != 48] == [51, 49, 50, 51, 49, 50, 51]
        firsts = [cbor2.loads(m.data)[3] for m in topics(path)["/box/adc"]]
        assert firsts.count(0) == 2
        assert json.loads(open_session(path).metadata["box"]["ident"])["boot_id"] == 0x2222

    def test_a_restart_whose_ident_was_lost(self, lab, path):
        box = Box(lab)
        lab.at(HOST_0 + 2 * SECOND, lambda: box.boot(0x2222))  # says nothing; its heartbeat gives it away
        summary = run(lab, box, path, 4.0)
        assert summary.counters.restarts == 1
        assert events(path) == ["start", "box-restarted", "start", "stop"]

    def test_a_restart_that_only_the_heartbeat_tells(self, lab, path):
        box = Box(lab)
        lab.at(HOST_0 + 2 * SECOND, lambda: box.boot(0x2222, seq=box.seq))
        assert run(lab, box, path, 4.0).counters.restarts == 1

    def test_frames_counted_anew_without_a_restart(self, lab, path):
        """Not of this protocol, but it must neither be taken for a restart nor be asked about for ever."""
        box = Box(lab)
        lab.at(HOST_0 + 2 * SECOND, lambda: setattr(box, "seq", 0))
        summary = run(lab, box, path, 4.0)
        assert summary.counters.restarts == 0
        assert [c[0] for c in box.commands] == [48, 51, 50, 48, 51]

    def test_lost_answers_are_asked_for_again_and_nothing_is_done_twice(self, lab, path):
        box = Box(lab)
        box.deaf_to = 3
        run(lab, box, path)
        assert [c[0] for c in box.commands] == [48, 51, 50, 51]

    def test_unanswered_probes(self, lab, path):
        box = Box(lab)
        box.answer_probes = False
        summary = run(lab, box, path, 5.0)
        rows = [json.loads(m.data) for m in topics(path)["/sync"]]
        assert summary.counters.unanswered_probes == summary.counters.probes == len(rows)
        assert summary.rtt_us is None
        assert all((row["t1_us"], row["t2_us"], row["t3_ns"]) == (None, None, None) for row in rows)
        first = topics(path)["/sync"][0]
        assert 2 * SECOND <= first.t_host_ns - rows[0]["t0_ns"] <= 2 * SECOND + 50 * MS

    def test_silence_is_noted(self, lab, path):
        box = Box(lab)
        lab.at(HOST_0 + SECOND, lambda: setattr(box, "mangle", lambda i, raw: b""))
        lab.at(HOST_0 + 6 * SECOND, lambda: setattr(box, "mangle", lambda i, raw: raw))
        run(lab, box, path, 8.0)
        assert events(path) == ["start", "box-silent", "box-heard", "stop"]

    def test_frames_of_unknown_kinds(self, lab, path):
        box = Box(lab)
        lab.at(HOST_0 + SECOND, lambda: box.send(lambda seq: array(99, u32(seq), "new")))
        lab.at(HOST_0 + SECOND, lambda: box.send(lambda seq: array(17, u32(seq), 0, 5, 1)))
        lab.at(HOST_0 + SECOND, lambda: box.send(lambda seq: array(16, u32(seq), "odd")))
        lab.at(HOST_0 + SECOND, lambda: box.send(lambda seq: array(18, u32(seq), "odd")))
        lab.at(HOST_0 + SECOND, lambda: box.send(lambda seq: array(33, u32(seq), 1, -1, b"\xf5")))
        summary = run(lab, box, path)
        found = topics(path)
        assert len(found["/box/other"]) == 2
        assert len(found["/box/event"]) == 1
        assert summary.counters.lost_frames == 0
        assert received(path) == box.sent.replace(b"\0", b"")


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
        with pytest.raises(ProtocolError, match=r"refuses 'configure' \[0, 128\]: out of range"):
            run(lab, box, path, osr=128)

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
            intake = Intake(writer, Counters(), Probes(writer), awaited=5)
            for kind in (64, 65, 19):
                more = [3, "refused"] if kind == 65 else [0, 1, cbor2.dumps(cbor2.dumps(short))]
                intake.take(HOST_0, frame(array(kind, u32(1), 4, *more)))
                assert intake.answer is None
                intake.take(HOST_0, frame(array(kind, u32(1), 5, *more)))
                assert intake.answer == Answer("refused (error 3)" if kind == 65 else None)
                intake.answer = None


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
            summary = run(lab, box, tmp_path / reason, None, **{reason: lambda lab=lab: lab.now > HOST_0 + SECOND})
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


class ComingBack(Wire):
    """A link whose plug comes back by itself; what arrived meanwhile is gone."""

    def reopen(self, timeout_s):
        deadline = self.lab.now + int(timeout_s * 1e9)
        while self.error is not None and self.lab.now < deadline:
            self.lab.step(deadline)
        self.arrived = []
        return self.error is None


GOOD = b'{"t": 1.5, "seq": 3, "q": [0.1, -2]}'


class TestJointLines:
    @pytest.mark.parametrize(
        "line",
        [
            b"hello",
            b"\xff\xfe",
            b"[1, 2]",
            b'{"t": 1}',
            b'{"t": "1", "q": [1, 2]}',
            b'{"t": true, "q": [1, 2]}',
            b'{"t": NaN, "q": [1, 2]}',
            b'{"t": 1e999, "q": [1, 2]}',
            b'{"t": 1, "q": [1, Infinity]}',
            b'{"t": 1, "q": [1, null]}',
            b'{"t": 1, "q": []}',
            b'{"t": 1, "q": 1}',
            b'{"t": 1, "q": [1, 2], "seq": "x"}',
            b'{"t": 1, "q": [1, 2, 3]}',
            b'{"t": 1, "q": [' + b"1," * 32 + b"1]}",
            b'{"t": ' + b"9" * 400 + b', "q": [1, 2]}',
            b'{"t": ' + b"9" * 5000 + b', "q": [1, 2]}',
            b"[" * 8000,
            b'{"q":' * 1500,
        ],
        ids=lambda line: line[:40].decode("latin-1"),
    )
    def test_what_is_none(self, line):
        lines = JointLines()
        assert lines.push(GOOD + b"\n" + line + b"\n" + GOOD + b"\n") == [(True, GOOD), (False, line), (True, GOOD)]

    def test_commanded_joints_and_carriage_returns(self):
        line = b'{"t": 2, "q": [0.1, 0.2], "q_cmd": [0.1, 0.3], "more": {"x": 1}}\r'
        assert JointLines().push(line + b"\n") == [(True, line)]

    def test_a_line_without_end(self):
        lines = JointLines()
        pieces = [item for _ in range(100) for item in lines.push(b"x" * 1000)]
        assert all(not is_joints and len(piece) <= MAX_LINE for is_joints, piece in pieces)
        assert sum(len(piece) for _, piece in pieces) + len(lines.flush()) == 100_000
