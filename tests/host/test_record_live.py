"""Dwells and lines during a recording, and the plan to which they belong."""

import re

import numpy as np
import pytest
from record_live import NOISE, PAIRS, S, Session, plan

from truearm.findings import Finding
from truearm.live.state import SessionProgress


class TestDwells:
    @pytest.mark.parametrize("robot", [True, False], ids=["robot", "pendant"])
    def test_counted_and_described_while_they_last(self, robot):
        session = Session(robot=robot)
        places = []
        for k in range(3):
            session.dwell()
            places.append(session.position)
            assert session.said[-1].startswith(f"dwell {k + 1}: ")
        assert session.row("taken").text.startswith("3 dwells, standing for ")
        session.run(0.5, speed=0.01, q_speed=1.0)
        events = session.events("dwell")
        assert len(events) == 3
        for place, event in zip(places, events, strict=True):
            assert event["end_ns"] - event["begin_ns"] == pytest.approx(1.6 * S, abs=0.02 * S)
            # the mean of 1017 samples: 2 µm / √1017 and the counts' rounding, well below 0.3 µm
            assert event["mean_m"] == pytest.approx(place, abs=3e-7)
            assert event["noise_m"] == pytest.approx(NOISE, rel=0.1)
            assert event["settled"]

    @pytest.mark.parametrize("robot", [True, False], ids=["robot", "pendant"])
    def test_a_busy_machine_changes_nothing(self, robot):
        """All arrives in bursts, every 0.6 s: what stood still did so by its own clock."""
        session = Session(robot=robot)
        session.burst = 6 * S // 10
        for _ in range(4):
            session.dwell(2.0)
            session.dwell(1.4)
        assert len(session.events("dwell")) == 4

    def test_when_a_dwell_is_too_short_or_ended(self):
        session = Session()
        for _ in range(3):
            session.dwell(1.0)
        assert session.events("dwell") == []
        # The joints stand, the bar goes on by 2 µm a second, where noise allows a fraction of one.
        session = Session()
        session.run(0.5, q_speed=1.0)
        session.run(2.5, speed=2e-6)
        assert [event["settled"] for event in session.events("dwell")] == [False]
        assert session.said[-1].endswith("NOT settled")
        session = Session()
        session.dwell(1.0)
        session.t += 5 * S
        session.run(1.0)
        assert session.events("dwell") == []

    def test_saturated_sensors_and_silent_robots_and_boxes(self):
        session = Session()
        session.position = 10.0  # beyond the converter's range
        session.dwell()
        assert session.said[-1] == Finding("sensor-silent", {"place": "dwell 1"}).text()
        assert "mean_m" not in session.events("dwell")[0]
        # Its readings ended one second after it stopped: the bar goes on to be read, and the pose is not taken.
        session = Session(plan(*PAIRS))
        session.run(1.0)
        session.robot = False
        session.run(6.0)
        assert re.match(r"0 \w+ 4 dwells$", session.row("taken").text)
        assert not session.events("dwell")
        session = Session(mounted={"bar": "b46"}, robot=False)
        session.run(1.0)
        session.look(box_ok=False)
        assert not any("standing" in row.text for row in session.state.rows)


