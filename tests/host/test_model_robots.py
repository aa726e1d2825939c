"""The built-in robots: poses compared with products of exponentials, URDFs and other programs; numbers of identifiable parameters."""

from pathlib import Path

import numpy as np
import pytest
from rank_bench import random_joints, rank_and_gap, sensitivity

from truearm.model.chain import forward
from truearm.model.robot_file import builtin_names, builtin_robot
from truearm.model.urdf import chain_from_urdf

MUKCA = Path(__file__).parents[1] / "data" / "mukca"
X, Y, Z = np.eye(3)
RX90 = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
TOOL0 = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])


def universal(d1, a2, a3, d4, d5, d6):
    """Axes of an arm stretched along −x: shoulder, elbow and wrist 1 about −y, wrist 2 about −z, wrist 3 about −y."""
    reach = a2 + a3
    axes = [(Z, (0, 0, 0)), (-Y, (0, 0, d1)), (-Y, (-a2, 0, d1)), (-Y, (-reach, 0, d1))]
    axes += [(-Z, (-reach, -d4, d1)), (-Y, (-reach, -d4, d1 - d5))]
    return axes, (-reach, -d4 - d6, d1 - d5), RX90


# Axis (direction, a point on it) of every joint at q = 0 and the end frame there, read off the makers' drawings [m].
DRAWINGS = {
    "ulb": (
        [(Z, (0, 0, 0)), (Y, (0, 0, 0)), (Y, (0.35, 0, 0)), (Z, (0.35, 0, 0)), (Y, (0.35, 0, 0.35)), (Z, (0.35, 0, 0))],
        (0.35, 0, 0.45),
        np.eye(3),
    ),
    "irb120": (
        [
            (Z, (0, 0, 0)),
            (Y, (0, 0, 0.29)),
            (Y, (0, 0, 0.56)),
            (X, (0, 0, 0.63)),
            (Y, (0.302, 0, 0.63)),
            (X, (0, 0, 0.63)),
        ],
        (0.374, 0, 0.63),
        TOOL0,
    ),
    "ur5e": universal(0.1625, 0.425, 0.3922, 0.1333, 0.0997, 0.0996),
    "ur10e": universal(0.1807, 0.6127, 0.57155, 0.17415, 0.11985, 0.11655),
    "iiwa14": (
        [
            *((Z, (0, 0, 0)), (Y, (0, 0, 0.36)), (Z, (0, 0, 0)), (-Y, (0, 0, 0.78)), (Z, (0, 0, 0))),
            *((Y, (0, 0, 1.18)), (Z, (0, 0, 0))),
        ],
        (0, 0, 1.306),
        np.eye(3),
    ),
}


def turned_about(axis, point, angle):
    """Rodrigues' rotation by angle about a line."""
    k = np.cross(np.eye(3), axis)  # k @ v = axis × v
    out = np.eye(4)
    out[:3, :3] = np.eye(3) + np.sin(angle) * k + (1.0 - np.cos(angle)) * k @ k
    out[:3, 3] = np.asarray(point) - out[:3, :3] @ np.asarray(point)
    return out


def by_exponentials(name, q):
    axes, p_home, rot_home = DRAWINGS[name]
    pose = np.eye(4)
    for (axis, point), angle in zip(axes, q, strict=True):
        pose = pose @ turned_about(axis, point, angle)
    home = np.eye(4)
    home[:3, :3], home[:3, 3] = rot_home, p_home
    return pose @ home


@pytest.mark.parametrize("name", DRAWINGS)
def test_poses_of_the_drawing(name):
    chain = builtin_robot(name).chain
    q = np.concatenate([np.zeros((1, len(chain.joints))), random_joints(chain, 20, np.random.default_rng(11))])
    expected = np.stack([by_exponentials(name, one) for one in q])
    np.testing.assert_allclose(forward(chain, chain.params_nominal, q), expected, atol=1e-14)  # rounding of 14 factors


