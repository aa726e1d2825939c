"""A session that gives no observation: the error counts what was rejected, by reason, and names the command that helps."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_relabel import ROBOT, plan, recorded, right

from truearm.cli.main import main
from truearm.record.session_copies import recover
from truearm.session.session_file import open_session
from truearm.workflows import relabel
from truearm.workflows.recorded_session import SETUP, nothing_observed, recorded_model

__all__ = ["plan"]  # a fixture
RELABEL, INSPECT = "truearm session relabel s.mcap", "truearm inspect s.mcap"


def identified(path, capsys):
    """Return the error of ``truearm identify``."""
    assert main(["identify", str(path), "--model", ROBOT.chain.name, "--out", str(path.parent / "r.json")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    return line


def test_a_confirmed_pairing_that_the_plan_never_needs(tmp_path, plan, capsys):
    """The operator confirms one pairing for all poses, and the plan has no such pairing."""
    path = tmp_path / "a session.mcap"
    typed = ("a bar", "a chuck", "a sphere")
    recorded(path, plan, [replace(visit, typed=(typed,) * (row == 0)) for row, visit in enumerate(right(plan))])
    error = identified(path, capsys)
    assert f"{path}: " in error
    assert "40 dwells (40 contradiction)" in error
    assert error.endswith(f"truearm session relabel '{path}'")


def test_labels_that_the_readings_do_not_support(tmp_path, plan, capsys, monkeypatch):
    path = tmp_path / "s.mcap"
    recorded(path, plan, right(plan))
    monkeypatch.setattr(relabel, "borne_out_rows", lambda robot, rig, result: np.zeros(len(result.table), dtype=bool))
    error = identified(path, capsys)
    assert "40 dwells (40 doubtful)" in error
    assert f"truearm session relabel {path}" in error


def test_a_session_of_another_robot(tmp_path, plan, capsys, monkeypatch):
    """A session that names another robot is refused only if its readings do not fit this one."""
    recorded(tmp_path / "made.mcap", plan, right(plan))
    session, path = open_session(tmp_path / "made.mcap"), tmp_path / "s.mcap"
    session.metadata[SETUP] = {"model": "irb120"}
    recover(session, path, {})
    assert recorded_model(path) == "irb120"
    assert main(["identify", str(path), "--model", ROBOT.chain.name, "--out", str(tmp_path / "fits.json")]) != 2
    capsys.readouterr()
    monkeypatch.setattr(relabel, "borne_out_rows", lambda robot, rig, result: np.arange(len(result.table)) < 3)
    error = identified(path, capsys)
    assert all(word in error for word in (f"{path}: ", "irb120", "37", "40", ROBOT.chain.name))
    assert "relabel" not in error


@pytest.mark.parametrize(
    ("dwells", "passes", "planned", "said"),
    [
        ({"gap": 3, "rail": 1}, {}, True, ("4 dwells (3 gap, 1 rail)", INSPECT)),
        ({"no plan match": 1}, {}, True, ("1 dwell (1 no plan match)", INSPECT)),
        ({"no plan match": 2}, {}, False, ("2 dwells (2 no plan match)", RELABEL)),
        ({"ambiguous": 2, "gap": 1}, {}, True, ("3 dwells (2 ambiguous, 1 gap)", RELABEL, INSPECT)),
        ({}, {"too short": 1}, True, ("1 motion ", "(1 too short)", INSPECT)),
        ({"gap": 1}, {"noisy": 2}, True, ("1 dwell (1 gap)", "2 motions ", "(2 noisy)", INSPECT)),
    ],
)
def test_reasons_and_commands(dwells, passes, planned, said):
    text = str(nothing_observed(Path("s.mcap"), dwells, passes, planned))
    assert text.startswith("s.mcap: ")
    assert all(part in text for part in said)
    assert [command in text for command in (RELABEL, INSPECT)] == [command in said for command in (RELABEL, INSPECT)]


def test_another_robots_session_and_nothing_at_all(tmp_path, plan, capsys):
    # Every reading contradicts its label, so the robot is named as the cause before the labels are.
    path = tmp_path / "s.mcap"
    recorded(path, plan, right(plan))
    assert main(["identify", str(path), "--model", "irb120", "--out", str(tmp_path / "r.json")]) == 2
    assert "(40 doubtful)" in capsys.readouterr().err
    said = str(nothing_observed(Path("s.mcap"), {}, {}, False))
    assert said.startswith("s.mcap: ")
    assert INSPECT in said
