"""A new fault to test for, a flat that sinks, by two changed lines of its kind."""

import json

import numpy as np

from tests.recipes.recipes import Copy
from truearm.model.chain import forward
from truearm.model.robot import builtin_robot

SIGMA = 2e-5  # m
SUNK = 0.3e-3  # m, from the first row to the last
RIG = """
[[plane]]
name = "p"
xyz_mm = [0, 0, 0]
normal = [0, 0, 1]
sigma_mm = 0.02
offset_sigma_mm = 0
tilt_sigma_deg = 0

[[tracker]]
name = "t"
sigma_mm = [0.02, 0.02, 0.02]
xyz_mm = [0, 0, 0]
position_sigma_mm = 0
turn_sigma_deg = 0
"""


def test_a_flat_that_sinks_is_named(tmp_path):
    copy = Copy(tmp_path)
    copy.apply("A fault to test for")
    assert copy.changes() == {"host/truearm/kinds/plane.py": "+2 -2"}
    robot, rng, n = builtin_robot("puma560"), np.random.default_rng(0), 300
    q = rng.uniform(-2.0, 2.0, (n, 6))
    end = forward(robot.chain, robot.parameter_sets["optimised"], q)[:, :3, 3] + SIGMA * rng.normal(size=(n, 3))
    sunk = np.linspace(0.0, SUNK, n)
    lines = ["kind,plane,tracker,length_m,x_m,y_m,z_m," + ",".join(f"q{i}_rad" for i in range(1, 7))]
    for i, joints in enumerate(q.tolist()):
        of_plane = ["plane", "p", "", repr(float(end[i, 2] + sunk[i])), "", "", ""]
        cells = of_plane if i % 3 == 0 else ["position", "", "t", "", *map(repr, end[i].tolist())]
        lines.append(",".join([*cells, *map(repr, joints)]))
    (tmp_path / "poses.csv").write_text("\n".join(lines) + "\n")
    (tmp_path / "rig.toml").write_text(RIG)
    copy.run("identify", "poses.csv", "--model", "puma560", "--rig", "rig.toml", "--out", "result.json")
    (found,) = json.loads((tmp_path / "result.json").read_text())["faults"]
    (size,) = found["sizes"]
    assert found["rivals"][0]["name"] == "plane.p.offset.drift"
    assert found["rivals"][0]["apply"] == "plane.p.offset.drift"
    assert abs(size["value"] - SUNK) < 4.0 * size["sigma"]