# Joints of the makers' public URDFs from the base: origin xyz [m] and rpy [deg], axis; the last one, fixed, is the end frame.
# Angles are the quarter turns for which the files write 1.5708 or 1.57079.
PUBLIC = {
    # UniversalRobots/Universal_Robots_ROS2_Description, config/ur3e/default_kinematics.yaml, from "base" to "tool0"
    "ur3e": [
        *(((0, 0, 0.15185), (0, 0, 0), Z), ((0, 0, 0), (90, 0, 0), Z), ((-0.24355, 0, 0), (0, 0, 0), Z)),
        *(((-0.2132, 0, 0.13105), (0, 0, 0), Z), ((0, -0.08535, 0), (90, 0, 0), Z)),
        ((0, 0.0921, 0), (90, 180, 180), Z),
    ],
    # frankaemika/franka_description, robots/fr3/kinematics.yaml, from fr3_link0 to fr3_link8
    "fr3": [
        *(((0, 0, 0.333), (0, 0, 0), Z), ((0, 0, 0), (-90, 0, 0), Z), ((0, -0.316, 0), (90, 0, 0), Z)),
        *(((0.0825, 0, 0), (90, 0, 0), Z), ((-0.0825, 0.384, 0), (-90, 0, 0), Z), ((0, 0, 0), (90, 0, 0), Z)),
        *(((0.088, 0, 0), (90, 0, 0), Z), ((0, 0, 0.107), (0, 0, 0), None)),
    ],
    # xArm-Developer/xarm_ros2, xarm_description/urdf/xarm6/xarm6.urdf.xacro
    "xarm6": [
        *(((0, 0, 0.267), (0, 0, 0), Z), ((0, 0, 0), (-90, 0, 0), Z), ((0.0535, -0.2845, 0), (0, 0, 0), Z)),
        *(((0.0775, 0.3425, 0), (-90, 0, 0), Z), ((0, 0, 0), (90, 0, 0), Z), ((0.076, 0.097, 0), (-90, 0, 0), Z)),
    ],
    # ros-industrial/abb, abb_irb1600_support/urdf/irb1600_6_12_macro.xacro
    "irb1600": [
        *(((0, 0, 0), (0, 0, 0), Z), ((0.15, 0, 0.4865), (0, 0, 0), Y), ((0, 0, 0.475), (0, 0, 0), Y)),
        *(((0.3, 0, 0), (0, 0, 0), X), ((0.3, 0, 0), (0, 0, 0), Y), ((0.065, 0, 0), (0, 0, 0), X)),
        ((0, 0, 0), (0, 90, 0), None),
    ],
    # ros-industrial/kuka_experimental, kuka_kr6_support/urdf/kr6r900sixx_macro.xacro
    "kr6": [
        *(((0, 0, 0.4), (0, 0, 0), -Z), ((0.025, 0, 0), (0, 0, 0), Y), ((0.455, 0, 0), (0, 0, 0), Y)),
        *(((0, 0, 0.035), (0, 0, 0), -X), ((0.42, 0, 0), (0, 0, 0), Y), ((0.08, 0, 0), (0, 0, 0), -X)),
        ((0, 0, 0), (0, 90, 0), None),
    ],
}


def by_urdf(joints, q):
    """Return the product of the joints' origins and rotations."""
    pose, angles = np.eye(4), iter(q)
    for xyz, (roll, pitch, yaw), axis in joints:
        pose[:3, 3] += pose[:3, :3] @ xyz
        for turn, angle in ((Z, np.radians(yaw)), (Y, np.radians(pitch)), (X, np.radians(roll))):
            pose = pose @ turned_about(turn, np.zeros(3), angle)
        if axis is not None:
            pose = pose @ turned_about(axis, np.zeros(3), next(angles))
    return pose


@pytest.mark.parametrize("name", PUBLIC)
def test_poses_of_the_public_urdf(name):
    chain = builtin_robot(name).chain
    q = np.concatenate([np.zeros((1, len(chain.joints))), random_joints(chain, 20, np.random.default_rng(17))])
    expected = np.stack([by_urdf(PUBLIC[name], posture) for posture in q])
    np.testing.assert_allclose(forward(chain, chain.params_nominal, q), expected, atol=1e-12)


# Positions [mm] that other programs give for joint angles [deg], printed to 0.1 or 0.001 mm.
ELSEWHERE = [
    # a public test of another program for the IRB 120, which holds a robot simulator's figures
    ("irb120", (30, -45, 20, 40, -30, 60), (96.492, 28.990, 723.337), 0.001),
    ("irb120", (150, -100, 65, -150, -100, 350), (11.445, -47.546, 416.203), 0.001),
    # public tests of other programs; the UR5e's zero pose is MuJoCo's, too
    ("ur5e", (0, -90, 90, -90, -90, 0), (-491.9, -133.3, 487.9), 0.1),
    ("ur5e", (0, 0, 0, 0, 0, 0), (-817.2, -232.9, 62.8), 0.1),
    ("ur10e", (0, 0, 0, 0, 0, 0), (-1184.25, -290.7, 60.85), 0.01),
    # Table II of Goswami et al. evaluated with a separate implementation
    ("puma560", (0, 0, 0, 0, 0, 0), (411.48, 149.09, 1149.72), 0.01),
    ("puma560", (0, -90, 90, 0, 0, 0), (-20.32, 149.09, 1581.52), 0.01),
]


