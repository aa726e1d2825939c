"""Dwells and lines during a recording, and the plan to which they belong."""

import re

import cbor2
import numpy as np
import pytest
from record_box import ident
from record_live import NOISE, PAIRS, S, Session, plan

from truearm.live.session_progress import SessionProgress
from truearm.live.state import LiveState
from truearm.record.status import Counters, Status
from truearm.session.box_frames import Data
from truearm.session.box_ident import decode_ident
from truearm.session.joint_format import JointLine


class TestDwells:
    @pytest.mark.parametrize("robot", [True, False], ids=["robot", "pendant"])
    def test_counted_while_they_last_and_described_when_they_end(self, robot):
        session = Session(robot=robot)
        places = []
        for _ in range(3):
            session.dwell()
            places.append(session.position)
        assert session.state.session_progress.taken == 3
        assert session.row("dwells").text.startswith("3, standing for ")
        session.run(0.5, speed=0.01, q_speed=1.0)
        events = session.events("dwell")
        assert len(events) == 3
        for place, event in zip(places, events, strict=True):
            assert event["end_ns"] - event["begin_ns"] == pytest.approx(2.5 * S, abs=0.25 * S)
            # the mean of 1.9 s of samples: 2 µm / √1900 and the counts' rounding, well below 0.3 µm
            assert event["mean_m"] == pytest.approx(place, abs=3e-7)
            assert event["noise_m"] == pytest.approx(NOISE, rel=0.1)
            assert event["settled"]
        assert "dwell 3: " in session.said[-1]
        assert session.said[-1].endswith("settled")

    @pytest.mark.parametrize("robot", [True, False], ids=["robot", "pendant"])
    def test_a_busy_machine_changes_nothing(self, robot):
        """All arrives in bursts, every 0.6 s, and nobody looks in between: what stood still did so by its own clock."""
        session = Session(robot=robot)
        session.burst, session.looks = 6 * S // 10, False
        for _ in range(4):
            session.dwell(2.0)
        session.run(0.5, speed=0.01, q_speed=1.0)
        assert session.state.session_progress.taken == 4
        for event in session.events("dwell"):
            assert event["end_ns"] - event["begin_ns"] == pytest.approx(2.0 * S, abs=0.25 * S)

    def test_a_pose_is_known_after_the_robot_has_left_it(self):
        session = Session(plan(*PAIRS))
        session.looks = False
        session.run(2.0)
        session.dwell(2.0)
        session.run(0.5, q_speed=2.0)
        assert session.state.session_progress.done == {0, 1}
        assert any(line.startswith("pose 1: ") for line in session.said)  # other commands number the dwells otherwise

    def test_too_short_is_none(self):
        session = Session()
        for _ in range(3):
            session.dwell(1.0)
        assert session.state.session_progress.taken == 0
        assert session.events("dwell") == []

    def test_a_creep_of_the_sensor_is_not_settled(self):
        """The joints stand, the bar goes on by 2 µm a second: 4 µm in the dwell, where noise allows a fraction of one."""
        session = Session()
        session.run(0.5, q_speed=1.0)
        session.run(2.5, speed=2e-6)
        session.run(0.5, q_speed=1.0)
        assert [event["settled"] for event in session.events("dwell")] == [False]
        assert session.said[-1].endswith("NOT settled")

    def test_a_bar_beyond_its_travel_is_no_dwell_for_the_sensor_alone(self):
        session = Session(mounted={"bar": "b46"}, robot=False)
        session.position = 0.045
        session.dwell()
        assert session.state.session_progress.taken == 0

    def test_a_gap_ends_it(self):
        session = Session()
        session.dwell(2.0)
        session.t += 5 * S
        session.run(0.2)
        (event,) = session.events("dwell")
        assert event["end_ns"] < session.t - 5 * S

    def test_a_robot_that_says_nothing_is_not_known_to_stand(self):
        """Its readings ended one second after it stopped: the bar goes on to be read, and the pose is not taken."""
        session = Session(plan(*PAIRS))
        session.run(1.0)
        session.robot = False
        session.run(6.0)
        assert session.state.session_progress.taken == 0
        late = session.status(robot_age_s=6.0)
        assert session.state.progress(late).text == "0 of 4"
        session.state.close()
        assert not session.events("dwell")

    def test_one_that_was_long_enough_ends_with_its_last_reading(self):
        session = Session()
        session.run(2.5)
        said_ns, session.robot = session.t, False
        session.run(6.0)
        session.state.close()
        (event,) = session.events("dwell")
        assert event["end_ns"] <= said_ns

    def test_a_box_that_says_nothing_tells_no_dwell(self):
        session = Session(mounted={"bar": "b46"}, robot=False)
        session.run(1.0)
        for _ in range(10):
            session.t += S
            session.state.look()
        assert session.state.session_progress.taken == 0
        assert "standing" not in session.state.progress(session.status(box_ok=False)).text

    def test_the_one_under_way_at_the_end_is_kept(self):
        session = Session()
        session.dwell(2.0)
        session.state.close()
        assert len(session.events("dwell")) == 1


