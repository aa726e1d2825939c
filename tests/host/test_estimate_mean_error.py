"""The error of poses that were not fitted: the first-order result of leaving poses out equals fits without them."""

from dataclasses import replace

import numpy as np
import pytest
from tests.host.puma_bench import CHAIN, FREE, RIG, SIGMA, TRUTH, lengths, random_table

from truearm.estimate.identify import identify
from truearm.estimate.mean_error import mean_errors


def test_intervals_hold_the_mean_and_count_poses():
    # In 95 % of 2000 draws of 30 poses; the counting's own standard deviation is 0.5 %, the skewness of |normal| costs 1
    # %.
    rng = np.random.default_rng(1)
    inside = 0
    for _ in range(2000):
        of = mean_errors({"m": rng.normal(size=30)}, np.arange(30), held_out=True)["m"]
        inside += of.low <= np.sqrt(2.0 / np.pi) <= of.high
    assert inside / 2000 == pytest.approx(0.95, abs=0.03)
    # Ten rows of each of 20 poses, alike within a pose, say no more than 20 rows.
    rng = np.random.default_rng(0)
    error = np.abs(rng.normal(size=20))
    of_poses = mean_errors({"m": error}, np.arange(20), held_out=True)["m"]
    of_rows = mean_errors({"m": np.repeat(error, 10)}, np.repeat(np.arange(20), 10), held_out=True)["m"]
    assert of_rows == pytest.approx(of_poses)
    assert of_poses.n == 20


def test_each_pose_is_left_out_in_turn():
    """Noise of three times the declared σ: the error of a pose as a fit without it has it."""
    t = random_table(120, np.random.default_rng(2), 3.0 * SIGMA)
    t = replace(t, q=np.repeat(t.q[::3], 3, axis=0))  # three rows a pose
    truth = lengths(TRUTH, t.q, list(zip(t.chuck, t.sphere, strict=True)))
    t = replace(t, value=truth + 3.0 * SIGMA * np.random.default_rng(3).normal(size=120))
    e = identify(CHAIN, RIG, t, free=FREE)
    assert e.chi2_reduced > e.chi2_band[1]
    found = e.unexplained["m"]
    assert (found.n, found.held_out) == (40, False)
    errors = []
    for pose in range(40):
        held = np.arange(120) // 3 == pose
        errors.append(np.abs(identify(CHAIN, RIG, t, free=FREE, hold_out=held).residual["m"][held]).mean())
    assert found.mean == pytest.approx(np.mean(errors), rel=0.02)  # what the linearisation leaves
    judged = identify(CHAIN, RIG, t, free=FREE, hold_out=np.arange(120) < 15)
    assert judged.unexplained["m"].held_out
    assert judged.unexplained["m"].n == 5


def test_explained_residuals_need_no_other_figure():
    assert identify(CHAIN, RIG, random_table(200, np.random.default_rng(4), SIGMA), free=FREE).unexplained == {}