@pytest.mark.parametrize(("name", "q_deg", "p_mm", "digit_mm"), ELSEWHERE)
def test_poses_of_other_programs(name, q_deg, p_mm, digit_mm):
    chain = builtin_robot(name).chain
    p_base_end = 1e3 * forward(chain, chain.params_nominal, np.radians(q_deg))[:3, 3]
    np.testing.assert_allclose(p_base_end, p_mm, atol=0.51 * digit_mm)  # half a digit, and the rounding of the test


def with_values(chain, **changes):
    params = chain.params_nominal.copy()
    for name, value in changes.items():
        params[chain.parameter_names.index(name.replace("_", "."))] = value
    return params


@pytest.mark.parametrize(
    ("name", "file", "tip", "changes"),
    [
        ("panda", "panda.urdf", "panda_link8", {}),
        # kuka_experimental, where this URDF is from, sets axes 2 and 3 back by 0.436 mm; iiwa_stack does not
        ("iiwa14", "iiwa14.urdf", "tool0", {"joint1_a": -0.00043624, "joint3_a": 0.00043624}),
    ],
)
def test_the_rows_agree_with_the_urdf(name, file, tip, changes):
    robot, urdf = builtin_robot(name).chain, chain_from_urdf((MUKCA / file).read_text("utf-8"), tip=tip)
    q = random_joints(robot, 50, np.random.default_rng(12))
    expected = forward(urdf, urdf.params_nominal, q)
    np.testing.assert_allclose(forward(robot, with_values(robot, **changes), q), expected, atol=1e-9)
    limits = [[(j.lower, j.upper) for j in chain.joints] for chain in (robot, urdf)]
    np.testing.assert_allclose(limits[0], limits[1], atol=np.radians(0.02))  # the URDF writes 169.985° for 170°


@pytest.mark.parametrize(
    ("name", "lower_deg", "upper_deg"),
    [
        ("irb120", (-165, -110, -110, -160, -120, -400), (165, 110, 70, 160, 120, 400)),
        ("ur5e", (-360, -360, -180, -360, -360, -360), (360, 360, 180, 360, 360, 360)),
        ("ur10e", (-360, -360, -180, -360, -360, -360), (360, 360, 180, 360, 360, 360)),
        ("ur3e", (-360, -360, -180, -360, -360, -360), (360, 360, 180, 360, 360, 360)),
        (
            "fr3",
            np.degrees((-2.7437, -1.7837, -2.9007, -3.0421, -2.8065, 0.5445, -3.0159)),
            np.degrees((2.7437, 1.7837, 2.9007, -0.1518, 2.8065, 4.5169, 3.0159)),
        ),
        ("irb1600", (-180, -63, -235, -200, -115, -400), (180, 110, 55, 200, 115, 400)),
        ("kr6", (-170, -190, -120, -185, -120, -350), (170, 45, 156, 185, 120, 350)),
    ],
)
def test_limits(name, lower_deg, upper_deg):
    joints = builtin_robot(name).chain.joints
    np.testing.assert_allclose([j.lower for j in joints], np.radians(lower_deg))
    np.testing.assert_allclose([j.upper for j in joints], np.radians(upper_deg))


@pytest.mark.parametrize("name", builtin_names())
def test_what_a_full_pose_sees_is_free_by_default_and_the_source_is_named(name):
    # N = 5·n_r + 3·n_p + 6 (Goswami et al., (1)) with every offset, gain, base and tool constant free.
    chain = builtin_robot(name).chain
    q = random_joints(chain, 60, np.random.default_rng(13))
    rank, gap = rank_and_gap(sensitivity(chain, chain.params_nominal, q))
    assert all(joint.kind == "revolute" for joint in chain.joints)
    assert rank == 5 * len(chain.joints) + 6
    assert gap > 1e10
    robot = builtin_robot(name)
    gains = np.array([p.unit == "1" for p in robot.chain.parameters])
    assert (robot.free & gains).sum() == (6 if name == "puma560" else 0)  # Table II identifies the PUMA's
    complete = robot.free | gains
    q = random_joints(robot.chain, 60, np.random.default_rng(14))
    singular = np.linalg.svd(sensitivity(robot.chain, robot.chain.params_nominal, q)[:, complete], compute_uv=False)
    assert complete.sum() == 5 * len(robot.chain.joints) + 6
    assert singular[-1] > 1e-2 * singular[0]  # as well conditioned as a choice among equals can be: 5 to 25 measured
    robot = builtin_robot(name)
    assert robot.chain.name == name
    assert len(robot.source) > 20
    assert all(joint.upper - joint.lower > 1.0 for joint in robot.chain.joints)
