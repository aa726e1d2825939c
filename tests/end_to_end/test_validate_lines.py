"""`truearm validate` with sessions of the line device: calibrations by ball-bar and by other lines, and robots that changed."""

import json

import numpy as np
import pytest
from tests.end_to_end.conftest import record_session
from tests.host.findings_bench import listed

from truearm.cli.main import main
from truearm.model.robot_file import builtin_robot
from truearm_sim.line_plan import drawn_line_plan, line_rig

ROBOT = builtin_robot("puma560")
TRUTH = ROBOT.parameter_sets["optimised"]
DELAY_S = 8e-3


def lines(folder, name, seed, params=TRUTH):
    path = folder / f"{name}.mcap"
    plan = drawn_line_plan(3, seed)
    given = {"seed": seed, "plan": plan, "rig": line_rig(), "params": params, "robot_delay_s": DELAY_S}
    return record_session(path, 0, osr=16384, **given).path


@pytest.fixture(scope="module")
def found(short_session, tmp_path_factory):
    """A folder with calibrations by the ball-bar and by lines, and a session of other lines."""
    folder = tmp_path_factory.mktemp("found")
    first = lines(folder, "first", 1)
    for name, session, *more in (("bar", short_session.path), ("line", first, "--solver", "map")):
        given = ["identify", session, "--model", "puma560", "--out", folder / f"{name}.json", *more]
        assert main([str(a) for a in given]) == 0
    return folder, lines(folder, "other", 8)


@pytest.fixture
def judged(printed):
    return lambda result, *sessions: json.loads(printed("validate", result, *sessions, "--json"))


def test_a_calibration_by_the_ball_bar_holds_on_lines(found, judged):
    """A line's points have more noise than a bar's length, 0.13 mm: that is not a fault of the robot's."""
    folder, other = found
    told = judged(folder / "bar.json", other)
    assert told["settled"] == 3 * 6 + 1  # the devices' poses and the readings' delay
    assert told["rms_before_mm"] > 0.8
    due = told["expected"]
    assert due["by_noise_mm"] == pytest.approx(1e3 * np.linalg.norm(line_rig().line_sigma), rel=0.02)
    assert told["rms_after_mm"] == pytest.approx(due["rms_mm"], rel=0.15)
    assert "validation-holds" in listed(told)
    assert {"line=l1", "line=l2", "line=l3"} < {region["region"] for region in told["regions"]}


def test_what_lines_did_not_know_of_other_lines_is_expected(found, judged):
    folder, other = found
    told = judged(folder / "line.json", other)
    due = told["expected"]
    assert due["by_parameters_mm"] > 2.0 * due["by_noise_mm"]
    assert 1.5 * due["by_noise_mm"] < told["rms_after_mm"] < 1.5 * due["rms_mm"]
    assert "validation-uncertain" in listed(told)


def test_lines_say_nothing_of_where_the_base_stands(found, short_session, judged):
    """Judged by a bar between chucks of known place; with lines beside it, those are judged anyway."""
    folder, other = found
    told = judged(folder / "line.json", short_session.path)
    assert told["unseen"] == told["rows"]
    assert told["expected"] is None
    assert "rows-unseen" in listed(told)
    both = judged(folder / "line.json", short_session.path, other)
    assert both["unseen"] == told["rows"]
    assert both["expected"]["rms_after_mm"] == pytest.approx(judged(folder / "line.json", other)["rms_after_mm"])
    assert {region["rms_expected_mm"] is None for region in both["regions"]} == {True, False}
