"""Position errors of the end, computed from covariances."""

import numpy as np
import pytest
from puma_bench import CHAIN, DESIGN, random_poses

from truearm.estimate.uncertainty import tolerance_error
from truearm.model.chain import Chain, point_forward
from truearm.model.chain_structure import Joint, Parameter
from truearm.model.transforms import Element


def two_links():
    """Return a planar arm, 0.4 and 0.3 m, whose errors are known in closed form."""
    parameters = (Parameter("o1", "rad", 0.0, "offset", 0), Parameter("a1", "m", 0.4), Parameter("a2", "m", 0.3))
    elements = (Element("rz", joint=0), Element("tx", parameter=1), Element("rz", joint=1), Element("tx", parameter=2))
    joints = tuple(Joint(f"j{i}", "revolute", -3.0, 3.0) for i in (1, 2))
    return Chain("planar", elements, parameters, joints)


def test_tolerances_of_a_planar_arm_by_hand():
    """Stretched along x: an angle error moves the end sideways by 0.7 m, lengths along x, nothing along z."""
    error = tolerance_error(
        two_links(), np.array([1e-3, 2e-4, 1e-4]), np.array([[0.0, 0.0], [0.0, np.pi / 2]]), np.zeros(3)
    )
    assert error[0] == pytest.approx(np.sqrt(5e-8 + 0.49e-6))
    assert error[0] > error[1]  # stretched out, the arm has its longest lever


def test_prediction_is_the_spread_of_sampled_robots():
    rng = np.random.default_rng(0)
    sigma = np.where([p.unit == "m" for p in CHAIN.parameters], 1e-5, 2e-5)
    q, tool = random_poses(40, rng), np.array([0.01, 0.02, 0.1])
    error = tolerance_error(CHAIN, sigma, q, tool)
    runs = 1000
    ends = np.array([point_forward(CHAIN, DESIGN + sigma * rng.normal(size=54), q, tool) for _ in range(runs)])
    moved = ends - point_forward(CHAIN, DESIGN, q, tool)
    # The mean square of a norm with up to three unequal components has a relative standard error ≤ sqrt(2/runs).
    ratio = (moved**2).sum(axis=2).mean(axis=0) / error**2
    np.testing.assert_allclose(ratio, 1.0, atol=4.5 * np.sqrt(2 / runs))
