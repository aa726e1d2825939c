"""Position errors of the end, computed from covariances."""

import numpy as np
from puma_bench import CHAIN, DESIGN, random_poses

from truearm.estimate.uncertainty import tolerance_error
from truearm.model.chain import point_forward


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