class TestThePlan:
    def test_poses_are_matched_and_counted_once(self):
        session = Session(plan(*PAIRS))
        session.run(2.5)
        session.dwell()
        session.run(0.5, q_speed=-1.0)  # back to the first
        session.run(2.5)
        assert session.state.session_progress.done == {0, 1}
        assert session.row("dwells").text.startswith("2 of 4, standing")

    def test_that_all_of_it_is_taken_is_said_once_while_the_robot_stands(self):
        session = Session(plan(*PAIRS[:2]))
        session.run(2.5)
        said = "the plan is complete; type q and Enter to end the recording"
        assert said not in session.said
        session.dwell()
        assert session.said[-1] == said
        session.dwell()
        assert session.said.count(said) == 1

    def test_what_is_not_in_the_plan(self):
        session = Session(plan(*PAIRS))
        session.q = np.array([3.0, -3.0])
        session.run(2.5)
        session.run(0.5, q_speed=1.0)
        assert (session.state.session_progress.taken, session.state.session_progress.unplanned) == (0, 1)
        assert "stop not in the plan" in session.said[-1]
        assert "pose" not in session.events("dwell")[0]

    def test_a_pairing_is_asked_for_and_confirmed(self):
        session = Session(plan(*PAIRS))
        assert session.state.session_progress.mounted == {"bar": "b46", "chuck": "c1", "sphere": "s1"}
        session.run(2.5)
        assert session.row("mounted").text == "bar b46, chuck c1, sphere s1"
        session.dwell()
        assert session.said[-1] == "at the next pose, mount bar b61, chuck c1, sphere s1; then press Enter"
        assert session.row("change").alarm
        session.state.command("")
        assert session.events("mounted") == [{"bar": "b61", "chuck": "c1", "sphere": "s1"}]
        assert "change" not in [row.name for row in session.state.rows(session.status(), None)]

    def test_gone_on_without_a_confirmation(self):
        session = Session(plan(*PAIRS))
        session.state.command("1")
        session.run(2.5)
        for _ in range(2):
            session.dwell()
        (warning,) = (text for text in session.said if text.startswith("contradiction"))
        assert warning == "contradiction: pose 2 needs bar b61, but bar b46, chuck c1, sphere s1 was confirmed"

    def test_where_nobody_confirms_anything_nothing_is_contradicted(self):
        """The plan alone says what is mounted, and ``identify`` takes it; the view goes on asking."""
        session = Session(plan(*PAIRS))
        session.run(2.5)
        for _ in range(2):
            session.dwell()
        assert session.state.contradictions == 0
        assert not [text for text in session.said if text.startswith("contradiction")]
        assert session.row("change").alarm

    def test_without_a_robot_they_come_in_order(self):
        session = Session(plan(*PAIRS), robot=False)
        session.run(2.5)
        session.dwell()
        assert session.state.session_progress.done == {0, 1}
        assert session.state.session_progress.change() == {"bar": "b61", "chuck": "c1", "sphere": "s1"}

    def test_lines_and_via_points(self):
        rows = plan(*PAIRS[:2])
        via = {"pose": 2, "move": "via", "q": [1.0, 1.0]}
        line = {"pose": 3, "move": "line", "line": "l1", "target": "t1", "speed_m_s": 0.1, "q": [2.0, 2.0]}
        course = SessionProgress([*rows, via, line])
        assert (course.planned, course.planned_lines) == (2, 1)
        course.visit(np.array([0.0, 0.0]))
        course.visit(np.array([0.5, 0.5]))
        assert course.change() == {"line": "l1", "target": "t1"}
        course.mount(course.change())
        assert course.mounted == {"line": "l1", "target": "t1"}
        assert course.pairings() == [{"bar": "b46", "chuck": "c1", "sphere": "s1"}, {"line": "l1", "target": "t1"}]


