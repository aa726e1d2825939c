"""What the operator sees and types during a recording: pairings, the LVDT's travel, and whether the box can measure what is needed."""

import dataclasses
import re

import numpy as np
import pytest
from record_live import PAIRS, TODAY, Session, box, plan

from truearm.box.readiness import Purpose, Verdict, check_box, far_from_calibration
from truearm.errors import InputError
from truearm.live.keyboard import LONGEST, Typed
from truearm.live.session_progress import SessionProgress
from truearm.live.state import LiveState
from truearm.live.view import WAITING, View
from truearm.session.box_frames import Data
from truearm.session.joint_format import JointLine
from truearm.types import Rig


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
    def test_the_bar_is_drawn_and_warned_of_near_its_ends(self):
        session = Session(mounted={"bar": "b46"})
        session.run(0.5)
        assert re.fullmatch(r"├─{15}●─{15}┤ [+-]0.000\d mm of ±37.5 mm", session.row("lvdt").text)
        assert not session.row("lvdt").alarm
        session.run(3.1, speed=0.01)
        assert session.row("lvdt").alarm
        assert session.row("lvdt").text.endswith("near its end")
        assert [text[:22] for text in session.said] == ["warning: lvdt is near "]
        session.run(0.8, speed=0.01)
        assert session.row("lvdt").text.endswith("BEYOND ITS TRAVEL")
        assert len(session.said) == 1  # once

    def test_the_transverse_sensors_of_a_line(self):
        """What the LVDT shows here is a transducer's; its range is the rig's."""
        session = Session(mounted={"line": "l1", "target": "t1"}, rig=Rig(line_travel=0.015))
        session.state.ident(box(name="transverse_a"))
        session.run(0.5)
        assert not session.row("transverse_a").alarm
        session.run(0.7, speed=0.01)  # to 7 mm of 7.5
        assert session.row("transverse_a").alarm
        assert [text[:30] for text in session.said] == ["warning: transverse_a is near "]
        assert session.said[0].endswith("mm of ±7.5 mm")

    def test_the_rail(self):
        session = Session()
        counts = np.full((13, 4), 2**23 - 1, "<i4")
        session.state.block(session.t, Data(0, 0, 0, 0, 983_040, b"", counts.tobytes(), 0))
        assert "saturated" in session.row("lvdt").text

    def test_the_rail_is_an_alarm_only_where_a_bar_must_be_on(self):
        """At a dwell of the plan, but not on the way, while another bar is mounted, or once the plan is complete."""
        session = Session(plan(("b46", "c1"), ("b61", "c1")))
        railed = Data(0, 0, 0, 0, 983_040, b"", np.full((1300, 4), 2**23 - 1, "<i4").tobytes(), 0)

        def alarm():
            session.state.block(session.t, railed)
            text = session.row("lvdt").text
            assert ("wire is broken" in text) == session.row("lvdt").alarm
            assert ("while the bar is detached" in text) != session.row("lvdt").alarm
            return session.row("lvdt").alarm

        session.run(1.0)  # at pose 0, too short for a dwell so far
        assert alarm()
        session.run(2.0)  # the dwell is counted, and the next pose needs another bar
        assert not alarm()
        session.state.command("")  # it is mounted; the robot still stands at pose 0
        session.run(0.3, q_speed=1.0)
        assert not alarm()  # on the way
        session.run(0.2, q_speed=1.0)
        session.run(1.0)
        assert alarm()  # at pose 1
        session.run(2.0)
        assert not alarm()  # the plan is complete

    @pytest.mark.parametrize("mounted", [{}, {"bar": "b46"}])
    def test_the_rail_without_a_plan(self, mounted):
        session = Session(mounted=mounted, robot=False)
        counts = np.full((13, 4), 2**23 - 1, "<i4")
        session.state.block(session.t, Data(0, 0, 0, 0, 983_040, b"", counts.tobytes(), 0))
        assert session.row("lvdt").alarm == bool(mounted)

    def test_a_stream_that_has_run_dry(self):
        """The converter has died, the box's heartbeats go on."""
        session = Session()
        session.run(0.5)
        for elapsed_s, box_ok, said in (
            (12.0, True, "adc 1017.3 Hz"),
            (13.9, True, "adc 1017.3 Hz"),
            (20.0, True, "adc NO SAMPLES for 8 s"),
            (21.0, False, "adc 1017.3 Hz"),
        ):
            status = dataclasses.replace(session.status(box_ok=box_ok), elapsed_s=elapsed_s)
            row = session.state.rates(status)
            assert row.text.startswith(said)
            assert row.alarm == ("NO" in said)
        session.run(0.1)
        assert session.state.rates(dataclasses.replace(session.status(), elapsed_s=30.0)).text.startswith(
            "adc 1017.3 Hz"
        )

    def test_on_one_line(self):
        session = Session(plan(*PAIRS))
        session.run(2.0)
        text = session.state.line(session.status(), None)
        assert text.startswith("lvdt ")
        assert "; samples adc 1017.3 Hz; 0 samples, 0 frames lost; clock shortest round trip 312 µs; robot 78." in text
        assert re.search(r"last 0\.0 s ago; dwells 1 of 4, standing for (1\.9|2\.0) s, long enough$", text)


