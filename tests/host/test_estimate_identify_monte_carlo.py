"""Goswami's experiment many times over: are the claimed errors the errors?

800 poses on the 46 cm shells, start at the design values, truth the optimised ones, 0.084 mm of noise. NEES is
eᵀC⁻¹e over the 36 identified parameters, χ²(36) if the covariance is right; χ² has 764 degrees of freedom; MSE/CRB is the
mean over parameters of squared error over claimed variance. Bands are three standard errors of a mean of ``runs``.
"""

import numpy as np
import pytest
from puma_bench import BARS, CHAIN, FREE, RIG, SIGMA, TRUTH, shell_table

from truearm.estimate.identify import SolverOptions, identify
from truearm.estimate.information import observe
from truearm.estimate.problem import build_problem

pytestmark = pytest.mark.soak


@pytest.fixture(scope="module")
def shells():
    rng = np.random.default_rng(0)
    return shell_table(800, 0.46, rng), shell_table(800, 0.61, rng, bar="long")


def with_noise(t, rng):
    return type(t)(**{**vars(t), "value": t.value + SIGMA * rng.normal(size=len(t))})


def many(near, far, runs, seed, **how):
    """NEES, χ², MSE/CRB and the validation's RMS [m], each (runs,)."""
    rng = np.random.default_rng(seed)
    out = []
    for _ in range(runs):
        e = identify(CHAIN, RIG, with_noise(near, rng), free=FREE, **how)
        assert e.status == "converged"
        error = (e.value - TRUTH)[FREE]
        nees = error @ np.linalg.solve(e.covariance[np.ix_(FREE, FREE)], error)
        judged = build_problem(CHAIN, RIG, with_noise(far, rng))
        validation = np.sqrt(np.mean(observe(judged, e.value, np.zeros(54, bool)).residual["m"] ** 2))
        out.append((nees, e.chi2_reduced * e.chi2_freedom, np.mean((error / e.sigma[FREE]) ** 2), validation))
    return np.array(out).T


def expected_validation(near, far):
    """Noise and the prediction's own variance, trace(J C Jᵀ)/n, at the truth."""
    root = observe(build_problem(CHAIN, RIG, near), TRUTH, FREE).root
    ahead = observe(build_problem(CHAIN, RIG, far), TRUTH, FREE).root
    own = np.linalg.norm(ahead @ np.linalg.inv(root)) ** 2 / len(far)
    return SIGMA * np.sqrt(1.0 + own)


def held_to(shells, runs, seed, mse_band, **how):
    near, far = shells
    nees, chi2, mse, validation = many(near, far, runs, seed, **how)
    assert abs(nees.mean() - 36.0) < 3 * np.sqrt(2 * 36 / runs)
    assert abs(chi2.mean() - 764.0) < 3 * np.sqrt(2 * 764 / runs)
    assert abs(mse.mean() - 1.0) < mse_band
    # PAPERS' 0.0877 mm is for other shells of the same radii; the theory for these is computed.
    theory = expected_validation(near, far)
    assert SIGMA < theory < 0.095e-3
    # The 36 parameters' own part is common to a run's residuals and strays by some 1/√18 of itself: over 40 runs three
    # standard errors are a tenth.
    assert abs(validation.mean() - theory) < 3 * theory / np.sqrt(2 * 800 * runs) + 0.1 * (theory - SIGMA)
    assert RIG.bars == BARS


def test_two_hundred_runs(shells):
    held_to(shells, 200, 2, 0.085)


@pytest.mark.parametrize(
    "how",
    [
        {"options": SolverOptions(solver="map")},
        {
            "options": SolverOptions(solver="map"),
            "prior_sigma": np.ones(54),
        },  # far too wide, and no degrees of freedom for that
        {"options": SolverOptions(solver="recursive")},
    ],
)
def test_two_hundred_runs_of_the_other_solvers(shells, how):
    held_to(shells, 200, 3, 0.085, **how)
