"""A session that gives no observation: the error counts what was rejected, by reason, and names the command that helps."""

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_relabel import ROBOT, plan, recorded, right

from truearm.cli.main import main
from truearm.record.recover import recover
from truearm.session.session_file import open_session
from truearm.workflows import inputs
from truearm.workflows.session_observations import Rejected, nothing_observed
from truearm.workflows.session_parts import SETUP, recorded_model

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
    assert f"{path}: no observation from 40 dwells (40 contradiction); " in error
    assert error.endswith(f"decide what was mounted with truearm session relabel '{path}'")


def test_labels_that_the_readings_do_not_support(tmp_path, plan, capsys, monkeypatch):
    path = tmp_path / "s.mcap"
    recorded(path, plan, right(plan))
    monkeypatch.setattr(inputs, "borne_out_rows", lambda robot, rig, result: np.zeros(len(result.table), dtype=bool))
    error = identified(path, capsys)
    assert "no observation from 40 dwells (40 doubtful); check that robot and rig are those that were measured" in error
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
    monkeypatch.setattr(inputs, "borne_out_rows", lambda robot, rig, result: np.arange(len(result.table)) < 3)
    error = identified(path, capsys)
    assert (
        f"{path}: was recorded for robot irb120, and 37 of its 40 observations do not fit {ROBOT.chain.name}" in error
    )
    assert "relabel" not in error


@pytest.mark.parametrize(
    ("dwells", "passes", "planned", "said"),
    [
        ({"gap": 3, "rail": 1}, {}, True, f"from 4 dwells (3 gap, 1 rail); {INSPECT} shows why"),
        ({"no plan match": 1}, {}, True, f"from 1 dwell (1 no plan match); {INSPECT} shows why"),
        ({"no plan match": 2}, {}, False, f"from 2 dwells (2 no plan match); decide what was mounted with {RELABEL}"),
        (
            {"ambiguous": 2, "gap": 1},
            {},
            True,
            f"from 3 dwells (2 ambiguous, 1 gap); decide what was mounted with {RELABEL}; "
            f"{INSPECT} shows why the others were rejected",
        ),
        ({}, {"too short": 1}, True, f"from 1 motion along a line (1 too short); {INSPECT} shows why"),
        (
            {"gap": 1},
            {"noisy": 2},
            True,
            f"from 1 dwell (1 gap) and 2 motions along a line (2 noisy); {INSPECT} shows why",
        ),
    ],
)
def test_reasons_and_commands(dwells, passes, planned, said):
    rejected = Rejected(Counter(dwells), Counter(passes), planned)
    assert nothing_observed(Path("s.mcap"), rejected) == f"s.mcap: no observation {said}"


def test_the_session_of_another_robot(tmp_path, plan, capsys):
    """Every reading contradicts its label, so the robot is named as the cause before the labels are."""
    path = tmp_path / "s.mcap"
    recorded(path, plan, right(plan))
    assert main(["identify", str(path), "--model", "irb120", "--out", str(tmp_path / "r.json")]) == 2
    assert "(40 doubtful)" in capsys.readouterr().err


def test_nothing_at_all():
    said = nothing_observed(Path("s.mcap"), Rejected(Counter(), Counter(), False))
    assert said == f"s.mcap: no dwell and no motion along a line was found; see {INSPECT}"
