"""Rotation vectors: axioms, the logarithm at every angle, the left Jacobian against central differences."""

import numpy as np
import pytest

from truearm.model.transforms import elementary, left_jacobian, pose_of, rotation, rotation_vector, six_of, skew, turned

ANGLES = [0.0, 1e-12, 1e-6, 0.3, 0.32, 1.0, 2.0, 3.0, np.pi - 1e-6, np.pi - 1e-12]


def vectors(angle, n=50):
    axes = np.random.default_rng(0).normal(size=(n, 3))
    axes[:3] = np.eye(3)
    return angle * axes / np.linalg.norm(axes, axis=1)[:, None]


@pytest.mark.parametrize("angle", ANGLES)
def test_exponential_and_logarithm(angle):
    v = vectors(angle)
    rot = rotation(v)
    # Entries of order 1 after some ten roundings.
    np.testing.assert_allclose(rot @ np.swapaxes(rot, 1, 2), np.broadcast_to(np.eye(3), rot.shape), atol=4e-15)
    np.testing.assert_allclose(np.linalg.det(rot), 1.0, atol=4e-15)
    np.testing.assert_allclose((rot @ v[..., None])[..., 0], v, atol=4e-15)
    np.testing.assert_allclose(rotation_vector(rot), v, atol=4e-15)


def test_a_quarter_turn_and_the_cross_product():
    np.testing.assert_allclose(
        rotation(np.array([0.0, 0.0, np.pi / 2])), [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=2e-16
    )
    np.testing.assert_allclose(rotation_vector(np.diag([1.0, -1.0, -1.0])), [np.pi, 0.0, 0.0], atol=1e-15)
    v, w = np.random.default_rng(1).normal(size=(2, 5, 3))
    np.testing.assert_allclose((skew(v) @ w[..., None])[..., 0], np.cross(v, w), atol=1e-15)


@pytest.mark.parametrize("angle", [*ANGLES, 5.0])
def test_the_left_jacobian_is_the_turn_about_the_base_axes(angle):
    v = vectors(angle)
    h = 1e-6
    for k, unit in enumerate(np.eye(3)):
        turn = rotation(v + h * unit) @ np.swapaxes(rotation(v - h * unit), 1, 2)
        # Truncation h²/6 and rounding 1e-16/h.
        np.testing.assert_allclose(left_jacobian(v)[:, :, k], rotation_vector(turn) / (2 * h), atol=2e-9)


@pytest.mark.parametrize("angle", ANGLES[1:])
def test_a_turn_about_one_axis_keeps_that_axis(angle):
    """However large: the axis of a device does not move when it rolls about it."""
    v = vectors(angle)
    axis = np.cross(v, [0.3, -0.5, 0.8])
    axis /= np.linalg.norm(axis, axis=1)[:, None]
    device = np.swapaxes(rotation(v), 1, 2) @ axis[..., None]  # the axis as the device has it
    change = np.linalg.solve(left_jacobian(v), 0.7 * axis[..., None])[..., 0]
    after = rotation(turned(v, change))
    np.testing.assert_allclose((after @ device)[..., 0], axis, atol=1e-14)
    rolled = after @ np.swapaxes(rotation(v), 1, 2)
    np.testing.assert_allclose(np.trace(rolled, axis1=1, axis2=2), 1.0 + 2.0 * np.cos(0.7), atol=1e-14)


@pytest.mark.parametrize("turn", [(0.0, np.pi / 2, 0.0), (0.0, -np.pi / 2, 0.0), (0.3, -0.5, 0.8)])
def test_six_numbers_give_a_pose_back_also_where_two_axes_of_three_align(turn):
    pose = pose_of(np.ones((1, 3)), np.array([turn]))[0]
    *place, alpha, beta, gamma = six_of(pose)
    assert place == [1.0, 1.0, 1.0]
    again = elementary("rz", alpha) @ elementary("ry", beta) @ elementary("rx", gamma)
    np.testing.assert_allclose(again[:3, :3], pose[:3, :3], atol=1e-9)
