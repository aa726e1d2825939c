"""What the operator is shown and may say: dwells and lines as they are taken, pairings, the LVDT in its travel."""

import json
import re
from datetime import date

import cbor2
import numpy as np
import pytest
from record_box import ident

from truearm.commands.box_check import Purpose, Verdict, check_box
from truearm.commands.course import Course
from truearm.commands.keys import LONGEST, Typed
from truearm.commands.live_state import LiveState
from truearm.commands.live_view import WAITING, View
from truearm.errors import InputError
from truearm.record.status import Counters, Status
from truearm.sensors.data import Data
from truearm.sensors.ident import decode_ident
from truearm.types import BallBar, Rig

S = 1_000_000_000
BLOCK_NS = 12_779_520
NOISE = 2e-6  # m
MM = 1e-6  # m a count in the box below: scale 1e-3 of a volt, 1e-3 m a volt
TODAY = date(2026, 11, 22)

RIG = Rig(
    bars={
        "b46": BallBar("b46", zero=0.46, gain=1.0, travel=0.075, sigma=8.4e-5),
        "b61": BallBar("b61", zero=0.61, gain=1.0, travel=0.075, sigma=8.4e-5),
    },
    chucks={"c1": None, "c2": None},
    spheres={"s1": None},
)


def box(**lvdt):
    said = ident(1)
    channel = {
        "name": "lvdt",
        "calibration": {"unit": "m", "poly": [[0, 0], [1, -3]], "serial": "7", "date": "2026-05-01"},
    }
    said["streams"][0]["channels"][0].update({"scale": [1, -3]} | channel | lvdt)
    return decode_ident(cbor2.dumps(said))


def plan(*pairings, joints=2):
    """A row a pairing (bar, chuck), at joints 0.5 rad apart."""
    return [
        {"pose": k, "shell": "", "bar": bar, "chuck": chuck, "sphere": "s1", "q": [0.5 * k] * joints}
        for k, (bar, chuck) in enumerate(pairings)
    ]


