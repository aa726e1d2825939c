"""χ² and its band: their mean, variance and coverage by Monte Carlo, whatever the prior is worth.

The linear problems are small and hard on purpose: few residuals, and directions in which data and prior weigh alike.
"""

from dataclasses import replace

import numpy as np
import pytest
from puma_bench import CHAIN, FREE, RIG, SIGMA, random_table
from scipy import special, stats

from truearm.estimate.identify import SolverOptions, identify
from truearm.estimate.information import fold, half, spectrum
from truearm.estimate.robust import clean_square, weigh
from truearm.estimate.solvers import SOLVERS, Loss
from truearm.estimate.uncertainty import goodness, prior_shares, weak_prior

DRAWS = 20_000


def jacobian(singular, n, seed):
    """Return a matrix (n, k) with these singular values in random directions."""
    rng = np.random.default_rng(seed)
    k = len(singular)
    u, v = (np.linalg.qr(rng.normal(size=(m, k)))[0] for m in (n, k))
    return u * np.array(singular) @ v.T


def influence(jac, sigma):
    """Return the influence matrix H of a fit with prior σ (inf for none), by pseudo-inverse."""
    prior = np.diag(np.where(np.isfinite(sigma), 1.0 / sigma, 0.0))
    return jac @ np.linalg.pinv(np.vstack([jac, prior]), rcond=1e-10)[:, : len(jac)]


def judged(jac, sigma, chi2):
    """Call ``goodness`` as ``identify`` does."""
    k = jac.shape[1]
    prior = np.diag(np.where(np.isfinite(sigma), 1.0 / sigma, 0.0))
    root = fold(np.zeros((k, k)), np.vstack([jac, prior]))
    return goodness(chi2, len(jac), prior_shares(half(spectrum(root)), sigma))


def draws(jac, sigma, c, seed):
    """Return χ² (DRAWS,) of data whose true parameters are c·σ from the prior's mean, or 0 from it without a prior."""
    rng = np.random.default_rng(seed)
    true = c * np.where(np.isfinite(sigma), sigma, 0.0) * rng.normal(size=(DRAWS, len(sigma)))
    data = true @ jac.T + rng.normal(size=(DRAWS, len(jac)))
    residual = data @ (np.eye(len(jac)) - influence(jac, sigma)).T
    return (residual**2).sum(axis=1)


INF = np.inf
CASES = {
    "no prior": (jacobian([1.0, 10.0, 100.0, 1e3], 12, 0), np.full(4, INF)),
    "no prior, two of four seen": (jacobian([1.0, 10.0], 9, 1) @ np.eye(4)[:2], np.full(4, INF)),
    "prior as strong as the data": (jacobian([0.5, 1.0, 1.0, 2.0], 12, 2), np.ones(4)),
    "prior far too wide or deciding": (jacobian([1e-3, 1e-2, 1e2, 1e3], 12, 3), np.ones(4)),
    "prior of some": (jacobian([0.3, 1.0, 3.0, 10.0], 12, 4), np.array([1.0, INF, 0.3, INF])),
    "fewer data than parameters": (jacobian([0.2, 0.7, 1.5], 3, 5) @ np.eye(6)[:3], np.full(6, 0.8)),
}


@pytest.mark.parametrize("case", CASES)
def test_degrees_of_freedom_are_what_the_influence_leaves(case):
    jac, sigma = CASES[case]
    left = len(jac) - np.trace(influence(jac, sigma))
    assert judged(jac, sigma, 0.0).freedom == pytest.approx(left, abs=1e-9)


@pytest.mark.parametrize("c", [0.0, 0.1, 0.5, 1.0])
@pytest.mark.parametrize("case", CASES)
def test_the_band_holds_for_every_prior_that_is_true_or_too_wide(case, c):
    jac, sigma = CASES[case]
    chi2 = draws(jac, sigma, c, 12)
    found = judged(jac, sigma, 0.0)
    low, high = found.band
    inside = float(np.mean((chi2 >= low * found.freedom) & (chi2 <= high * found.freedom)))
    error = 4 * np.sqrt(0.95 * 0.05 / DRAWS)
    assert inside > 0.95 - error
    if not np.isfinite(sigma).any():
        assert inside < 0.95 + error  # exact without a prior


def test_without_spare_data_nothing_is_judged():
    found = judged(jacobian([1.0, 2.0, 3.0], 3, 6), np.full(3, INF), 1e-20)
    assert np.isnan([found.reduced, *found.band]).all()
    assert found.freedom == pytest.approx(0.0, abs=1e-12)


# --- the robot --------------------------------------------------------------------------------------------------------

N_ROWS, RUNS = 60, 25  # 60 lengths for 36 parameters: what the prior decides matters


