"""``truearm export``: with the exported file the true robot reaches its targets; real data; bad input."""

import json
from pathlib import Path

import correct_bench
import numpy as np
import pytest
from puma_bench import CHAIN, DESIGN
from tests.host.findings_bench import listed

from truearm.estimate.identify import identify
from truearm.estimate.result_file import read_result
from truearm.kinds.rig_file import read_rig
from truearm.kinds.table_file import read_table
from truearm.model.chain import forward
from truearm.model.robot_file import load_robot

MUKCA = Path(__file__).parents[1] / "data" / "mukca"


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    return correct_bench.write(tmp_path_factory.mktemp("export") / "result.json", correct_bench.identified())


def test_only_what_the_user_may_adjust_changes(result, tmp_path, printed):
    """Renders' III-F: a controller that takes offsets and lengths alone."""
    out = tmp_path / "adjusted.toml"
    patterns = ("--adjust", "joint*.offset", "--adjust", "*.x,*.y,*.z")
    said = printed("export", result, "--format", "sheth-uicker", "--out", out, *patterns, "--json")
    assert listed(json.loads(said))["exported"]["dropped"]["mm"] > 1.0
    chain = load_robot(str(out)).chain
    gains = [value for name, value in zip(chain.parameter_names, chain.params_nominal, strict=True) if "gain" in name]
    np.testing.assert_array_equal(gains, 1.0)
    q = correct_bench.good_poses(100)
    stored = read_result(result)
    identified = forward(CHAIN, stored.column("value")[stored.column("of") == "robot"], q)
    error = (forward(chain, chain.params_nominal, q) - identified)[:, :3, 3]
    before = (forward(CHAIN, DESIGN, q) - identified)[:, :3, 3]
    assert np.sqrt(np.mean(error**2)) < 0.5 * np.sqrt(np.mean(before**2))


def test_panda_exported_and_reloaded_has_the_same_held_out_error(tmp_path, printed):
    """The arm of tests/data/mukca: three places identify it; the exported URDF, as it stands, predicts the other three as well."""
    held = [a for place in ("frontcenter", "frontleft", "frontright") for a in ("--hold-out", f"place={place}")]
    urdf, table, rig = MUKCA / "panda.urdf", MUKCA / "panda_3.csv", MUKCA / "rig.toml"
    result, out = tmp_path / "r.json", tmp_path / "calibrated.urdf"
    known = ["--model", urdf, "--tip", "ball_link", "--rig", rig, "--joint-laws", "none"]  # a URDF holds no laws
    printed("identify", table, *known, "--out", result, *held)
    said = printed("export", result, "--format", "urdf", "--model", urdf, "--out", out)
    assert "holds everything" in said
    stored = read_result(result)
    chain = load_robot(str(out), None, "ball_link").chain
    observations = read_table(table, chain.joint_units)
    judged = np.isin(observations.place, ["frontcenter", "frontleft", "frontright"])
    # nothing of the robot is fitted: only the rig's own unknowns, the ball's place among them
    none = np.zeros(len(chain.parameters), dtype=bool)
    again = identify(chain, read_rig(rig), observations, free=none, hold_out=judged)
    document = stored.held_out
    assert document["mean_mm"] < 0.25
    # the ball's place is estimated again without the robot's prior, which moves the error by micrometres
    assert 1e3 * again.held_out.figures["m"].mean == pytest.approx(document["mean_mm"], abs=5e-3)
    q = observations.q
    before = load_robot(str(urdf), None, "ball_link").chain
    np.testing.assert_allclose(
        forward(chain, chain.params_nominal, q),
        forward(before, stored.column("value")[stored.column("of") == "robot"], q),
        atol=1e-12,
    )
