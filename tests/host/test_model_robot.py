"""Robot files: the built-in PUMA 560, the four conventions, and refusal of incomplete files."""

import numpy as np
import pytest
from tests.refusals import refused

from truearm.errors import RobotError
from truearm.model.chain import forward
from truearm.model.chain_structure import Joint
from truearm.model.robot import parse_robot
from truearm.model.robot_file import builtin_names, builtin_robot, builtin_text, names_with_branch

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


def test_unknown_robot_and_oversized_file():
    with refused("wrong-value", place="built-in robot"):
        builtin_robot("../x")
    with pytest.raises(RobotError, match="limit"):
        parse_robot("#" * 2_000_000)
    with pytest.raises(RobotError, match="TOML"):
        parse_robot("a = " + "[" * 100_000)
    with pytest.raises(RobotError, match="65 joints"):
        parse_robot(TINY + "\n".join(f"[joint{i}]" for i in range(2, 66)))


DH = """
name = "two"
convention = "dh"
source = "made up"
nominal = "design"
base_frame = "base"
end_frame = "end"
[joint1]
kind = "revolute"
lower_deg = -90.0
upper_deg = 90.0
offset_deg = { design = 10.0, measured = 11.0 }
gain = { design = -1.0, measured = -1.01, held = true }
d_mm = 100
a_mm = { design = 300.0, measured = 301.0 }
alpha_deg = { design = 0.0, measured = 0.1 }
beta_deg = { design = 0.0, measured = 0.2 }
[joint2]
kind = "prismatic"
lower_mm = 0.0
upper_mm = 200.0
theta_deg = { design = 90.0, measured = 90.0 }
offset_mm = { design = 50.0, measured = 50.0 }
a_cm = { design = 20.0, measured = 20.0 }
alpha_deg = { design = 180.0, measured = 180.0 }
"""


def test_numbers_are_constants_and_tables_parameters_in_both_forms():
    robot = parse_robot(DH)
    joint1 = ("joint1.offset", "joint1.gain", "joint1.a", "joint1.alpha", "joint1.beta")
    assert robot.chain.parameter_names == (*joint1, "joint2.theta", "joint2.offset", "joint2.a", "joint2.alpha")
    assert [p.unit for p in robot.chain.parameters] == ["rad", "1", "m", "rad", "rad", "rad", "m", "m", "rad"]
    assert robot.source == "made up"
    assert robot.free.tolist() == [True, False] + [True] * 7
    assert robot.parameter_sets["measured"][2] == pytest.approx(0.301)
    # joint 2 has no gain, so it is 1; joint 1 turns against its reading: 10° − 40° = −30°
    pose = forward(robot.chain, robot.chain.params_nominal, np.array([np.radians(40.0), 0.02]))
    c, s = np.cos(np.pi / 6), np.sin(np.pi / 6)
    np.testing.assert_allclose(pose[:3, 3], [0.3 * c + 0.2 * s, -0.3 * s + 0.2 * c, 0.17], atol=1e-15)
    robot = parse_robot(DH.replace('"dh"', '"modified_dh"'))
    joint1 = ("joint1.beta", "joint1.alpha", "joint1.a", "joint1.offset", "joint1.gain")
    assert robot.chain.parameter_names == (*joint1, "joint2.alpha", "joint2.a", "joint2.theta", "joint2.offset")
    # x of joint 1 lies 0.3 along the base's, y and z of joint 2 are turned over
    pose = forward(robot.chain, robot.chain.params_nominal, np.array([np.radians(10.0), 0.02]))
    np.testing.assert_allclose(pose[:3, 3], [0.5, 0.0, 0.1 - 0.07], atol=1e-15)
    robot = parse_robot(TINY.replace("z_m = { design = 1.0 }", "z_m = 1.0"))
    assert "link1.z" not in robot.chain.parameter_names
    pose = forward(robot.chain, robot.chain.params_nominal, np.array([3e-3]))
    np.testing.assert_allclose(pose[:3, 3], [1e-3, 1e-2, 1.005])
    fixed = "".join(line.split("{")[0] + "0.0\n" if "{" in line else line for line in DH.splitlines(keepends=True))
    with pytest.raises(RobotError, match="joint1: gain: must be"):
        parse_robot(fixed)
    with pytest.raises(RobotError, match="no parameter can be identified"):
        parse_robot(fixed.replace("gain = 0.0\n", ""))


BY_HAND = """
name = "hand"
convention = "elementary"
nominal = "design"
base_frame = "floor"
end_frame = "pen"
[[transform]]
motion = "tz"
name = "column.height"
amount_mm = { design = 500.0, held = true }
[[transform]]
motion = "rx"
amount_deg = -90.0
[[transform]]
motion = "rz"
joint = "swing"
lower_deg = -170.0
upper_deg = 170.0
offset_deg = { design = 0.0 }
gain = { design = 1.0 }
[[transform]]
motion = "tx"
joint = "slide"
lower_mm = 0.0
upper_mm = 400.0
"""


def test_transforms_by_hand():
    robot = parse_robot(BY_HAND)
    assert robot.chain.parameter_names == ("column.height", "swing.offset", "swing.gain")
    assert robot.free.tolist() == [False, True, True]
    assert robot.chain.joints[1] == Joint("slide", "prismatic", 0.0, 0.4)
    assert (robot.chain.base_frame, robot.chain.end_frame, robot.source) == ("floor", "pen", "")
    pose = forward(robot.chain, robot.chain.params_nominal, np.array([np.pi / 2, 0.3]))
    np.testing.assert_allclose(pose[:3, 3], [0.0, 0.0, 0.2], atol=1e-15)  # swung downwards


ARM = builtin_text("irb120")


