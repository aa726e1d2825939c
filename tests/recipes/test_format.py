"""A new format to export, the joints' axes, in one new file and one line of the registry."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.recipes.recipes import Copy, findings
from tests.recipes.tracked import RIG, tracked
from truearm.model.chain import forward
from truearm.model.robot import builtin_robot

N = 300


def disturbed():
    """Return a robot that differs from its description."""
    robot, rng = builtin_robot("ur5e"), np.random.default_rng(5)
    return robot.chain, robot.chain.params_nominal + robot.free * rng.normal(size=len(robot.free)) * 1e-3


def joints():
    return np.random.default_rng(6).uniform(-2.0, 2.0, (N, 6))


@pytest.fixture(scope="module")
def copy(tmp_path_factory):
    """The package with the format, and a table of a tracker."""
    copy = Copy(tmp_path_factory.mktemp("format"))
    copy.apply("A format to export")
    assert copy.changes() == {"host/truearm/export/formats.py": "+1 -0", "host/truearm/export/screws.py": "new file"}
    ends = forward(*disturbed(), joints())
    (copy.folder / "poses.csv").write_text(tracked(joints(), ends, np.zeros((N, 3))))
    (copy.folder / "rig.toml").write_text(RIG)
    return copy


@pytest.fixture(scope="module")
def said(copy):
    """Return what the commands print."""
    export = ("export", "result.json", "--format", "screws", "--out", "screws.json", "--over", "poses.csv", "--json")
    return copy.run_each(
        ("identify", "poses.csv", "--model", "ur5e", "--rig", "rig.toml", "--out", "result.json"), export
    )


def exponentials(document, q):
    """Return T(q) of the file, computed independently."""
    out = np.eye(4)
    for joint, angle in zip(document["joints"], q, strict=True):
        turn = np.eye(4)
        turn[:3, :3] = Rotation.from_rotvec(angle * np.array(joint["axis"])).as_matrix()
        turn[:3, 3] = joint["point"] - turn[:3, :3] @ joint["point"]
        out = out @ turn
    return out @ np.array(document["home"])


def test_it_holds_a_robot_without_gains(copy, said):
    assert [each.code for each in said] == [0, 0], said[1].err
    assert findings(said[1].out)["exported"] == {"exact": True}
    document = json.loads((copy.folder / "screws.json").read_text())
    for q, end in zip(joints(), forward(*disturbed(), joints()), strict=True):
        assert np.linalg.norm(exponentials(document, q)[:3, 3] - end[:3, 3]) < 1e-9
