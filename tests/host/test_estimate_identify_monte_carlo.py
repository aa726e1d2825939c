"""Goswami's experiment 200 times over: are the claimed errors the errors? map and recursive end where lm ends (test_estimate_recursive).

800 poses on the 46 cm shells, start at the design values, truth the optimised ones, 0.084 mm of noise. NEES is
eᵀC⁻¹e over the 36 identified parameters, χ²(36) if the covariance is right; χ² has 764 degrees of freedom. Bands are
three standard errors of a mean of RUNS.
"""

import numpy as np
import pytest
from puma_bench import CHAIN, FREE, RIG, SIGMA, TRUTH, shell_table

from truearm.estimate.identify import SolverOptions, identify
from truearm.estimate.information import observe
from truearm.estimate.problem import build_problem

RUNS = 200


def with_noise(t, rng):
    return t.replace(value=t.value + SIGMA * rng.normal(size=len(t)))


@pytest.mark.soak
@pytest.mark.parametrize("how", [{}, {"options": SolverOptions("map"), "prior_sigma": np.ones(54)}], ids=["lm", "map"])
def test_errors_are_those_that_are_claimed(how):
    """Also with a prior that is far too wide, and no degrees of freedom for that."""
    rng = np.random.default_rng(0)
    near, far = shell_table(800, 0.46, rng), shell_table(800, 0.61, rng, bar="long")
    found = []
    for _ in range(RUNS):
        e = identify(CHAIN, RIG, with_noise(near, rng), free=FREE, **how)
        assert e.status == "converged"
        error = (e.value - TRUTH)[FREE]
        judged = observe(build_problem(CHAIN, RIG, with_noise(far, rng)), e.value, np.zeros(54, bool))
        nees = error @ np.linalg.solve(e.covariance[np.ix_(FREE, FREE)], error)
        validation = np.sqrt(np.mean(judged.residual["m"] ** 2))
        found.append((nees, e.chi2_reduced * e.chi2_freedom, np.mean((error / e.sigma[FREE]) ** 2), validation))
    nees, chi2, mse, validation = np.mean(found, axis=0)
    assert abs(nees - 36.0) < 3 * np.sqrt(2 * 36 / RUNS)
    assert abs(chi2 - 764.0) < 3 * np.sqrt(2 * 764 / RUNS)
    assert abs(mse - 1.0) < 0.085  # the mean over parameters of squared error over claimed variance
    # Noise and the prediction's own variance, trace(J C Jᵀ)/n, at the truth. PAPERS' 0.0877 mm is for other shells of the same radii.
    root, ahead = (observe(build_problem(CHAIN, RIG, rows), TRUTH, FREE).root for rows in (near, far))
    theory = SIGMA * np.sqrt(1.0 + np.linalg.norm(ahead @ np.linalg.inv(root)) ** 2 / len(far))
    assert SIGMA < theory < 0.095e-3
    # The 36 parameters' own part is common to a run's residuals and strays by some 1/√18 of itself: over 40 runs three
    # standard errors are a tenth.
    assert abs(validation - theory) < 3 * theory / np.sqrt(2 * 800 * RUNS) + 0.1 * (theory - SIGMA)
