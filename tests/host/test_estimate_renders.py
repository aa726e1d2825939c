"""The recipe of Renders, Rossignol, Becquet, Hanus 1991 as a solver; docs/notebooks/renders_1991.ipynb compares it with the paper."""

import numpy as np
import puma_bench
import pytest
from ulb_bench import CHAIN, NOMINAL, OFFSETS, free, lines, rig

from truearm.estimate.identify import SolverOptions, identify


def test_the_recipe_claims_what_the_data_of_all_runs_would():
    """III-E: four lines of 12 points and three runs on the same data. σ is smaller by about √3."""
    rng = np.random.default_rng(0)
    truth = NOMINAL.copy()
    truth[OFFSETS] += 0.052 * rng.normal(size=5)
    table = lines(4, 12, truth, rng)
    how = {"free": free(*OFFSETS), "prior_sigma": np.where(free(*OFFSETS), 0.052, np.inf)}
    good, recipe = (
        identify(CHAIN, rig(table), table, options=SolverOptions(solver, max_iterations=3), **how)
        for solver in ("map", "renders-1991")
    )
    seen = OFFSETS[:4]  # joint 6 has no effect
    assert np.median(good.sigma[seen] / recipe.sigma[seen]) > 1.4
    assert np.mean(recipe.residual["m"]) > np.mean(good.residual["m"])
    assert "3 runs" in recipe.message


@pytest.mark.parametrize(("truth", "runs"), [(puma_bench.TRUTH, range(5, 30)), (puma_bench.DESIGN, range(1, 2))])
def test_the_recipe_ends_on_data_without_noise(truth, runs):
    """Its error fades as that of the first run over k, so what run k gains as 1/k²: below 0.01 σ after ten or twenty."""
    t = puma_bench.random_table(200, np.random.default_rng(0), truth=truth)
    e = identify(
        puma_bench.CHAIN, puma_bench.RIG, t, free=puma_bench.FREE, options=SolverOptions(solver="renders-1991")
    )
    assert (e.status, e.iterations in runs) == ("converged", True)
    assert e.rms_after["m"] < 0.2 * puma_bench.SIGMA  # (runs − 1)⁻¹ of 1.6 σ after the first
