"""Rotations in plain numbers, held against SciPy's."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from truearm.files.programs.rotations import (
    of_quaternion,
    of_vector,
    quaternion_of_angles,
    quaternion_of_tool_angles,
    transposed,
)

ROUNDING = 1e-14  # of a few dozen operations on numbers up to 1, in double precision
RNG = np.random.default_rng(0)
ANGLES = [
    *RNG.normal(scale=3.0, size=(50, 3)),
    [0.0, 0.0, 0.0],
    [1e-9, 0.0, 0.0],
    [0.0, np.pi, 0.0],
    [0.5, np.pi / 2, 0.5],
]


def same(nine, rotation):
    np.testing.assert_allclose(np.reshape(nine, (3, 3)), rotation.as_matrix(), atol=ROUNDING)


@pytest.mark.parametrize("three", ANGLES)
def test_rotations_are_those_of_scipy(three):
    vector = of_vector(*three)
    same(vector, Rotation.from_rotvec(three))
    same(transposed(vector), Rotation.from_rotvec(three).inv())
    same(of_quaternion(*quaternion_of_angles(*three)), Rotation.from_euler("ZYX", three))
    same(of_quaternion(*quaternion_of_tool_angles(*three)), Rotation.from_euler("XYZ", three))
