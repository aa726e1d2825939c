"""Robust losses: their formulas, their covariance, and faults that do not distort the result."""

from dataclasses import replace

import numpy as np
import pytest
from puma_bench import CHAIN, FREE, RIG, SIGMA, TRUTH, all_pairs, lengths, random_poses, random_table, table
from scipy import integrate, stats

from truearm.errors import ProblemError
from truearm.estimate.identify import SolverOptions, identify
from truearm.estimate.information import covariance, spectrum
from truearm.estimate.robust import CAUCHY, HUBER, Moments, sandwich, tuning, weigh


@pytest.mark.parametrize("loss", ["linear", "huber", "cauchy"])
@pytest.mark.parametrize("width", [1, 3, 6])
def test_weight_is_half_the_slope_of_the_cost_over_the_length(loss, width):
    s, h = np.array([0.01, 0.5, 1.3, 1.4, 2.0, 5.0, 400.0]), 1e-6
    found = weigh(loss, s, width)
    up, down = (weigh(loss, s + d, width) for d in (h, -h))
    np.testing.assert_allclose(found.weight, (up.cost - down.cost) / (4 * h * s), rtol=1e-6)
    np.testing.assert_allclose(found.slope, s * (up.weight - down.weight) / (2 * h), atol=1e-6)
    assert (np.diff(found.weight) <= 0.0).all()


def test_small_residuals_count_as_in_least_squares():
    s = np.array([0.0, 1e-4])
    for loss in ("huber", "cauchy"):
        np.testing.assert_allclose(weigh(loss, s, 1).cost, s**2, rtol=1e-8)


def test_tuning_keeps_its_share_of_clean_rows():
    assert (tuning(HUBER, 1), tuning(CAUCHY, 1)) == pytest.approx((1.345, 2.385))
    for width in (1, 3, 6):
        assert stats.chi.cdf(tuning(HUBER, width), width) == pytest.approx(2 * stats.norm.cdf(1.345) - 1)


@pytest.mark.parametrize(("loss", "efficiency"), [("huber", 0.95), ("cauchy", 0.95)])
def test_the_price_on_clean_data_is_five_percent(loss, efficiency):
    """a²/b of the normal distribution: the published 95 % of 1.345 and 2.385, and the moments that sandwich uses."""

    def mean(f):
        return integrate.quad(lambda s: 2 * stats.norm.pdf(s) * f(weigh(loss, np.array([s]), 1), s), 0, 12)[0]

    a = mean(lambda w, _: float(w.weight[0] + w.slope[0]))
    b = mean(lambda w, s: float((w.weight[0] * s) ** 2))
    assert a**2 / b == pytest.approx(efficiency, abs=2e-3)


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


def test_half_a_percent_of_gross_faults_changes_little():
    t = random_table(400, np.random.default_rng(2), SIGMA)
    clean = identify(CHAIN, RIG, t, free=FREE)
    t.value[[7, 200]] += [0.5, -0.02]
    for loss in ("huber", "cauchy"):
        e = identify(CHAIN, RIG, t, free=FREE, options=SolverOptions(loss=loss, solver="map"))
        assert (e.status, e.loss) == ("converged", loss)
        assert np.flatnonzero(e.suspect).tolist() == [7, 200]
        assert e.weight[[7, 200]].max() < 0.01
        # A tenth of the rows of influence c·ψ: shifts of a few tenths of σ, not of hundreds.
        assert np.abs((e.value - clean.value)[FREE] / clean.sigma[FREE]).max() < 1.0
    bent = identify(CHAIN, RIG, t, free=FREE)
    assert np.abs((bent.value - clean.value)[FREE] / clean.sigma[FREE]).max() > 100.0


