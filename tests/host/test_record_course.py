"""The recorder with box and robot in memory, in virtual time: what happens, what the file says of it, and how it ends."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import pytest
from record_box import HOST_0, SECOND, Box, ComingBack, Lab, Robot, Wire, heartbeat
from record_files import events, received, run, topics

from truearm.errors import LinkClosed, LinkError, ProtocolError, RefusedError
from truearm.record.recorder import RecordOptions, record
from truearm.record.session_writer import SessionWriter
from truearm.session.session_file import open_session

UNPLUGGED, CLOSED = LinkError("unplugged"), LinkClosed("closed")


@dataclass
class Course:
    """What happens, by the second; which events the file has between start and stop; reason and duration.

    ``robot``: arguments of ``Robot``, None without one. ``counters``: of the summary. ``commands``: those of the box.
    """

    happens: dict[float, Callable[[Box, Robot], Any]]
    events: list[str]
    reason: str = "duration"
    duration_s: float | None = None
    seconds: float | None = None
    robot: dict[str, Any] | None = None
    box: type[Wire] = ComingBack
    counters: dict[str, int] = field(default_factory=dict)
    commands: list[int] | None = None


def of_box(name, value):
    return lambda box, robot: setattr(box, name, value)


def of_box_link(error):
    return lambda box, robot: setattr(box.link, "error", error)


def of_robot_link(error):
    return lambda box, robot: setattr(robot.link, "error", error)


def strike(box, robot):
    raise KeyboardInterrupt


def mute(box, robot):
    robot.deliver, robot.link.deliver = robot.link.deliver, lambda data: None


def reset(box, robot):
    box.boot(0x2222)
    box.send_ident(0)


def losing(kind, n):
    """What resets a box that then misses ``n`` commands of a kind."""

    def action(box, robot):
        left, obey = [n], box._obey

        def obey_most(command):
            if command[0] == kind and left[0]:
                left[0] -= 1
            else:
                obey(command)

        reset(box, robot)
        box._obey = obey_most

    return action


def words(box, robot):
    for line in (b'{"end": false}', b'{"end": true, "q": 1}', b'["end"]', b'{"end": ' + b"[" * 5000, b"hello\r"):
        robot.link.deliver(line + b"\n")


STAYING, COMING_BACK = {"seconds": 20.0, "link": ComingBack}, {"seconds": 6.0, "link": ComingBack}
ASKED = [48, 51, 50, 48, 51]  # once more for its ident, after the start
COURSES = {
    "the robot closes": Course({}, ["robot-closed"], "robot closed", 2.0, robot={"seconds": 2.0, "end": CLOSED}),
    "the robot is lost": Course({}, ["robot-lost"], "robot lost", 2.0, robot={"seconds": 2.0, "end": UNPLUGGED}),
    "the robot says that it has ended": Course(
        {1.0: words}, ["robot-closed"], "robot closed", 2.0, robot={"seconds": 2.0, "link": ComingBack}
    ),
    "the robot is away for two seconds": Course(
        {2.0: of_robot_link(UNPLUGGED), 4.0: of_robot_link(None)},
        ["robot-lost", "robot-back", "robot-closed"],
        *("robot closed", 6.0),
        robot=COMING_BACK,
        counters={"robot_losses": 1},
    ),
    "the robot closes and comes back": Course(
        {2.0: of_robot_link(CLOSED), 4.0: of_robot_link(None)},
        ["robot-closed", "robot-back", "robot-closed"],
        *("robot closed", 6.0),
        robot=COMING_BACK,
        counters={"robot_losses": 0},
    ),
    "the robot closes for good": Course(
        {}, ["robot-closed"], "robot closed", 7.0, robot={"seconds": 2.0, "end": CLOSED, "link": ComingBack}
    ),
    "a link without readings is not the robot": Course(
        {2.0: lambda *both: (mute(*both), of_robot_link(UNPLUGGED)(*both)), 3.0: of_robot_link(None)},
        ["robot-lost"],
        *("robot lost", 7.0),
        robot=STAYING,
    ),
    "the robot speaks another protocol": Course(
        {1.0: of_robot_link(ProtocolError("is not RTDE"))}, ["robot-lost"], "robot lost", 1.0, robot=STAYING
    ),
    "the robot is silent": Course(
        {1.0: mute, 6.0: lambda box, robot: setattr(robot.link, "deliver", robot.deliver)},
        ["robot-silent", "robot-heard"],
        seconds=8.0,
        robot=STAYING,
    ),
    "a key in a read": Course({2.0: strike}, [], "interrupted", 2.0),
    "a link that cannot come back": Course({2.0: of_box_link(UNPLUGGED)}, ["link-lost"], "link lost", 2.0, box=Wire),
    "a link that does not come back": Course({2.0: of_box_link(UNPLUGGED)}, ["link-lost"], "link lost", 7.0),
    "a key while the link is away": Course(
        {2.0: of_box_link(UNPLUGGED), 3.0: strike}, ["link-lost"], "interrupted", 3.0
    ),
    "a link that comes back": Course(
        {2.0: of_box_link(UNPLUGGED), 4.0: of_box_link(None)}, ["link-lost", "link-back"], seconds=6.0, commands=ASKED
    ),
    "a box that comes back after a boot": Course(
        {2.0: of_box_link(UNPLUGGED), 4.0: lambda box, robot: (setattr(box.link, "error", None), box.boot(0x3333))},
        ["link-lost", "link-back", "box-restarted", "start"],
        seconds=6.0,
        counters={"lost_frames": 0, "link_losses": 1},
    ),
    "the box restarts": Course(
        {2.0: reset}, ["box-restarted", "start"], seconds=4.0, counters={"restarts": 1, "lost_frames": 0}
    ),
    "a restart that only the heartbeat tells": Course(
        {2.0: lambda box, robot: box.boot(0x2222, seq=box.seq)}, ["box-restarted", "start"], seconds=4.0
    ),
    "a box that somebody stopped": Course(  # a single late heartbeat says nothing
        {
            2.0: lambda box, robot: box.send(lambda seq: heartbeat(seq, box.boot_id, box.t_us(), 0)),
            4.0: of_box("streaming", False),
        },
        ["box-stopped", "start"],
        seconds=9.0,
        counters={"restarts": 0},
    ),
    "a box that somebody stopped while the link was away": Course(
        {
            2.0: of_box_link(UNPLUGGED),
            3.0: of_box("streaming", False),
            4.0: of_box_link(None),
        },
        ["link-lost", "link-back", "box-stopped", "start"],
        seconds=9.0,
        counters={"restarts": 0},
    ),
    "a box that boots and does not hear STOP": Course(
        {2.0: losing(51, 14)}, ["box-restarted", "link-lost", "link-back", "start"], seconds=15.0
    ),
    "a box that boots and does not hear START": Course(
        {2.0: losing(50, 14)}, ["box-restarted", "link-lost", "link-back", "start"], seconds=15.0
    ),
    "frames counted anew without a restart": Course(
        {2.0: of_box("seq", 0)}, [], seconds=4.0, counters={"restarts": 0}, commands=ASKED
    ),
    "the box is silent": Course(
        {1.0: of_box("mangle", lambda i, raw: b""), 6.0: of_box("mangle", lambda i, raw: raw)},
        ["box-silent", "box-heard"],
        seconds=8.0,
    ),
    "answers are lost": Course({0.0: of_box("deaf_to", 3)}, [], seconds=3.0, commands=[48, 51, 50, 51]),
}


@pytest.mark.parametrize("course", COURSES.values(), ids=COURSES)
def test_what_happens_is_in_the_file(lab, path, course):
    box = Box(lab, course.box)
    robot = None if course.robot is None else Robot(lab, **course.robot)
    for at_s, action in course.happens.items():
        lab.at(HOST_0 + int(at_s * SECOND), lambda action=action: action(box, robot))
    link = None if robot is None else robot.link
    summary = run(lab, box, path, course.seconds, robot=link, options=RecordOptions(patience_s=5.0))
    assert (summary.reason, events(path)) == (course.reason, ["start", *course.events, "stop"])
    assert summary.duration_s == pytest.approx(course.duration_s or course.seconds, abs=0.1)
    assert {name: getattr(summary.counters, name) for name in course.counters} == course.counters
    assert course.commands in (None, [command[0] for command in box.commands])
    assert not open_session(path).truncated
    if course.duration_s is None:  # the box is heard to the end
        assert topics(path)["/box/adc"][-1].t_host_ns > HOST_0 + int((course.seconds - 0.5) * SECOND)
        assert not box.streaming
    if not any("link" in event for event in events(path)):
        assert received(path) == box.sent.replace(b"\0", b"")
    if robot is not None:
        stored = [message.data for message in topics(path)["/robot/joints"]]
        assert stored == [line for line in robot.sent if line in set(stored)]
        assert summary.counters.robot_lines == len(stored)


def test_whoever_may_interrupt_it_is_asked(lab, path):
    box = Box(lab)
    summary = run(lab, box, path, None, interrupted=lambda: lab.now > HOST_0 + SECOND)
    assert (summary.reason, events(path), box.streaming) == ("interrupted", ["start", "stop"], False)


class TestProtocol:
    @pytest.mark.parametrize("said", [b"", b"NO CARRIER\r\n"])
    def test_no_box(self, lab, path, said):
        link = Wire(lab, "a modem")
        lab.at(HOST_0 + SECOND, lambda: link.deliver(said))
        with SessionWriter(path, lab) as writer, pytest.raises(LinkError, match="no answer to 'identify'"):
            record(link, writer, lab)
        assert open_session(path).metadata["session-end"]["reason"] == "failed"
        assert [m.data for m in topics(path).get("/box/console", [])] == [said] * bool(said)

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
        with pytest.raises(RefusedError, match="refuses 'configure 0 128': out"):
            run(lab, box, path, options=RecordOptions(osr=128))

    def test_ids_differ_from_those_of_an_earlier_session(self, tmp_path):
        lab = Lab()
        box = Box(lab)
        run(lab, box, tmp_path / "a", 0.5)
        run(lab, box, tmp_path / "b", 0.5)
        assert len({c[1] for c in box.commands}) == len(box.commands)

    def test_another_box_is_refused(self, lab, path):
        box = Box(lab, ComingBack)

        def exchange():
            box.uid, box.link.error = b"\x09\x09", None
            box.boot(0x3333)

        lab.at(HOST_0 + 2 * SECOND, lambda: setattr(box.link, "error", UNPLUGGED))
        lab.at(HOST_0 + 3 * SECOND, exchange)
        with pytest.raises(ProtocolError, match=r"another box answers \(0909.*01020304\)"):
            run(lab, box, path, 6.0)
        assert open_session(path).metadata["session-end"]["reason"] == "failed"