def drawn(c, runs, seed, **how):
    """Return χ²/ν, ν, and whether χ² is within the band, each (runs,), for robots c·σ of the weak prior from the nominal one."""
    rng = np.random.default_rng(seed)
    sigma = weak_prior(CHAIN)
    out = []
    for _ in range(runs):
        truth = CHAIN.params_nominal + c * np.where(FREE, sigma, 0.0) * rng.normal(size=sigma.size)
        e = identify(CHAIN, RIG, random_table(N_ROWS, rng, SIGMA, truth), free=FREE, prior_sigma=sigma, **how)
        assert e.status == "converged"
        out.append((e.chi2_reduced, e.chi2_freedom, e.chi2_band[0] <= e.chi2_reduced <= e.chi2_band[1]))
    return np.array(out).T


@pytest.mark.parametrize("solver", ["lm", "map", "recursive"])
@pytest.mark.parametrize("c", [1.0, pytest.param(0.0, marks=pytest.mark.soak)])
def test_every_solver_is_judged_alike(c, solver):
    """A prior on the robot, true and far too wide; with 24 residuals to spare and the prior's share, ν is above 24."""
    chi2, freedom, inside = drawn(c, RUNS, 20, options=SolverOptions(solver=solver))
    assert (freedom > N_ROWS - 36).all()
    # Each of 36 directions lowers the mean by ¼/ν at most.
    error = 4 * np.sqrt(2 / freedom.mean() / RUNS)
    least = 1.0 if c else 1.0 - 9.0 / freedom.mean()
    assert least - error < chi2.mean() < 1.0 + error
    assert inside.sum() >= RUNS - 5  # 6 of 25 outside: one in 2,000


def test_the_paper_s_recipe_fits_as_closely_as_it_claims_to():
    """Run after run the prior fades, which the degrees of freedom follow."""
    chi2, freedom, inside = drawn(1.0, RUNS, 21, options=SolverOptions(solver="renders-1991"))
    of_map = drawn(1.0, 1, 21, options=SolverOptions(solver="map"))[1]
    assert (freedom < of_map).all()
    assert chi2.mean() < 1.0 + 4 * np.sqrt(2 / freedom.mean() / RUNS)
    assert inside.sum() >= RUNS - 5


@pytest.mark.parametrize("loss", [Loss.HUBER, Loss.CAUCHY])
def test_under_a_robust_loss_clean_rows_count_as_declared_and_a_tolerated_fault_does_not(loss):
    t = random_table(400, np.random.default_rng(22), SIGMA)
    e = identify(CHAIN, RIG, t, free=FREE, options=SolverOptions(loss=loss))
    plain = identify(CHAIN, RIG, t, free=FREE)
    assert e.chi2_freedom == plain.chi2_freedom == 364
    # What the weights w change of clean squares s² has the mean 0 and this variance, found by the quantiles of s; and the
    # fit, 5 % less efficient, follows 36 directions 0.05·36 = 1.8 less well.
    s = np.sqrt(special.chdtri(1, (np.arange(10_000) + 0.5) / 10_000))
    change = weigh(loss, s, 1).weight * s**2 / clean_square(loss, 1) - s**2
    assert abs(e.chi2_reduced - plain.chi2_reduced) < 3 * np.sqrt(change.var() / 364) + 3 * 1.8 / 364
    value = t.value.copy()
    value[7] += 30 * SIGMA
    faulty = identify(CHAIN, RIG, replace(t, value=value), free=FREE, options=SolverOptions(loss=loss))
    assert np.flatnonzero(faulty.suspect).tolist() == [7]
    # The row's own square, weighted at most 4 σ of it, is gone; the fit follows the others hardly differently.
    assert abs(364 * (faulty.chi2_reduced - e.chi2_reduced)) < 4**2 + 1.8
    assert plain.chi2_band[0] < faulty.chi2_reduced < faulty.chi2_band[1]


@pytest.mark.parametrize("solver", sorted(SOLVERS))
def test_what_nothing_sees_takes_no_degree_of_freedom(solver):
    """54 free parameters of which 36 are identifiable, without a prior."""
    t = random_table(200, np.random.default_rng(24), SIGMA)
    e = identify(CHAIN, RIG, t, options=SolverOptions(solver=solver))
    assert e.chi2_freedom == pytest.approx(200 - 36, abs=1e-6)
    assert e.chi2_band == pytest.approx(np.array(stats.chi2.interval(0.95, 164)) / 164, rel=1e-6)


@pytest.mark.soak
@pytest.mark.parametrize("c", [1.0, 0.3, 0.0])
def test_coverage_over_four_hundred_robots(c):
    _, _, inside = drawn(c, 400, 30, options=SolverOptions(solver="map"))
    assert inside.mean() > 0.95 - 3 * np.sqrt(0.95 * 0.05 / 400)
