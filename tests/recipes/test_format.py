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
ROBOTS = ("ur5e", "puma560")  # gains of 1 that are held, and gains that are identified


def disturbed(name):
    """Return a robot that differs from its description."""
    robot, rng = builtin_robot(name), np.random.default_rng(5)
    return robot.chain, robot.chain.params_nominal + robot.free * rng.normal(size=len(robot.free)) * 1e-3


def joints():
    return np.random.default_rng(6).uniform(-2.0, 2.0, (N, 6))


@pytest.fixture(scope="module")
def copy(tmp_path_factory):
    """The package with the format, and tables of a tracker for two robots."""
    copy = Copy(tmp_path_factory.mktemp("format"))
    copy.apply("A format to export")
    assert copy.changes() == {"host/truearm/export/formats.py": "+1 -0", "host/truearm/export/screws.py": "new file"}
    for name in ROBOTS:
        chain, params = disturbed(name)
        ends = forward(chain, params, joints())
        (copy.folder / f"{name}.csv").write_text(tracked(joints(), ends, np.zeros((N, 3))))
    (copy.folder / "rig.toml").write_text(RIG)
    return copy


@pytest.fixture(scope="module")
def said(copy):
    """Return what the commands print."""
    commands = [("export", "--help")]
    for name in ROBOTS:
        table, result = f"{name}.csv", f"{name}.json"
        commands.append(("identify", table, "--model", name, "--rig", "rig.toml", "--out", result))
        out = f"screws-{name}.json"
        commands.append(("export", result, "--format", "screws", "--out", out, "--over", table, "--json"))
    return copy.run_each(*commands)


def position_errors(copy, name):
    """Return the distance [mm], (n,), between the file's own formula and the disturbed robot."""
    document = json.loads((copy.folder / f"screws-{name}.json").read_text())
    wanted = forward(*disturbed(name), joints())
    return np.array(
        [
            1e3 * np.linalg.norm(exponentials(document, q)[:3, 3] - end[:3, 3])
            for q, end in zip(joints(), wanted, strict=True)
        ]
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


def test_help_lists_it(said):
    code, out, _ = said[0]
    assert code == 0
    assert "screws: axes of the joints at readings 0 (.json)." in " ".join(out.split())


def test_it_holds_a_robot_without_gains(copy, said):
    assert [each.code for each in said[1:3]] == [0, 0], said[2].err
    assert findings(said[2].out)["exported"] == {"exact": True}
    assert position_errors(copy, "ur5e").max() < 1e-6


def test_what_gains_cost_is_said_and_true(copy, said):
    assert [each.code for each in said[3:5]] == [0, 0], said[4].err
    stated = findings(said[4].out)
    assert stated["format-lacks"] == {"format": "screws", "names": [f"joint{i}.gain" for i in range(1, 7)]}
    rms, largest = (stated["exported"][name]["mm"] for name in ("left", "largest"))
    wrong = position_errors(copy, "puma560")
    assert rms == pytest.approx(np.sqrt(np.mean(wrong**2)), rel=1e-6)
    assert largest == pytest.approx(wrong.max(), rel=1e-6)
    assert rms > 0.01