class TestThePlan:
    def test_poses_are_matched_and_counted_once(self):
        session = Session(plan(*PAIRS))
        session.run(2.5)
        session.dwell()
        assert session.said[-2].startswith("pose 1: ")  # other commands number the dwells otherwise
        session.run(0.5, q_speed=-1.0)  # back to the first
        session.run(2.5)
        assert session.state.progress.done == {0, 1}
        assert re.match(r"2 \w+ 4 dwells, standing", session.row("taken").text)
        session = Session(plan(*PAIRS[:2]))
        session.run(2.5)
        said = f"; {Finding('plan-complete').text()}"
        assert not any(said in text for text in session.said)
        session.dwell()
        assert session.said[-1].endswith(said)
        session.dwell()
        assert sum(said in text for text in session.said) == 1
        session = Session(plan(*PAIRS))
        session.q = np.array([3.0, -3.0])
        session.run(2.5)
        assert re.match(r"0 \w+ 4 dwells, 1 ", session.row("taken").text)
        assert session.said[-1].startswith("stop ")
        assert "pose" not in session.events("dwell")[0]

    def test_a_pairing_is_asked_for_and_confirmed(self):
        session = Session(plan(*PAIRS))
        assert session.state.progress.mounted == {"bar": "b46", "chuck": "c1", "sphere": "s1"}
        session.run(2.5)
        assert session.row("mounted").text == "bar b46, chuck c1, sphere s1"
        session.dwell()
        asked = Finding("mount-next", {"what": "bar b61, chuck c1, sphere s1"}).text()
        assert session.said[-1] == f"mounted: bar b46, chuck c1, sphere s1; {asked}"
        assert session.row("mounted").alarms
        session.type("")
        assert session.events("mounted") == [{"bar": "b61", "chuck": "c1", "sphere": "s1"}]
        assert not session.row("mounted").alarms
        assert session.said[-1] == "mounted: bar b61, chuck c1, sphere s1"

    def test_with_and_without_a_confirmation(self):
        session = Session(plan(*PAIRS))
        session.type("bar=b46")
        session.run(2.5)
        for _ in range(2):
            session.dwell()
        assert len([text for text in session.said if text.startswith("contradiction")]) == 1
        (warning,) = session.row("contradiction").alarms
        values = {"place": "pose 2", "needed": "bar b61", "confirmed": "bar b46, chuck c1, sphere s1"}
        assert warning == Finding("other-mounted", values)
        # The plan alone says what is mounted, and ``identify`` takes it; the view goes on asking.
        session = Session(plan(*PAIRS))
        session.run(2.5)
        for _ in range(2):
            session.dwell()
        assert not [text for text in session.said if text.startswith("contradiction")]
        assert session.row("mounted").alarms
        session = Session(plan(*PAIRS), robot=False)
        session.run(2.5)
        session.dwell()
        assert session.state.progress.done == {0, 1}
        assert session.state.progress.change() == {"bar": "b61", "chuck": "c1", "sphere": "s1"}

    def test_lines_count_as_the_robot_comes_to_their_ends(self):
        rows = [
            {"pose": 0, "move": "via", "q": [0.0, 0.0]},
            {"pose": 1, "move": "line", "line": "l1", "target": "t1", "q": [0.5, 0.5]},
            {"pose": 2, "move": "line", "line": "l2", "target": "t1", "q": [0.0, 0.0]},
        ]
        session = Session(rows)
        session.run(2.0)
        assert re.match(r"0 \w+ 2 lines", session.row("taken").text)
        session.run(0.5, q_speed=1.0)
        assert re.match(r"1 \w+ 2 lines", session.row("taken").text)
        assert session.row("mounted").alarms[0].values["what"] == "line l2, target t1"
        session.run(2.0)  # a stop is no dwell where the plan has none
        assert [event["pose"] for event in session.events("line")] == [1]
        session.run(0.5, q_speed=-1.0)
        assert session.state.progress.complete
        assert not session.events("dwell")

    def test_a_line_and_a_bar_exclude_each_other(self):
        line = {"pose": 3, "move": "line", "line": "l1", "target": "t1", "speed_m_s": 0.1, "q": [2.0, 2.0]}
        progress = SessionProgress([*plan(*PAIRS[:2]), {"pose": 2, "move": "via", "q": [1.0, 1.0]}, line])
        assert {move: len(rows) for move, rows in progress.planned.items()} == {"dwell": 2, "via": 1, "line": 1}
        progress.visit(np.array([0.0, 0.0]))
        progress.visit(np.array([0.5, 0.5]))
        assert progress.change() == {"line": "l1", "target": "t1"}
        progress.mount(progress.change())
        assert progress.mounted == {"line": "l1", "target": "t1"}
