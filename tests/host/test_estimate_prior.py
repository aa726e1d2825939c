"""The named priors: their values, and their effect on a fit of Goswami's PUMA, which is off by 13 mm and 56 mrad."""

import numpy as np
import pytest
from puma_bench import CHAIN, DESIGN, FREE, RIG, TRUTH, random_table

from truearm.estimate.identify import SolverOptions, identify
from truearm.estimate.prior import weak_prior, wide_prior


@pytest.fixture(scope="module")
def exact():
    """Return 200 lengths without noise and lm's estimate from them."""
    t = random_table(200, np.random.default_rng(0))
    return t, identify(CHAIN, RIG, t, free=FREE)


def found(exact, **how):
    """Return a fit of the exact lengths, and the largest deviation of its parameters in σ of lm's."""
    t, lm = exact
    e = identify(CHAIN, RIG, t, free=FREE, **how)
    return e, np.abs((e.value - lm.value)[: FREE.size][FREE] / lm.sigma[: FREE.size][FREE]).max()


def test_sigmas_by_unit():
    unit = np.array([p.unit for p in CHAIN.parameters])
    for prior, sigmas in ((weak_prior, (1e-3, 5e-3, 1e-3)), (wide_prior, (1e-2, 0.052, 1e-2))):
        for u, sigma in zip(("m", "rad", "1"), sigmas, strict=True):
            assert (prior(CHAIN)[unit == u] == sigma).all()


def test_map_without_a_prior_with_a_wide_and_with_a_weak_one(exact):
    e, off = found(exact, options=SolverOptions(solver="map"))
    assert e.status == "converged"
    assert off < 1e-6  # the end of the search, 1e-6 of what is left
    assert e.chi2_reduced < 1e-15
    # An error e by a prior M moves a fit of covariance P by PMe, in P's norm at most √(eᵀMe) √λ, λ the largest of PM.
    error, sigma = (TRUTH - DESIGN)[FREE], wide_prior(CHAIN)[FREE]
    assert ((error / sigma) ** 2).sum() < 36  # 4: what robots such as the prior believes in have
    covariance = exact[1].covariance[: FREE.size, : FREE.size][np.ix_(FREE, FREE)]
    largest = np.linalg.eigvalsh(covariance / np.multiply.outer(sigma, sigma))[-1]
    bound = np.linalg.norm(error / sigma) * np.sqrt(largest)
    e, off = found(exact, options=SolverOptions(solver="map"), prior_sigma=wide_prior(CHAIN))
    assert e.status == "converged"
    assert off < bound < 0.2
    assert e.chi2_reduced < bound**2 / (200 - 36)
    assert off < 0.02  # as the module says
    # 410 for 36: the prior is false, and the parameters are off by a σ of the data, without any noise.
    assert (((TRUTH - DESIGN) / weak_prior(CHAIN))[FREE] ** 2).sum() > 400
    _, off = found(exact, options=SolverOptions(solver="map"), prior_sigma=weak_prior(CHAIN))
    assert off > 0.5