class TestLines:
    """By the longitudinal sensor: 52 readings a block of 51 ms, in ticks of 8 ns; 1 m of rod is 356 µs or 44,500 ticks."""

    PER_TICK = 2806.6 * 8e-9

    def drive(self, state, ways, q=None):
        """Stretches (m/s, s) one after the other."""
        position, t, n0 = 0.3, 1000 * S, 0
        for speed, seconds in ways:
            for _ in range(round(seconds * 1e9 / (52 * 983_040))):
                within = position + speed * np.arange(52) * 983_040e-9
                counts = np.rint(within / self.PER_TICK).astype("<i4")
                if q is not None:
                    state.reading(t, JointLine(t=1e-9 * t, q=q.tolist()))
                state.block(t, Data(0, 1, n0, t // 1000, 983_040, b"", counts.tobytes(), 0))
                position += speed * 52 * 983_040e-9
                t, n0 = t + 52 * 983_040, n0 + 52
        return [wish.fields for wish in state.wishes if wish.kind == "line"]

    def state(self, rows=(), robot=False):
        said = ident(1)
        poly = [[0, 0], [28066, -1]]
        channel = {
            "name": "magnetostrictive",
            "unit": "s",
            "scale": [8, -9],
            "calibration": {"unit": "m", "poly": poly},
        }
        said["streams"].append(
            {"id": 1, "name": "mag", "period_ns": 983_040, "osr": 0, "group_delay_ns": 0, "channels": [channel]}
        )
        state = LiveState(SessionProgress(list(rows)), None, robot)
        state.ident(decode_ident(cbor2.dumps(said)))
        return state

    def test_there_and_back(self):
        """2 s at 0.1 m/s each way. The first and last block of a way are partly at rest: 5 mm at either end, 10 mm/s of speed."""
        state = self.state()
        found = self.drive(state, [(0, 1), (0.1, 2), (-0.1, 2), (0, 1), (0.002, 3), (0.05, 0.3)])
        assert len(found) == state.session_progress.lines == 2
        for line in found:
            assert line["length_m"] == pytest.approx(0.2, abs=0.011)
            assert line["speed_m_s"] == pytest.approx(0.1, abs=0.011)

    def test_of_a_plan(self):
        rows = [
            {"pose": 0, "move": "via", "q": [0.0, 0.0]},
            {"pose": 1, "move": "line", "line": "l1", "target": "t1", "q": [1.0, 1.0]},
            {"pose": 2, "move": "line", "line": "l2", "target": "t1", "q": [0.0, 0.0]},
        ]
        state = self.state(rows, robot=True)
        self.drive(state, [(0, 1), (0.1, 1), (0, 1)], q=np.array([0.5, 0.5]))  # an approach
        assert (state.session_progress.lines, state.session_progress.change()) == (0, None)
        found = self.drive(state, [(0, 1), (0.1, 1), (0, 1)], q=np.array([1.0, 1.0]))
        assert [line.get("pose") for line in found] == [None, 1]
        assert (state.session_progress.lines, state.session_progress.planned_lines) == (1, 2)
        assert state.session_progress.change() == {"line": "l2", "target": "t1"}
        status = Status(12.0, "recording", 312.0, True, Counters(), robot_age_s=0.02)
        assert state.progress(status) == ("lines", "1 of 2", False)
        assert re.match(r"line 4\d\d\.\d{4} mm; samples mag 1017\.3 Hz", state.line(status, None))
        assert "lvdt" not in [row.name for row in state.rows(status, None)]
