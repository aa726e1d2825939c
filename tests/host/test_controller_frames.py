"""A controller's base and flange, by the frame names of ROS's descriptions and of truearm's robots."""

import numpy as np
import pytest

from truearm.correct.controller_frames import base_of, flange_of

X, Y, Z = np.eye(3)


def test_universal_robots_base_is_half_a_turn_from_base_link():
    """A point in front of base_link is behind the controller's base, at the same height."""
    base = base_of("urscript", "base_link", brought=False)
    np.testing.assert_allclose(base.pose[:3, :3] @ X, -X, atol=1e-15)
    np.testing.assert_allclose(base.pose[:3, :3] @ Z, Z, atol=1e-15)
    np.testing.assert_array_equal(base.pose[:3, 3], 0.0)
    assert "half a turn" in base.words


@pytest.mark.parametrize("language", ["urscript", "rapid"])
def test_ros_flange_points_with_x_where_tool0_points_with_z(language):
    """REP 199; the two differ by a rotation alone."""
    flange = flange_of(language, "flange", brought=False)
    np.testing.assert_allclose(flange.pose[:3, :3] @ Z, X, atol=1e-15)
    np.testing.assert_allclose(np.linalg.det(flange.pose[:3, :3]), 1.0)
    np.testing.assert_array_equal(flange.pose[:3, 3], 0.0)


def test_universal_robots_tool0_in_the_flange_of_ur_description():
    """Its joint flange-tool0 turns by rpy (90°, 0, 90°): tool0's x is the flange's y."""
    flange = flange_of("urscript", "flange", brought=False)
    np.testing.assert_allclose(flange.pose[:3, :3] @ X, Y, atol=1e-15)


@pytest.mark.parametrize("language", ["urscript", "rapid"])
def test_frames_that_are_the_controllers_own(language):
    """A robot that is not a URDF is described in the controller's own frames, whose flange has z out of it."""
    for frame in (
        base_of(language, "base", True),
        flange_of(language, "flange", True),
        flange_of(language, "tool0", False),
    ):
        np.testing.assert_array_equal(frame.pose, np.eye(4))


@pytest.mark.parametrize("language", ["urscript", "rapid"])
@pytest.mark.parametrize("name", ["world", "ee_link", "chuck_fixture", "link_6", ""])
def test_a_name_that_says_nothing_is_not_guessed_at(language, name):
    for brought in (False, True):
        assert base_of(language, name, brought) is None
        assert flange_of(language, name, brought) is None
