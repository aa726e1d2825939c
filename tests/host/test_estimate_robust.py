"""Robust losses: their formulas, their covariance, and faults that do not distort the result."""

import numpy as np
import pytest
from fault_worlds import RIG as FAULT_RIG
from fault_worlds import clean, direction, plan, slipped, tool_error
from fault_worlds import lengths as fault_lengths
from fault_worlds import table as fault_table
from puma_bench import CHAIN, FREE, RIG, ROBOT, SIGMA, TRUTH, all_pairs, lengths, random_poses, random_table, table
from scipy import stats

from truearm.estimate.identify import SolverOptions, identify
from truearm.estimate.information import covariance, spectrum
from truearm.estimate.robust import CAUCHY, HUBER, Moments, sandwich, tuning, weigh
from truearm.workflows.identify import IdentifyOptions, identified
from truearm.workflows.inputs import Observed


@pytest.mark.parametrize("loss", ["linear", "huber", "cauchy"])
@pytest.mark.parametrize("width", [1, 3, 6])
def test_weight_is_half_the_slope_of_the_cost_over_the_length(loss, width):
    s, h = np.array([0.01, 0.5, 1.3, 1.4, 2.0, 5.0, 400.0]), 1e-6
    found = weigh(loss, s, width)
    up, down = (weigh(loss, s + d, width) for d in (h, -h))
    np.testing.assert_allclose(found.weight, (up.cost - down.cost) / (4 * h * s), rtol=1e-6)
    np.testing.assert_allclose(found.slope, s * (up.weight - down.weight) / (2 * h), atol=1e-6)
    assert (np.diff(found.weight) <= 0.0).all()


def test_losses_count_small_residuals_and_keep_their_share():
    s = np.array([0.0, 1e-4])
    for loss in ("huber", "cauchy"):
        np.testing.assert_allclose(weigh(loss, s, 1).cost, s**2, rtol=1e-8)
    assert (tuning(HUBER, 1), tuning(CAUCHY, 1)) == pytest.approx((1.345, 2.385))
    for width in (1, 3, 6):
        assert stats.chi.cdf(tuning(HUBER, width), width) == pytest.approx(2 * stats.norm.cdf(1.345) - 1)


@pytest.mark.parametrize("loss", ["huber", "cauchy"])
def test_sandwich_of_rows_that_are_all_far_out_has_the_residuals_own_size(loss):
    """With a wrong rig no row is near: the mean curvature is 0 (Huber) or negative (Cauchy), and σ must not vanish or fail."""
    rng = np.random.default_rng(3)
    jac = rng.normal(size=(60, 4))
    root = np.linalg.qr(jac)[1]
    length = np.full(60, 1e3)
    found = sandwich(root, np.full(4, np.inf), Moments().plus(weigh(loss, length, 1), length, 1), 60)
    expected = 1e6 * 60 / 56 * np.linalg.inv(jac.T @ jac)
    np.testing.assert_allclose(found, expected, rtol=1e-10)


def test_sandwich_of_least_squares_is_its_covariance():
    rng = np.random.default_rng(0)
    root = np.linalg.qr(rng.normal(size=(50, 4)), mode="r")
    clean = weigh("linear", np.ones(50), 1)
    same = sandwich(root, np.full(4, np.inf), Moments().plus(clean, np.ones(50), 1), 50)
    np.testing.assert_allclose(same, covariance(spectrum(root)) * 50 / 46, rtol=1e-10)  # s² is 1, over n − k
    prior = np.array([0.1, np.inf, 2.0, np.inf])
    by_hand = root.T @ root + np.diag([100.0, 0.0, 0.25, 0.0])
    b = by_hand + root.T @ root * (50 / 46 - 1)
    expected = np.linalg.inv(by_hand) @ b @ np.linalg.inv(by_hand)
    np.testing.assert_allclose(sandwich(root, prior, Moments().plus(clean, np.ones(50), 1), 50), expected, atol=1e-12)


@pytest.mark.soak
@pytest.mark.parametrize("loss", ["huber", "cauchy"])
def test_errors_are_as_large_as_the_covariance_says(loss):
    """Monte Carlo with 2 % of the rows off by some 30 σ: NEES as for clean data, where least squares is far outside.

    The faults are symmetric, as the covariance assumes, and b holds what they do.
    """
    rng = np.random.default_rng(1)
    q, pairs = random_poses(300, rng), all_pairs(300)
    truth = lengths(TRUTH, q, pairs)
    nees = {loss: [], "linear": []}
    for _ in range(40):
        noise = rng.normal(size=300)
        noise[rng.integers(0, 300, 6)] += 30.0 * rng.choice([-1.0, 1.0], 6)
        for how, out in nees.items():
            e = identify(CHAIN, RIG, table(q, truth + SIGMA * noise, pairs), free=FREE, options=SolverOptions(loss=how))
            error = (e.value - TRUTH)[FREE]
            out.append(error @ np.linalg.solve(e.covariance[np.ix_(FREE, FREE)], error))
    # Four standard errors of a mean of χ²(36); the covariance itself is estimated from 300 residuals, ±8 %.
    assert abs(np.mean(nees[loss]) - 36.0) < 4 * np.sqrt(2 * 36 / 40) + 0.08 * 36
    assert np.mean(nees["linear"]) > 100.0