class Session:
    """Feeds a state: the bar at ``position`` [m], the robot at ``q``, second by second."""

    def __init__(self, rows=(), mounted=None, robot=True, rig=RIG):
        self.state = LiveState(Course(list(rows), dict(mounted or {})), rig, robot)
        self.state.ident(box())
        self.t = 1000 * S
        self.robot = robot
        self.n0 = 0
        self.rng = np.random.default_rng(3)
        self.said = []
        self.position, self.q = 0.0, np.zeros(2)

    def run(self, seconds, speed=0.0, q_speed=0.0):
        """``speed`` [m/s] of the bar, ``q_speed`` [rad/s] of every joint."""
        for _ in range(round(seconds * S / BLOCK_NS)):
            within = np.arange(13) * BLOCK_NS * 1e-9 / 13
            extension = self.position + speed * within + NOISE * self.rng.standard_normal(13)
            counts = np.zeros((13, 4), "<i4")
            counts[:, 0] = np.rint(extension / MM)
            data = Data(0, 0, self.n0, 0, BLOCK_NS // 13, b"", counts.tobytes(), 0)
            self.n0 += 13
            self.t += BLOCK_NS
            self.position += speed * BLOCK_NS * 1e-9
            self.q = self.q + q_speed * BLOCK_NS * 1e-9
            self.state.block(self.t, data)
            if self.robot:
                q = self.q + 1e-5 * self.rng.standard_normal(self.q.size)
                self.state.reading(self.t, json.dumps({"t": 1e-9 * self.t, "q": q.tolist()}).encode())
            self.state.now(self.t)
        self.said += self.state.said
        self.state.said.clear()

    def dwell(self, seconds=2.5):
        """A move of half a second to the next pose, half a radian and 5 mm away, and a stop."""
        self.run(0.5, speed=0.01, q_speed=1.0)
        self.run(seconds)

    def events(self, kind):
        return [wish.fields for wish in self.state.wishes if wish.kind == kind]

    def status(self, **more):
        return Status(
            12.0,
            "recording",
            312.0,
            True if self.robot else None,
            Counters(),
            robot_age_s=0.02,
            t_host_ns=self.t,
            **more,
        )

    def row(self, name):
        return next(row for row in self.state.rows(self.status(), None) if row.name == name)


PAIRS = [("b46", "c1"), ("b46", "c1"), ("b61", "c1"), ("b61", "c2")]


class TestDwells:
    @pytest.mark.parametrize("robot", [True, False], ids=["robot", "pendant"])
    def test_counted_while_they_last_and_described_when_they_end(self, robot):
        session = Session(robot=robot)
        places = []
        for _ in range(3):
            session.dwell()
            places.append(session.position)
        assert session.state.course.taken == 3
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

    def test_too_short_is_none(self):
        session = Session()
        for _ in range(3):
            session.dwell(1.0)
        assert session.state.course.taken == 0
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
        assert session.state.course.taken == 0

    def test_a_gap_ends_it(self):
        session = Session()
        session.dwell(2.0)
        session.t += 5 * S
        session.run(0.2)
        (event,) = session.events("dwell")
        assert event["end_ns"] < session.t - 5 * S

    def test_the_one_under_way_at_the_end_is_kept(self):
        session = Session()
        session.dwell(2.0)
        session.state.close(session.t)
        assert len(session.events("dwell")) == 1


class TestThePlan:
    def test_poses_are_matched_and_counted_once(self):
        session = Session(plan(*PAIRS))
        session.run(2.5)
        session.dwell()
        session.run(0.5, q_speed=-1.0)  # back to the first
        session.run(2.5)
        assert session.state.course.done == {0, 1}
        assert session.row("dwells").text.startswith("2 of 4, standing")

    def test_what_is_not_in_the_plan(self):
        session = Session(plan(*PAIRS))
        session.q = np.array([3.0, -3.0])
        session.run(2.5)
        session.run(0.5, q_speed=1.0)
        assert (session.state.course.taken, session.state.course.unplanned) == (0, 1)
        assert "a stop beside the plan" in session.said[-1]
        assert "pose" not in session.events("dwell")[0]

    def test_a_pairing_is_asked_for_and_confirmed(self):
        session = Session(plan(*PAIRS))
        assert session.state.course.mounted == {"bar": "b46", "chuck": "c1", "sphere": "s1"}
        session.run(2.5)
        assert session.row("mounted").text == "bar b46, chuck c1, sphere s1"
        session.dwell()
        assert session.said[-1] == "now mount bar b61, chuck c1, sphere s1; then press Enter"
        assert session.row("change").alarm
        session.state.command("")
        assert session.events("mounted") == [{"bar": "b61", "chuck": "c1", "sphere": "s1"}]
        assert "change" not in [row.name for row in session.state.rows(session.status(), None)]

    def test_gone_on_without_a_confirmation(self):
        session = Session(plan(*PAIRS))
        session.run(2.5)
        for _ in range(2):
            session.dwell()
        (warning,) = (text for text in session.said if text.startswith("warning"))
        assert warning == "warning: pose 2 is planned with bar b61; mounted is bar b46, chuck c1, sphere s1"

    def test_without_a_robot_they_come_in_order(self):
        session = Session(plan(*PAIRS), robot=False)
        session.run(2.5)
        session.dwell()
        assert session.state.course.done == {0, 1}
        assert session.state.course.change() == {"bar": "b61", "chuck": "c1", "sphere": "s1"}

    def test_lines_and_via_points(self):
        rows = plan(*PAIRS[:2])
        via = {"pose": 2, "move": "via", "q": [1.0, 1.0]}
        line = {"pose": 3, "move": "line", "line": "l1", "target": "t1", "speed_m_s": 0.1, "q": [2.0, 2.0]}
        course = Course([*rows, via, line])
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
                    state.reading(t, json.dumps({"t": 1e-9 * t, "q": q.tolist()}).encode())
                state.block(t, Data(0, 1, n0, 0, 983_040, b"", counts.tobytes(), 0))
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
        state = LiveState(Course(list(rows)), None, robot)
        state.ident(decode_ident(cbor2.dumps(said)))
        return state

    def test_there_and_back(self):
        """2 s at 0.1 m/s each way. The first and last block of a way are partly at rest: 5 mm at either end, 10 mm/s of speed."""
        state = self.state()
        found = self.drive(state, [(0, 1), (0.1, 2), (-0.1, 2), (0, 1), (0.002, 3), (0.05, 0.3)])
        assert len(found) == state.course.lines == 2
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
        assert (state.course.lines, state.course.change()) == (0, None)
        found = self.drive(state, [(0, 1), (0.1, 1), (0, 1)], q=np.array([1.0, 1.0]))
        assert [line.get("pose") for line in found] == [None, 1]
        assert (state.course.lines, state.course.planned_lines) == (1, 2)
        assert state.course.change() == {"line": "l2", "target": "t1"}
        assert state.progress(0) == ("lines", "1 of 2", False)
        status = Status(12.0, "recording", 312.0, True, Counters(), robot_age_s=0.02)
        assert re.match(r"line 4\d\d\.\d{4} mm; samples mag 1017\.3 Hz", state.line(status, None))
        assert "lvdt" not in [row.name for row in state.rows(status, None)]


class TestCommands:
    @pytest.mark.parametrize(
        ("typed", "mounted"),
        [
            ("bar=b61", {"bar": "b61", "chuck": "c1", "sphere": "s1"}),
            ("m chuck=c2", {"bar": "b46", "chuck": "c2", "sphere": "s1"}),
            ("line=l1,target=t1", {"line": "l1", "target": "t1"}),
            ("2", {"bar": "b61", "chuck": "c1", "sphere": "s1"}),
        ],
    )
    def test_what_is_mounted(self, typed, mounted):
        session = Session(plan(*PAIRS))
        session.state.command(typed)
        assert session.events("mounted") == [mounted]

    @pytest.mark.parametrize("typed", ["bar=b99", "arm=x", "9", "?", "", "note "])
    def test_what_is_none_changes_nothing_and_is_explained(self, typed):
        session = Session(plan(*PAIRS))
        session.state.command(typed)
        assert not session.state.wishes
        (said,) = session.state.said
        assert "b99" in said or "arm=x" in said or ("Enter" in said and "1 bar b46" in said)

    def test_notes_and_the_end(self):
        session = Session()
        session.state.command("note the door was open")
        session.state.command("q")
        assert [(w.kind, dict(w.fields)) for w in session.state.wishes] == [
            ("note", {"text": "the door was open"}),
            ("end", {}),
        ]

    def test_typing(self):
        typed = Typed()
        assert typed.push("bax\x7fr=1\x1b") == []
        assert typed.push("chuck=c\x012\n\nno") == ["chuck=c2", ""]
        assert typed.text == "no"
        typed.push("\x15" + "y" * 1000)
        assert typed.text == "y" * LONGEST


class TestTravel:
    def test_the_bar_is_drawn_and_warned_of_near_its_ends(self):
        session = Session(mounted={"bar": "b46"})
        session.run(0.5)
        assert re.fullmatch(r"├─{15}●─{15}┤ [+-]0.000\d mm of ±37.5 mm", session.row("lvdt").text)
        assert not session.row("lvdt").alarm
        session.run(3.1, speed=0.01)
        assert session.row("lvdt").alarm
        assert session.row("lvdt").text.endswith("near its end")
        assert [text[:24] for text in session.said] == ["warning: the LVDT is at "]
        session.run(0.8, speed=0.01)
        assert session.row("lvdt").text.endswith("BEYOND ITS TRAVEL")
        assert len(session.said) == 1  # once

    def test_the_rail(self):
        session = Session()
        counts = np.full((13, 4), 2**23 - 1, "<i4")
        session.state.block(session.t, Data(0, 0, 0, 0, 983_040, b"", counts.tobytes(), 0))
        assert "rail" in session.row("lvdt").text

    def test_on_one_line(self):
        session = Session(plan(*PAIRS))
        session.run(2.0)
        text = session.state.line(session.status(), None)
        assert text.startswith("lvdt ")
        assert "; samples adc 1017.3 Hz; 0 samples, 0 frames lost; clock round trip 312 µs at best; robot 78." in text
        assert re.search(r"last 0\.0 s ago; dwells 1 of 4, standing for (1\.9|2\.0) s, enough$", text)


class TestCheck:
    def test_a_good_box(self):
        assert check_box(box(), Purpose(ball_bar=True, osr=4096), TODAY) == Verdict()

    @pytest.mark.parametrize(
        ("lvdt", "says"),
        [
            ({"name": "lvtd"}, "has no channel lvdt (it has lvtd, c1, c2, c3)"),
            (
                {"calibration": {}},
                "channel lvdt is not calibrated to a length; calibrate it with truearm box gauge lvdt",
            ),
            ({"calibration": {"unit": "V", "poly": [[1, 0]]}}, "is not calibrated to a length"),
            ({"scale": [1]}, "channel lvdt cannot be used: scale must be"),
        ],
    )
    def test_refused_for_a_ball_bar(self, lvdt, says):
        verdict = check_box(box(**lvdt), Purpose(ball_bar=True), TODAY)
        assert says in verdict.refused[0]
        assert not check_box(box(**lvdt), Purpose(), TODAY).refused

    def test_warned(self):
        old = {"calibration": {"unit": "m", "poly": [[1, 0]], "date": "2024-11-22"}}
        verdict = check_box(box(**old), Purpose(ball_bar=True, osr=128), TODAY)
        assert verdict.warned == (
            "channel lvdt was calibrated 730 days ago, on 2024-11-22",
            "stream adc samples at osr 4096, not 128 as asked for",
        )
        soon = {"calibration": {"unit": "m", "poly": [[1, 0]], "date": "2030-01-01"}}
        assert "still to come" in check_box(box(**soon), Purpose(ball_bar=True), TODAY).warned[0]
        assert "no channel of the box" in check_box(box(calibration={}), Purpose(), TODAY).warned[0]

    def test_a_line_needs_its_sensors(self):
        refused = check_box(box(), Purpose(line=True), TODAY).refused
        assert ["magnetostrictive" in text for text in refused] == [True, False, False]
        assert "transverse_b" in refused[2]


class TestView:
    def test_a_box_that_is_refused(self):
        view = View(LiveState(Course(), None, False), Purpose(ball_bar=True))
        with pytest.raises(InputError, match=r"not calibrated to a length.* Nothing was started; --unchecked"):
            view.approve(box(calibration={}))
        all_the_same = View(LiveState(Course(), None, False), Purpose(ball_bar=True), unchecked=True)
        all_the_same.approve(box(calibration={}))
        assert "not calibrated" in all_the_same.take()[0][0]

    def test_a_view_that_stands_still_is_bounded(self):
        view = View(LiveState(Course(), None, False), Purpose())
        for _ in range(WAITING + 5):
            view.reading(1, b"")
        assert view.missed == 5