BROKEN = [
    (TINY, 'name = "tiny"', 'name = "a\\nb"', r"name: 'a\\nb'"),
    (TINY, 'name = "tiny"', "", "robot file: needs name"),
    (TINY, 'name = "tiny"', 'name = "tiny"\ngravity = [0, 0, 0]', "gravity: must not be zero"),
    (TINY, "sheth_uicker", "hayati", "'sheth_uicker', 'dh', 'modified_dh', 'elementary'"),
    (TINY, "[link2]", "[link3]", "unknown key 'link3'.* link2"),
    (TINY, "z_m = { design = 1.0 }", 'z_m = "1.0"', "link1: z_m: '1.0'"),
    (TINY, "z_m = { design = 1.0 }", "z_m = { design = 1000 }", "unit right"),
    (TINY, "z_m = { design = 1.0 }", "z_m = { design = true }", "design: true"),
    (TINY, "z_m = { design = 1.0 }", "z_m = { design = 1.0, held = 1 }", "link1: z_m: held: 1"),
    (TINY, "z_m = { design = 1.0 }", "z_m = {}", "link1.z:"),
    (TINY, "z_m = { design = 1.0 }", "z_m = { other = 1.0 }", r"link1.z: .*'design'.*\(design, other\)"),
    (TINY, 'nominal = "design"', 'nominal = "drawing"', "no value 'drawing'"),
    (TINY, "prismatic", "ball", "joint1: kind: 'ball'"),
    (TINY, "gain = { design = 1.0 }", "gain = { design = 0.0 }", "them 0"),
    (TINY, "[joint1]", "[joint2]", "unknown key 'joint2'.* joint1"),
    (TINY, "upper_mm = 5.0", "upper_mm = -5.0", "joint1: .*lower limit"),
    (DH, "d_mm = 100\n", "", r"joint1: needs d_m \(or d_cm, d_mm\)"),
    (DH, "a_cm = { design = 20.0, measured = 20.0 }", "a_cm = { design = 20.0 }", "joint2.a: .*'measured'"),
    (DH, "[joint2]", "[tool]\nx_mm = 0.0\n[joint2]", "tool: needs y_m"),
    (DH, "[joint2]", "[base]\n[joint2]", "base: needs x_m"),
    (DH, 'convention = "dh"', 'convention = "modified dh"', "convention: 'modified dh'"),
    (BY_HAND, 'motion = "tz"', 'motion = "ta"', "transform: item 1: motion: 'ta'"),
    (BY_HAND, 'name = "column.height"\n', "", "transform: item 1:"),
    (BY_HAND, "amount_deg = -90.0", 'name = "x"\namount_deg = -90.0', "transform: item 2:"),
    (BY_HAND, 'name = "column.height"', 'name = "column height"', "transform: item 1: name: 'column height'"),
    (BY_HAND, 'name = "column.height"', 'name = "swing.gain"', "transform: item 3: swing.gain"),
    (BY_HAND, 'joint = "slide"', 'joint = "swing"', "transform: item 4: swing.offset"),
    (BY_HAND, 'joint = "slide"', 'joint = ""', "transform: item 4: joint: ''"),
    (BY_HAND, "lower_deg = -170.0", "lower_deg = 170.0", "transform: item 3: swing: its lower limit"),
    (BY_HAND, 'end_frame = "pen"', 'end_frame = "pen"\n[joint1]', "unknown key 'joint1'"),
    (ARM, "lower_deg = [-155.0, -80.0, -60", "lower_deg = [-60", "branch: .*6 joints, lower .*4"),
    (ARM, "lower_deg = [-155.0, -80.0", "lower_deg = [-155.0, -500.0", "joint2 must lie within its limits"),
    (ARM, "lower_deg = [-155.0, -80.0", "lower_deg = [-155.0, 101.0", "joint2 .* lower below upper"),
    (ARM, "joint = 0", "joint = 7", "capsule: item 1: joint: must be"),
    (ARM, "start_mm = [-100.0, 0.0", "start_mm = [0.0", "capsule: item 1: start_mm: needs"),
]
TRANSFORMS = BY_HAND[BY_HAND.index("[[transform]]") :]
FIXED = '[[transform]]\nmotion = "rx"\namount_rad = 0.0\n'
BROKEN += [
    (BY_HAND, TRANSFORMS, "transform = 3", "transform: needs"),
    (BY_HAND, TRANSFORMS, "transform = []", "transform: needs"),
    (BY_HAND, TRANSFORMS, "transform = [1]", "transform: item 1: must be"),
    (BY_HAND, TRANSFORMS, 1001 * FIXED, "transform: needs"),
    (BY_HAND, TRANSFORMS, FIXED, "0 joints"),
]


@pytest.mark.parametrize(("text", "old", "new", "says"), BROKEN)
def test_a_file_with_a_hole_is_one_clear_line(text, old, new, says):
    assert old in text
    with pytest.raises(RobotError, match=says) as caught:
        parse_robot(text.replace(old, new, 1))
    assert "\n" not in str(caught.value)


def test_what_a_robot_file_need_not_say():
    limits = "lower_deg = -165.0\nupper_deg = 165.0\n"
    assert ARM.count(limits) == 1
    first = parse_robot(ARM.replace(limits, "")).chain.joints[0]
    assert (first.lower, first.upper) == (-np.inf, np.inf)
    with pytest.raises(RobotError, match=r"joint1: .*lower and upper"):
        parse_robot(ARM.replace(limits, limits.splitlines()[0] + "\n"))
    robot = parse_robot(ARM.split("# Branch", 1)[0])
    assert robot.branch is None
    assert robot.capsules is None
    assert parse_robot(TINY).branch is None
    assert names_with_branch() == tuple(name for name in builtin_names() if builtin_robot(name).branch is not None)
    assert {"irb120", "puma560", "ur5e"} <= set(names_with_branch())