def robustly_identified(table, loss, **more):
    options = IdentifyOptions(loss=loss, joint_laws="none", **more)
    return identified(ROBOT, Observed(FAULT_RIG, table), (), options)


@pytest.mark.parametrize("loss", ["huber", "cauchy"])
@pytest.mark.parametrize("size", [2e-3, 20e-3])
def test_gross_rows_neither_widen_the_stated_error_nor_hide_a_fault(loss, size):
    rng = np.random.default_rng(0)
    world = plan()
    gross = rng.random(len(world)) < 0.05
    of_clean = clean(world, rng)
    identification = robustly_identified(of_clean.replace(value=of_clean.value + size * gross), loss)
    assert identification.predicted.rms < 0.1e-3 < 2.0 * tool_error(identification.estimate, world)
    disagreeing = next(finding for finding in identification.findings if finding.code == "outliers")
    assert gross.sum() - 1 <= disagreeing.values["ignored"] <= disagreeing.values["n"] == gross.sum()
    of_slipped, (chuck, _) = slipped(world, rng)
    identification = robustly_identified(of_slipped.replace(value=of_slipped.value + size * gross), loss)
    assert identification.estimate.faults[0].rivals[0].name == f"chuck.{chuck}.step"
    assert tool_error(identification.estimate, world) < 1.5 * identification.predicted.rms


@pytest.mark.parametrize("loss", ["huber", "cauchy"])
def test_one_gross_row_is_no_fault(loss):
    for seed in range(3):
        rng = np.random.default_rng(seed)
        of_clean = clean(plan(), rng)
        value = of_clean.value + 3e-3 * rng.choice([-1.0, 1.0]) * (np.arange(len(of_clean)) == rng.integers(360))
        assert not robustly_identified(of_clean.replace(value=value), loss).estimate.faults


@pytest.mark.parametrize("loss", ["huber", "cauchy"])
def test_wrong_chuck_is_no_set_of_gross_rows(loss):
    rng = np.random.default_rng(1)
    world = plan()
    off = np.where(world.chuck == "c1", 20e-3, 0.0)[:, None] * direction(rng)
    of_wrong = fault_table(world, fault_lengths(world, off) + SIGMA * rng.normal(size=len(world)))
    assert robustly_identified(of_wrong, loss).estimate.unusable


@pytest.mark.parametrize(("loss", "size"), [("huber", 1e-3), ("cauchy", 3e-3)])
def test_a_named_fault_counts_as_far_as_the_loss_followed_it(loss, size):
    """A least-squares fit would follow this chuck by 0.45 and 1.3 mm."""
    rng = np.random.default_rng(0)
    world = plan()
    rows = np.flatnonzero(world.chuck == "c1")
    off = np.zeros((len(world), 3))
    off[rows[-45:]] = size * direction(rng)
    of_wrong = fault_table(world, fault_lengths(world, off) + SIGMA * rng.normal(size=len(world)))
    identification = robustly_identified(of_wrong, loss)
    error = tool_error(identification.estimate, world)
    assert error < identification.predicted.rms < 1.5 * error
    identification = robustly_identified(of_wrong, loss, apply=("mean",))
    assert tool_error(identification.estimate, world) < identification.predicted.rms < 0.12e-3


def test_iterations_count_on_over_the_stages():
    t = random_table(200, np.random.default_rng(3), SIGMA)
    heard = []
    e = identify(CHAIN, RIG, t, free=FREE, options=SolverOptions(loss="cauchy", progress=lambda i, _: heard.append(i)))
    assert heard == list(range(1, e.iterations + 1))
    short = identify(CHAIN, RIG, t, free=FREE, options=SolverOptions(loss="cauchy", max_iterations=2))
    assert (short.status, short.iterations) == ("max_iterations", 6)  # two for each of three stages
    assert short.message.startswith("cauchy loss: 2 iterations ")
    single = identify(CHAIN, RIG, t, free=FREE, options=SolverOptions(max_iterations=1))
    assert single.message.startswith("1 iteration ")