@pytest.mark.parametrize("loss", ["huber", "cauchy"])
def test_chi2_is_that_of_the_weighted_rows(loss):
    """Of clean rows, as without weights; 7 rows of 400 that are 12 σ off, which a robust loss bounds, do not rule it."""
    t = random_table(400, np.random.default_rng(2), SIGMA)
    linear, clean = (identify(CHAIN, RIG, t, free=FREE, options=SolverOptions(loss=of)) for of in ("linear", loss))
    # Two estimates of one variance from 364 residuals, which have 0.95 of their information in common.
    assert clean.chi2_reduced == pytest.approx(linear.chi2_reduced, abs=4.0 * np.sqrt(2.0 / 364 * 0.1))
    t.value[::60] += 12.0 * SIGMA
    bent, robust = (identify(CHAIN, RIG, t, free=FREE, options=SolverOptions(loss=of)) for of in ("linear", loss))
    assert bent.chi2_reduced > 2.5
    assert robust.chi2_reduced - clean.chi2_reduced < 0.5
    far = t.select(np.arange(400))
    far.value[:] += 3.0 * SIGMA * np.random.default_rng(3).normal(size=400)
    loose = identify(CHAIN, RIG, far, free=FREE, options=SolverOptions(loss=loss))
    assert loose.chi2_reduced > loose.chi2_band[1]
    assert loose.unexplained["m"].low < loose.unexplained["m"].mean  # the headline, in place of the covariance


def test_iterations_count_on_over_the_stages():
    t = random_table(200, np.random.default_rng(3), SIGMA)
    heard = []
    e = identify(CHAIN, RIG, t, free=FREE, options=SolverOptions(loss="cauchy", progress=lambda i, _: heard.append(i)))
    assert heard == list(range(1, e.iterations + 1))
    short = identify(CHAIN, RIG, t, free=FREE, options=SolverOptions(loss="cauchy", max_iterations=2))
    assert (short.status, short.iterations) == ("max_iterations", 6)  # two for each of three stages
    assert short.message == "cauchy loss: 2 iterations were not enough"
    single = identify(CHAIN, RIG, t, free=FREE, options=SolverOptions(max_iterations=1))
    assert single.message == "1 iteration was not enough"


@pytest.mark.parametrize("solver", ["lm", "map"])
def test_a_robust_loss_has_iterations_of_its_own(solver):
    """Least squares needs all that were granted: the robust stage goes on from there as far."""
    t = random_table(400, np.random.default_rng(2), SIGMA)
    clean = identify(CHAIN, RIG, t, free=FREE)
    t.value[[7, 200]] += [0.5, -0.02]
    how = SolverOptions(solver=solver)
    needed = identify(CHAIN, RIG, t, free=FREE, options=how).iterations
    e = identify(CHAIN, RIG, t, free=FREE, options=replace(how, loss="huber", max_iterations=needed))
    assert e.iterations > needed
    assert np.abs((e.value - clean.value)[FREE] / clean.sigma[FREE]).max() < 1.0


def test_choices_that_do_not_go_together_are_refused():
    t = random_table(60, np.random.default_rng(4), SIGMA)
    for how, text in (
        ({"options": SolverOptions(solver="newton")}, "solver: 'newton'"),
        ({"options": SolverOptions(loss="tukey")}, "loss: 'tukey'"),
        ({"options": SolverOptions(damping="none")}, "damping: 'none'"),
        ({"options": SolverOptions(solver="recursive", loss="huber")}, "recursive has no robust loss"),
        ({"options": SolverOptions(solver="map", damping="plain")}, "map has no damping"),
        ({"prefer": np.ones(3, bool)}, "prefer must be 54 booleans"),
    ):
        with pytest.raises(ProblemError, match=text):
            identify(CHAIN, RIG, t, free=FREE, **how)


def test_plain_damping_ends_where_scaled_damping_ends():
    t = random_table(300, np.random.default_rng(5), SIGMA)
    scaled, plain = (identify(CHAIN, RIG, t, free=FREE, options=SolverOptions(damping=d)) for d in ("scaled", "plain"))
    assert plain.status == "converged"
    np.testing.assert_allclose(plain.value, scaled.value, atol=1e-3 * scaled.sigma[FREE].min())
