"""A controller's base and flange, by the frame names of ROS's descriptions and of truearm's robots."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from truearm.correct.programs.languages import base_of, flange_of
from truearm.model.robot_file import RobotChoice, load_robot
from truearm.workflows.correct import tool0_in_flange

X, Y, Z = np.eye(3)


def test_universal_robots_base_is_half_a_turn_from_base_link():
    """A point in front of base_link is behind the controller's base, at the same height."""
    base = base_of("urscript", "base_link")
    np.testing.assert_allclose(base.pose[:3, :3] @ X, -X, atol=1e-15)
    np.testing.assert_allclose(base.pose[:3, :3] @ Z, Z, atol=1e-15)
    np.testing.assert_array_equal(base.pose[:3, 3], 0.0)
    assert "base_link" in base.words


@pytest.mark.parametrize(("language", "x"), [("urscript", Y), ("rapid", -Z)])
def test_ros_flange_points_with_x_where_tool0_points_with_z(language, x):
    """REP 199; the two differ by a rotation alone. UR's description turns by rpy (90°, 0, 90°): tool0's x is the flange's y."""
    flange = flange_of(language, "flange", brought=False)
    np.testing.assert_allclose(flange.pose[:3, :3] @ np.array([X, Z]).T, np.array([x, X]).T, atol=1e-15)
    np.testing.assert_allclose(np.linalg.det(flange.pose[:3, :3]), 1.0)
    np.testing.assert_array_equal(flange.pose[:3, 3], 0.0)


@pytest.mark.parametrize("language", ["urscript", "rapid"])
def test_frames_that_are_the_controllers_own(language):
    """A robot that is not a URDF is described in the controller's own frames, whose flange has z out of it."""
    for frame in (
        base_of(language, "base"),
        flange_of(language, "flange", True),
        flange_of(language, "tool0", False),
    ):
        np.testing.assert_array_equal(frame.pose, np.eye(4))


@pytest.mark.parametrize("language", ["urscript", "rapid"])
@pytest.mark.parametrize("name", ["world", "ee_link", "chuck_fixture", "link_6", ""])
def test_a_name_that_says_nothing_is_not_guessed_at(language, name):
    for brought in (False, True):
        assert base_of(language, name) is None
        assert flange_of(language, name, brought) is None


@pytest.mark.parametrize("has_tool0", [True, False])
@pytest.mark.parametrize("rpy", [(0.0, 0.0, 0.0), (0.0, np.pi / 2, 0.0), (0.7, 0.0, 0.0)])
def test_the_geometry_of_a_urdf_decides_what_its_flange_is(tmp_path, rpy, has_tool0):
    """tool0 in the file is the controller's; otherwise x must point out of a flange, or its pose is asked for."""
    fixed = [("flange", rpy), *([("tool0", (0.0, np.pi / 2, 0.0))] if has_tool0 else [])]
    links = "".join(f'<link name="{name}"/>' for name in ("base", "link", *(name for name, _ in fixed)))
    joint = '<joint name="j" type="revolute"><parent link="base"/><child link="link"/><axis xyz="1 0 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
    for name, angles in fixed:
        origin = f'<origin rpy="{" ".join(map(str, angles))}"/>'
        joint += f'<joint name="to_{name}" type="fixed"><parent link="link"/><child link="{name}"/>{origin}</joint>'
    path = tmp_path / "robot.urdf"
    path.write_text(f'<robot name="r">{links}{joint}</robot>')
    pose = tool0_in_flange(RobotChoice(str(path), "base", "flange"), load_robot(str(path), "base", "flange").chain)
    turn = Rotation.from_euler("xyz", rpy)
    assert (pose is not None) == has_tool0
    if pose is not None:
        np.testing.assert_allclose(turn.as_matrix() @ pose[:3, :3] @ Z, X, atol=1e-12)
    assert (flange_of("rapid", "flange", False, turn.inv().apply(X)) is None) == bool(rpy[1])
