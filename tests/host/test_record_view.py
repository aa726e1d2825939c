"""What the operator sees and types during a recording: pairings, the LVDT's travel, and whether the box can measure what is needed."""

import dataclasses

import numpy as np
import pytest
from record_live import PAIRS, TODAY, S, Session, box, plan

from truearm.box.condition import Purpose, check_box, far_from_calibration
from truearm.errors import InputError
from truearm.finding_texts import Severity
from truearm.findings import Finding, option
from truearm.live.state import LOSSES, LiveState, SessionProgress
from truearm.live.view import LONGEST, Typed
from truearm.record.operator import Counters
from truearm.session.joint_format import JointLine
from truearm.types import Rig


class TestCommands:
    @pytest.mark.parametrize(
        ("typed", "mounted"),
        [
            ("bar=b61", {"bar": "b61", "chuck": "c1", "sphere": "s1"}),
            ("line=l1,target=t1", {"line": "l1", "target": "t1"}),
        ],
    )
    def test_what_is_mounted(self, typed, mounted):
        session = Session(plan(*PAIRS))
        session.type(typed)
        assert session.events("mounted") == [mounted]

    @pytest.mark.parametrize("typed", ["bar=b99", "arm=x", "9", "?", "", "note "])
    def test_what_is_none_changes_nothing_and_is_explained(self, typed):
        session = Session(plan(*PAIRS))
        session.type(typed)
        assert not session.wishes
        (said,) = session.state.messages
        assert "b99" in said or "arm=x" in said or "Enter" in said

    def test_notes_and_the_end(self):
        session = Session()
        session.type("note the door was open")
        session.type("q")
        assert [(w.kind, dict(w.fields)) for w in session.wishes] == [
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

    @pytest.mark.parametrize("key", ["\x1b[A", "\x1b[1;5C", "\x1bOP", "\x1b[15~", "\x1b[3~"])
    @pytest.mark.parametrize("at_once", [True, False])
    def test_arrow_and_function_keys_leave_the_line_as_it_is(self, key, at_once):
        typed = Typed()
        lines = []
        for part in [f"no{key}te\n"] if at_once else f"no{key}te\n":
            lines += typed.push(part)
        assert (lines, typed.text) == (["note"], "")

    def test_escape_drops_the_line_at_once(self):
        typed = Typed()
        typed.push("chuck=c9\x1b")
        assert typed.text == ""
        assert typed.push("\x1bq\n") == ["q"]


class TestTravel:
    def test_the_bar_is_warned_of_near_its_ends(self):
        session = Session(mounted={"bar": "b46"})
        session.run(0.5)
        assert session.row("lvdt").text.endswith(", travel ±37.5 mm")
        assert not session.row("lvdt").alarms
        warnings = [Finding("near-travel-end"), Finding("beyond-travel")]
        for seconds, warning in zip((3.1, 0.8), warnings, strict=True):
            session.run(seconds, speed=0.01)
            assert session.row("lvdt").alarms == (warning,)
        messages = [text for text in session.said if text.startswith("lvdt")]
        assert [text.rpartition("; ")[2] for text in messages] == [warning.text() for warning in warnings]

    def test_the_transverse_sensors_of_a_line(self):
        """What the LVDT shows here is a transducer's; its range is the rig's."""
        session = Session(mounted={"line": "l1", "target": "t1"}, rig=Rig(line_travel=0.015))
        session.state.approve(box(name="transverse_a"))
        session.run(0.5)
        assert not session.row("transverse_a").alarms
        session.run(0.7, speed=0.01)  # to 7 mm of 7.5
        assert session.row("transverse_a").alarms
        assert session.row("transverse_a").text.endswith(", travel ±7.5 mm")

    def test_a_stream_that_has_run_dry(self):
        """The converter has died, the box's heartbeats go on."""
        session = Session()
        session.run(0.5)
        session.t += 3 * S
        row = session.row("adc")
        assert (row.text, row.alarms) == ("1017.3 Hz", (Finding("no-samples"),))
        session.run(0.1)
        session.run(0.1)
        assert not session.row("adc").alarms
        assert session.said == [f"adc: 1017.3 Hz; {Finding('no-samples').text()}", "adc: 1017.3 Hz"]


class TestCheck:
    def test_a_good_box(self):
        assert not [*check_box(box(), Purpose(ball_bar=True, osr=4096), TODAY)]

    @pytest.mark.parametrize(
        ("lvdt", "code"),
        [
            ({"name": "lvtd"}, "no-channel"),
            ({"calibration": {}}, "uncalibrated-channel"),
            ({"calibration": {"unit": "V", "poly": [[1, 0]]}}, "uncalibrated-channel"),
            ({"scale": [1]}, "unusable-channel"),
        ],
    )
    def test_refused_for_a_ball_bar(self, lvdt, code):
        (finding,) = check_box(box(**lvdt), Purpose(ball_bar=True, device="/dev/ttyACM1"), TODAY)
        assert (finding.code, finding.values["channel"]) == (code, "lvdt")
        assert "--box /dev/ttyACM1" in finding.text(option)
        assert finding.severity in (Severity.ERROR, Severity.REFUSAL)
        assert {other.severity for other in check_box(box(**lvdt), Purpose(), TODAY)} <= {Severity.WARNING}

    def test_what_is_warned_of(self):
        old = {"calibration": {"unit": "m", "poly": [[1, 0]], "date": "2024-11-22"}}
        warnings = check_box(box(**old), Purpose(ball_bar=True, osr=128), TODAY)
        (calibrated, rate) = (dict(warning.values, code=warning.code) for warning in warnings)
        assert (calibrated["code"], calibrated["days"], calibrated["date"]) == ("old-calibration", 730, "2024-11-22")
        assert rate == {"code": "other-rate", "stream": "adc", "osr": 4096, "requested": 128}
        soon = {"calibration": {"unit": "m", "poly": [[1, 0]], "date": "2030-01-01"}}
        assert codes(box(**soon), Purpose(ball_bar=True)) == ["future-calibration"]
        assert codes(box(calibration={}), Purpose()) == ["nothing-calibrated"]
        refused = [*check_box(box(), Purpose(line=True), TODAY)]
        assert {finding.code for finding in refused} == {"no-channel"}
        assert [finding.values["switch"] for finding in refused] == [True, False, False]
        assert refused[2].values["channel"] == "transverse_b"


def codes(ident, purpose):
    return [finding.code for finding in check_box(ident, purpose, TODAY)]


def state(robot=False, purpose=None, **more):
    return LiveState(SessionProgress(), None, robot, purpose or Purpose(), **more)


class TestState:
    def test_a_silent_robot_is_said_and_that_it_is_heard_again(self):
        session = Session()
        for age_s, ok in ((0.1, True), (4.0, True), (5.0, True), (0.1, True), (5.0, True), (6.0, False), (0.1, True)):
            session.look(robot_age_s=age_s, robot_ok=ok)
        assert [text.removeprefix("robot: 0.0 readings/s, last ") for text in session.said] == [
            "4.0 s ago; silent for 3 s",
            "0.1 s ago",
            "5.0 s ago; silent for 3 s",
            f"6.0 s ago; {Finding('robot-lost').text()}",
            "0.1 s ago",
        ]

    def test_the_end_of_a_robots_program(self):
        session = Session()
        for ok, closed in ((True, False), (False, True), (True, False), (False, False)):
            session.look(robot_ok=ok, robot_closed=closed)
            (row,) = (row for row in session.state.rows if row.name == "robot")
            assert bool(row.alarms) == (not ok and not closed)
        (text,) = session.said
        assert text.endswith(Finding("robot-lost").text())
        session = Session(plan(*PAIRS[:1]))
        session.state.progress.visit(np.zeros(2))
        for age_s, ok in ((0.1, True), (5.0, True), (6.0, False)):
            session.look(robot_age_s=age_s, robot_ok=ok)
        assert [text.partition(":")[0] for text in session.said] == ["taken"]

    def test_losses_silence_and_refusals(self):
        session = Session()
        for lost, restarts in ((0, 0), (3, 0), (4, 0), (5, 1)):
            session.look(counters=Counters(lost_frames=lost, restarts=restarts, samples=7))
        assert session.said == [f"{LOSSES['lost_frames']}: 3; so far", f"{LOSSES['restarts']}: 1; so far"]
        session = Session()
        session.look(box_ok=False)
        session.look(file_losses=("s.mcap: was deleted",))
        assert [text.partition(":")[0] for text in session.said] == ["box", "box", "file"]
        assert session.said[0].endswith(f"; {Finding('box-silent').text()}")
        assert session.said[2] == "file: s.mcap: was deleted"
        view = state(purpose=Purpose(ball_bar=True))
        with pytest.raises(InputError, match=r"length.* nothing was started") as refused:
            view.approve(box(calibration={}))
        assert refused.value.finding.code == "unready-box"
        problems = refused.value.finding.values["problems"]
        assert len(problems) == 1
        every = [*problems, "a, b"] * 7
        assert InputError("unready-box", problems=every).finding.text().startswith("; ".join(every) + "; ")
        all_the_same = state(purpose=Purpose(ball_bar=True), unchecked=True)
        all_the_same.approve(box(calibration={}))
        assert "calibrated" in all_the_same.messages[0]

    def test_an_error_ends_the_view_alone(self):
        broken = state()
        broken.progress = None
        broken.status(Session().status())
        assert broken.trouble.startswith("the live view failed (AttributeError")
        broken.reading(1, JointLine(0.0, [0.0]))
        assert broken.wishes() == []

    def test_a_box_far_from_its_calibrations_temperature_is_said_once_with_the_size(self):
        """5 K: 11.5 ppm/K of a bar of 0.5 m and 100 ppm/K of half a travel of 75 mm are 48 µm."""
        calibrated = {
            "unit": "m",
            "poly": [[0, 0], [4, -2]],
            "serial": "",
            "date": "2026-01-01",
            "temperature_mdegc": 21_000,
        }
        view = state(purpose=Purpose(ball_bar=True), unchecked=True)
        view.approve(box(calibration=calibrated))
        view.messages.clear()
        for degc in (21.0, 22.9, 26.0, 27.0):
            view.box_temperature(degc)
            view.status(Session().status())
        (text,) = view.messages
        assert text.startswith("box: recording, 0 s, 0 samples, shortest round trip 312 µs; ")
        assert all(value in text for value in ("5.0 °C warmer", "lvdt"))
        assert "may be off by about 0.05 mm" in text
        unknown = state(purpose=Purpose(ball_bar=True), unchecked=True)
        unknown.approve(box())
        unknown.box_temperature(40.0)
        unknown.status(Session().status())
        assert not unknown.rows[0].alarms  # nobody noted it

    def test_a_box_that_reads_a_thermometer_on_the_bar_is_not_warned_of(self):
        ident = dataclasses.replace(box(), thermometers=("bar",))
        assert far_from_calibration(ident, "lvdt", 60.0) is None
