"""Robot files: the built-in PUMA 560 and refusal of files with holes."""

import numpy as np
import pytest

from truearm.errors import RobotError
from truearm.model.chain import Joint, forward
from truearm.model.robot import builtin_names, builtin_robot, parse_robot
from truearm.model.sheth_uicker import chain_from_sheth_uicker

TINY = """
name = "tiny"
convention = "sheth_uicker"
nominal = "design"
base_frame = "base"
end_frame = "end"
[link1]
x_mm = { design = 1.0 }
y_cm = { design = 1.0 }
z_m = { design = 1.0 }
alpha_deg = { design = 180.0 }
beta_rad = { design = 0.0, held = true }
gamma_deg = { design = 0.0 }
[joint1]
kind = "prismatic"
lower_mm = -5.0
upper_mm = 5.0
offset_mm = { design = 2.0 }
gain = { design = 1.0 }
[link2]
x_m = { design = 0.0 }
y_m = { design = 0.0 }
z_m = { design = 0.0 }
alpha_deg = { design = 0.0 }
beta_deg = { design = 0.0 }
gamma_deg = { design = 0.0 }
"""


def test_the_puma_is_built_in():
    assert "puma560" in builtin_names()
    robot = builtin_robot("puma560")
    chain = robot.chain
    assert len(chain.parameters) == 54
    assert robot.free.sum() == 36
    link1 = [f"link1.{k}" for k in ("x", "y", "z", "alpha", "beta", "gamma")]
    assert chain.parameter_names[:8] == (*link1, "joint1.offset", "joint1.gain")
    assert chain.parameter_names[-1] == "link7.gamma"
    design, optimised = robot.parameter_sets["design"], robot.parameter_sets["optimised"]
    np.testing.assert_array_equal(chain.params_nominal, design)
    np.testing.assert_array_equal(design[~robot.free], optimised[~robot.free])
    assert np.rad2deg(optimised[chain.parameter_names.index("link6.beta")]) == pytest.approx(3.18249)
    assert all(j.lower < 0 < j.upper for j in chain.joints)


def test_units_of_a_file_become_si():
    robot = parse_robot(TINY)
    np.testing.assert_allclose(robot.chain.params_nominal[:8], [1e-3, 1e-2, 1.0, np.pi, 0, 0, 2e-3, 1.0])
    assert robot.chain.joints[0] == Joint("joint1", "prismatic", -5e-3, 5e-3)
    assert not robot.free[robot.chain.parameter_names.index("link1.beta")]
    pose = forward(robot.chain, robot.chain.params_nominal, np.array([3e-3]))
    np.testing.assert_allclose(pose[:3, 3], [1e-3, 1e-2, 1.005])


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('name = "tiny"', "name = 3", "name must be a text"),
        ("sheth_uicker", "dh", "convention 'dh' is not known"),
        ("[link2]", "[link3]", "table or key link2|table or key link3"),
        ("z_m = { design = 1.0 }", "", "link1 needs exactly one of z_m, z_cm, z_mm"),
        ("z_m = { design = 1.0 }", "z_m = { design = 1.0 }\nz_cm = { design = 1.0 }", "exactly one of z_m"),
        ("z_m = { design = 1.0 }", "z = { design = 1.0 }", "link1 needs exactly one of z_m"),
        ("z_m = { design = 1.0 }", "z_m = 1.0", "link1.z_m must be a table"),
        ("z_m = { design = 1.0 }", "z_m = { design = inf }", "link1.z_m.design must be a finite number"),
        ("z_m = { design = 1.0 }", "z_m = { design = true }", "must be a finite number"),
        ("z_m = { design = 1.0 }", "z_m = { other = 1.0 }", "same sets of values"),
        ("z_m = { design = 1.0 }", "z_m = { design = 1.0, held = 1 }", "held must be true or false"),
        ("z_m = { design = 1.0 }", "z_m = { design = 1.0 }\nweight = 3", "unknown key link1.weight"),
        ('nominal = "design"', 'nominal = "drawing"', "'drawing' among them"),
        ("prismatic", "ball", "joint1.kind is 'ball'"),
        ("upper_mm = 5.0", "upper_mm = -5.0", "not below"),
        ("upper_mm = 5.0", "upper_deg = 5.0", "joint1 needs exactly one of upper_m"),
        ("[joint1]", "[joint1", "not valid TOML"),
    ],
)
def test_a_file_with_a_hole_is_one_clear_line(old, new, says):
    with pytest.raises(RobotError, match=says) as caught:
        parse_robot(TINY.replace(old, new, 1))
    assert "\n" not in str(caught.value)


def test_unknown_robot_and_oversized_file():
    with pytest.raises(RobotError, match="no built-in robot"):
        builtin_robot("../x")
    with pytest.raises(RobotError, match="limit"):
        parse_robot("#" * 2_000_000)
    with pytest.raises(RobotError, match="TOML"):
        parse_robot("a = " + "[" * 100_000)


def test_sheth_uicker_checks_its_numbers():
    joints = (Joint("j", "revolute", -1.0, 1.0),)
    with pytest.raises(RobotError, match="14 parameters"):
        chain_from_sheth_uicker("r", joints, np.zeros(13))
    with pytest.raises(RobotError, match=r"joint1\.gain is not finite"):
        chain_from_sheth_uicker("r", joints, np.where(np.arange(14) == 7, np.nan, 0.0))
