"""Single bad rows are named exactly and left out; what is wrong with more than rows is not taken for bad rows."""

import numpy as np
import pytest
from tests.host.puma_bench import CHAIN, FREE, RIG, SIGMA, SPHERES, TRUTH, random_table

from truearm.estimate.identify import SolverOptions, identify
from truearm.model.chain import point_forward

REJECT = SolverOptions(reject=True)
N = 360
CHECK = random_table(200, np.random.default_rng(99)).q


def tool_error(e):
    """m, RMS over poses that were not measured."""
    p_end = np.array(SPHERES["s1"].xyz)
    apart = point_forward(CHAIN, e.value[:54], CHECK, p_end) - point_forward(CHAIN, TRUTH, CHECK, p_end)
    return np.sqrt((apart**2).sum(axis=1).mean())


@pytest.mark.parametrize("count", [1, 3, 7])
def test_bad_rows_are_named_exactly(count):
    """By 0.8 to 40 mm, at a noise of 0.084 mm."""
    rng = np.random.default_rng(count)
    t = random_table(N, rng, SIGMA)
    bad = np.sort(rng.permutation(N)[:count])
    clean = identify(CHAIN, RIG, t.select(~np.isin(np.arange(N), bad)), free=FREE)
    t.value[bad] += rng.choice([-1.0, 1.0], count) * np.geomspace(0.8e-3, 40e-3, 7)[:count]
    e = identify(CHAIN, RIG, t, free=FREE, options=REJECT)
    assert np.flatnonzero(e.suspect).tolist() == bad.tolist()
    assert np.flatnonzero(e.weight == 0.0).tolist() == bad.tolist()
    assert e.chi2_band[0] < e.chi2_reduced < e.chi2_band[1]
    assert tool_error(e) <= 1.1 * tool_error(clean)
    bent = identify(CHAIN, RIG, t, free=FREE)
    assert e.with_outliers.n == count
    assert e.with_outliers.chi2_reduced == pytest.approx(bent.chi2_reduced)
    np.testing.assert_array_equal(e.with_outliers.value, bent.value)


def test_clean_rows_stay():
    t = random_table(N, np.random.default_rng(0), SIGMA)
    e, plain = (identify(CHAIN, RIG, t, free=FREE, options=SolverOptions(reject=reject)) for reject in (True, False))
    assert e.with_outliers is None
    np.testing.assert_array_equal(e.value, plain.value)
    assert (e.weight == 1.0).all()


@pytest.mark.parametrize("wrong", ["noise", "block"])
def test_what_is_no_bad_row_is_not_left_out(wrong):
    """Noise of four times the declared σ, and rows in a run that were measured from another place."""
    t = random_table(N, np.random.default_rng(5), 4.0 * SIGMA if wrong == "noise" else SIGMA)
    if wrong == "block":
        t.value[100:110] += 3e-3
    e = identify(CHAIN, RIG, t, free=FREE, options=REJECT)
    assert e.suspect.any()
    assert (e.weight == 1.0).all()
    assert e.with_outliers is None
