"""The geometry of a real UR10 measured by a laser tracker, with default options except for joint laws."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.host.findings_bench import stated
from tests.host.ur10_bench import RIG, ROBOT, tracked

import truearm
from truearm.kinds.table_file import concatenate
from truearm.report.result_findings import tool_error
from truearm.workflows.selection import held_out_rows

GEOMETRY = truearm.IdentifyOptions(joint_laws="none")
FRAMES = {"base.x", "base.y", "base.z", "base.alpha", "base.beta", "base.gamma"}


@pytest.mark.parametrize(
    ("series", "kind", "largest"),
    [
        ("a", "position", 0.40),
        pytest.param("a", "pose", 0.40, marks=pytest.mark.soak),
        pytest.param("c", "position", 0.44, marks=pytest.mark.soak),
        pytest.param("c", "pose", 0.44, marks=pytest.mark.soak),
    ],
)
def test_defaults_converge_and_predict(series, kind, largest):
    """In 20 iterations, to the held-out error that the data allow (mm); before is after base and tool are placed."""
    found = truearm.identify(ROBOT, tracked(series, kind), RIG, hold_out=0.2, options=GEOMETRY)
    assert found.estimate.status == "converged"
    assert found.estimate.iterations <= 20
    errors = 1e3 * found.estimate.residual["m"][~found.estimate.fitted]
    # Which fifth is held out moves the mean by its standard error, 0.004 mm; three draws have 0.398 mm of series A.
    assert errors.mean() <= largest + errors.std() / np.sqrt(errors.size)
    # A grid: neighbours in the order of measurement err alike, which is no event. Gears may err.
    names = {rival.name.partition(".")[2] for fault in found.estimate.faults for rival in fault.rivals}
    assert names <= {"eccentricity", "backlash"}
    assert found.estimate.scatter.n == 0  # a pose has one row, but for few that come twice
    assert 0.7 < found.document["held_out_before"]["mean_mm"] < 0.95
    assert found.document["rank"] == found.document["n_free"]
    assert found.document["null_space"] == []
    assert set(found.document["defaults"]["base"]) >= FRAMES
    assert "joint6.d" in found.document["defaults"]["tool"]  # the target's place on the flange is as unknown
    assert all(p["seen"] for p in found.document["parameters"] if p["free"])
    lengths = [
        p["value"] - p["nominal"] for p in found.document["parameters"] if p["unit"] == "m" and p["of"] == "robot"
    ]
    assert np.abs(lengths).max() < 8e-3  # nothing wanders off along what the data hardly tell
    findings = stated(found.document)
    assert {"target.reflector", "tracker.tracker"} <= set(findings["before"].values["fitted"])
    assert found.document["unexplained"]["mean_mm"] == pytest.approx(errors.mean(), rel=0.05)
    # The covariance knows only of the declared noise; the arm's scatter, which the fitted rows show, is of the rest.
    predicted, rms = found.document["predicted_error"]["rms_mm"], np.sqrt((errors**2).mean())
    assert predicted > 0.85 * rms
    assert predicted < 1.15 * rms or found.estimate.faults  # which it counts in
    assert "base.x" in findings["held-frames"].values["base"]


def test_what_the_prior_holds_is_still_called_hardly_seen():
    """The positions tell joint 5's place along itself against its neighbours' only to centimetres."""
    table = tracked("c", "position")
    found = truearm.identify(ROBOT, table, RIG, options=GEOMETRY)
    assert set(found.document["defaults"]["believed"]) == {f"joint5.{k}" for k in ("offset", "d", "a", "alpha")}
    hardly = {name for direction in found.document["hardly_seen"] for name in direction["names"]}
    assert {"joint5.d", "joint5.alpha"} <= hardly
    free = truearm.identify(ROBOT, table, RIG, options=replace(GEOMETRY, prior="none", max_iterations=4))
    assert free.document["prior"] == "none"
    assert free.document["defaults"]["believed"] == []


def test_a_fraction_held_out_is_of_poses():
    """Three reflectors on the tool, seen in each pose: rows of one pose err together, so none may judge another."""
    one = tracked("c", "position", every=10)
    three = concatenate([one, one, one])
    held = held_out_rows(three, ["0.2"], 0)
    assert held.sum() == 3 * round(0.2 * len(one))
    np.testing.assert_array_equal(held.reshape(3, -1), np.tile(held_out_rows(one, ["0.2"], 0), (3, 1)))


def test_a_fit_that_did_not_converge_leads_with_that():
    options = truearm.IdentifyOptions(max_iterations=1)
    found = truearm.identify(ROBOT, tracked("c", "position", every=10), RIG, options=options)
    assert found.document["predicted_error"] is None
    assert tool_error(found.document) == []
    assert (found.document["usable"], found.document["unusable_because"]) == (False, "not converged")
    assert next(iter(stated(found.document))) == "not-converged"


AXIS = """[joint1]
kind = "revolute"
lower_deg = -360.0
upper_deg = 360.0
offset_deg = { design = 0.0 }
gain = { design = 1.0, held = true }
d_mm = { design = 500.0 }
a_mm = { design = 300.0 }
alpha_deg = { design = 90.0 }

"""


@pytest.mark.parametrize("jitter", [pytest.param(0.0, marks=pytest.mark.soak), 3e-4])
def test_an_axis_that_stands_still_is_held(tmp_path, jitter):
    """The arm on a further axis, which is held by its brake: its readings jitter by 0.3 mrad. That shows nothing of the axis."""
    text = re.sub(r"\[joint(\d)\]", lambda found: f"[joint{int(found[1]) + 1}]", Path(ROBOT.file).read_text())
    file = tmp_path / "on_an_axis.toml"
    file.write_text(text.replace("[joint2]", AXIS + "[joint2]", 1))
    robot = truearm.load_robot(file)
    table = tracked("c", "position", every=3)
    axis = 0.4 + jitter * np.random.default_rng(0).normal(size=len(table))
    on_axis = replace(table, q=np.column_stack([axis, table.q]), q_rate=None, side=None)
    found = truearm.identify(robot, on_axis, RIG, hold_out=0.2, options=GEOMETRY)
    assert found.estimate.status == "converged"
    assert found.estimate.iterations <= 20
    (still,) = found.document["defaults"]["still"]
    assert still["joint"] == "joint1"
    assert still["spread"] == pytest.approx(np.ptp(axis[found.estimate.fitted]))
    assert {"joint1.a", "joint1.alpha"} <= set(found.document["defaults"]["lost"])
    assert found.document["rank"] == found.document["n_free"] == 18  # as the arm alone
    assert stated(found.document)["still"].values["joint"] == "joint1"
    asked = truearm.IdentifyOptions(also_free=("joint1.a",), max_iterations=1)
    assert "joint1.a" in truearm.identify(robot, on_axis, RIG, options=asked).document["free"]