class TestCheck:
    def test_a_good_box(self):
        assert check_box(box(), Purpose(ball_bar=True, osr=4096), TODAY) == Verdict()

    @pytest.mark.parametrize(
        ("lvdt", "says"),
        [
            (
                {"name": "lvtd"},
                "has no channel lvdt (it has lvtd, c1, c2, c3); to rename one, save what truearm box config get "
                "--box /dev/ttyACM1 prints as box.toml, edit it, and run truearm box config set box.toml --box /dev/ttyACM1",
            ),
            (
                {"calibration": {}},
                "truearm box gauge lvdt --box /dev/ttyACM1",
            ),
            ({"calibration": {"unit": "V", "poly": [[1, 0]]}}, "calibrated to"),
            ({"scale": [1]}, "channel lvdt cannot be used: scale must be"),
        ],
    )
    def test_refused_for_a_ball_bar(self, lvdt, says):
        verdict = check_box(box(**lvdt), Purpose(ball_bar=True, device="/dev/ttyACM1"), TODAY)
        assert says in verdict.refused[0]
        assert not check_box(box(**lvdt), Purpose(), TODAY).refused

    def test_warned(self):
        old = {"calibration": {"unit": "m", "poly": [[1, 0]], "date": "2024-11-22"}}
        verdict = check_box(box(**old), Purpose(ball_bar=True, osr=128), TODAY)
        assert verdict.warned == (
            "channel lvdt was calibrated 730 days ago, on 2024-11-22; calibrate it again with truearm box gauge lvdt --box DEVICE",
            "stream adc samples at oversampling ratio (osr) 4096, not 128 as requested",
        )
        soon = {"calibration": {"unit": "m", "poly": [[1, 0]], "date": "2030-01-01"}}
        assert "which is in the future" in check_box(box(**soon), Purpose(ball_bar=True), TODAY).warned[0]
        assert "no channel of the box" in check_box(box(calibration={}), Purpose(), TODAY).warned[0]

    def test_a_line_needs_its_sensors(self):
        refused = check_box(box(), Purpose(line=True), TODAY).refused
        assert ["magnetostrictive" in text for text in refused] == [True, False, False]
        assert "transverse_b" in refused[2]


class TestView:
    def test_a_silent_robot_is_said_and_that_it_is_heard_again(self):
        view = View(LiveState(SessionProgress(), None, True), Purpose())
        session, said = Session(), []
        for age_s, ok in ((0.1, True), (4.0, True), (5.0, True), (0.1, True), (5.0, True), (6.0, False), (0.1, True)):
            view.status(dataclasses.replace(session.status(robot_age_s=age_s), robot_ok=ok))
            said += view.take()[0]
        assert said == [
            "warning: the robot has been silent for 3 s",
            "the robot sends again",
            "warning: the robot has been silent for 3 s",
            "warning: the robot was lost; trying to reach it again",
            "the robot is back",
        ]

    def test_a_robot_that_ends_its_program_is_not_lost(self):
        view = View(LiveState(SessionProgress(), None, True), Purpose())
        session, said = Session(), []
        for ok, closed in ((True, False), (False, True), (True, False), (False, False)):
            status = dataclasses.replace(session.status(), robot_ok=ok, robot_closed=closed)
            view.status(status)
            said += view.take()[0]
            (row,) = (row for row in view.rows(status) if row.name == "robot")
            assert row.alarm == (not ok and not closed)
        assert [text.startswith("warning") for text in said] == [False, False, True]
        assert "lost" not in said[0]

    def test_a_robot_that_stops_sending_after_the_plan_is_no_warning(self):
        state = LiveState(SessionProgress(plan(*PAIRS[:1])), None, True)
        state.session_progress.visit(np.zeros(2))
        view = View(state, Purpose())
        session, said = Session(), []
        for age_s, ok in ((0.1, True), (5.0, True), (6.0, False)):
            view.status(dataclasses.replace(session.status(robot_age_s=age_s), robot_ok=ok))
            said += view.take()[0]
        assert len(said) == 2
        assert not any(text.startswith("warning") for text in said)

    def test_a_box_that_is_refused(self):
        view = View(LiveState(SessionProgress(), None, False), Purpose(ball_bar=True))
        with pytest.raises(InputError, match=r"length.* Nothing was started"):
            view.approve(box(calibration={}))
        all_the_same = View(LiveState(SessionProgress(), None, False), Purpose(ball_bar=True), unchecked=True)
        all_the_same.approve(box(calibration={}))
        assert "not calibrated" in all_the_same.take()[0][0]

    def test_a_box_far_from_its_calibrations_temperature_is_said_once_with_the_size(self):
        """5 K: 11.5 ppm/K of a bar of 0.5 m and 100 ppm/K of half a travel of 75 mm are 48 µm."""
        calibrated = {
            "unit": "m",
            "poly": [[0, 0], [4, -2]],
            "serial": "",
            "date": "2026-01-01",
            "temperature_mdegc": 21_000,
        }
        view = View(LiveState(SessionProgress(), None, False), Purpose(ball_bar=True), unchecked=True)
        view.approve(box(calibration=calibrated))
        view.take()
        for degc in (21.0, 22.9, 26.0, 27.0):
            view.box_temperature(degc)
        (text,) = view.take()[0]
        assert text.startswith("warning: the box is 5.0 °C warmer than when lvdt was calibrated")
        assert "may be off by about 0.05 mm" in text
        unknown = View(LiveState(SessionProgress(), None, False), Purpose(ball_bar=True), unchecked=True)
        unknown.approve(box())
        unknown.take()
        unknown.box_temperature(40.0)
        assert unknown.take()[0] == []  # nobody noted it

    def test_a_box_that_reads_a_thermometer_on_the_bar_is_not_warned_of(self):
        ident = dataclasses.replace(box(), thermometers=("bar",))
        assert far_from_calibration(ident, "lvdt", 60.0) == ""

    def test_a_view_that_stands_still_is_bounded(self):
        view = View(LiveState(SessionProgress(), None, False), Purpose())
        for _ in range(WAITING + 5):
            view.reading(1, JointLine(0.0, [0.0]))
        assert view.trouble == "the live view stalled and missed 5 updates; the recording was not affected"
