"""Single bad rows are found exactly and left out; errors of many rows are not treated as outliers."""

from dataclasses import replace

import numpy as np
import pytest
from tests.host.device_bench import TARGETS, join, touches
from tests.host.findings_bench import stated
from tests.host.puma_bench import CHAIN, FREE, RIG, SIGMA, SPHERES, TRUTH, random_table

import truearm
from truearm.estimate.defaults import choose_defaults
from truearm.estimate.identify import SolverOptions, identify
from truearm.model.chain import point_forward
from truearm.types import Plane

REJECT = SolverOptions(reject=True)
N = 360
CHECK = random_table(200, np.random.default_rng(99)).q


def tool_error(e):
    """Return the RMS error of the tool [m] over poses that were not measured."""
    p_end = np.array(SPHERES["s1"].xyz)
    apart = point_forward(CHAIN, e.value[:54], CHECK, p_end) - point_forward(CHAIN, TRUTH, CHECK, p_end)
    return np.sqrt((apart**2).sum(axis=1).mean())


@pytest.mark.parametrize("count", [1, 3, 7])
def test_bad_rows_are_named_exactly(count):
    """Errors of 0.8 to 40 mm, with noise of 0.084 mm."""
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


@pytest.mark.parametrize("length", [1e-9, 1.46, 99.0])
def test_a_gross_row_is_named_alone(length):
    """A sensor that read nothing, a metre too much, another unit: the fit is that without the row, and so is the choice of a prior."""
    rng = np.random.default_rng(8)
    t, bad = random_table(N, rng, SIGMA), 200
    others = t.select(np.arange(N) != bad)
    t.value[bad] = length
    none = np.zeros(54, dtype=bool)
    free, sigma, _ = choose_defaults(CHAIN, RIG, t, FREE, none, True)
    clean_free, clean_sigma, _ = choose_defaults(CHAIN, RIG, others, FREE, none, True)
    np.testing.assert_array_equal(free, clean_free)
    np.testing.assert_array_equal(sigma, clean_sigma)
    e, clean = (identify(CHAIN, RIG, of, free=free, prior_sigma=sigma, options=REJECT) for of in (t, others))
    assert np.flatnonzero(e.suspect).tolist() == np.flatnonzero(e.weight == 0.0).tolist() == [bad]
    np.testing.assert_allclose(e.value, clean.value, atol=1e-3 * np.nanmin(clean.sigma[:54]))  # where steps end
    assert e.rms_after["m"] == pytest.approx(clean.rms_after["m"], rel=1e-6)
    assert e.rms_before["m"] == pytest.approx(clean.rms_before["m"], rel=1e-3)
    assert e.with_outliers.n == 1
    assert e.with_outliers.rms_after["m"] > 1e-3


def test_clean_rows_stay_and_many_gross_ones_are_no_bad_rows():
    # Four that follow each other are a fault of the session, not of rows: none is left out.
    t = random_table(N, np.random.default_rng(8), SIGMA)
    t.value[200:204] += 0.5
    e = identify(CHAIN, RIG, t, free=FREE, options=REJECT)
    assert (e.weight == 1.0).all()
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


def test_under_misfit_clean_rows_stay_and_a_bad_one_goes():
    """Joints with an error of their own, 1 mrad in one turn: the usual row errs by some times its declared noise."""
    t = random_table(N, np.random.default_rng(3), SIGMA)
    q = t.q - 1e-3 * np.sin(t.q + np.arange(6.0))
    misfit = replace(t, q=q)
    e = identify(CHAIN, RIG, misfit, free=FREE, options=REJECT)
    assert e.chi2_reduced > 2.0
    assert e.suspect.any(), "beyond what the declared noise allows"
    assert (e.weight == 1.0).all()
    misfit.value[77] += 5e-3
    assert np.flatnonzero(identify(CHAIN, RIG, misfit, free=FREE, options=REJECT).weight == 0.0).tolist() == [77]


@pytest.mark.parametrize("loss", ["linear", "cauchy"])
def test_more_bad_rows_than_are_left_out_are_named(loss):
    """22 of 360 rows, by 0.8 to 5 mm: the rows are bad, not the model, whichever loss is given."""
    rng = np.random.default_rng(0)
    t = random_table(N, rng, SIGMA)
    bad = np.sort(rng.permutation(N)[:22])
    t.value[bad] += rng.choice([-1.0, 1.0], 22) * rng.uniform(0.8e-3, 5e-3, 22)
    of = truearm.identify(
        truearm.load_robot("puma560"), t, RIG, options=truearm.IdentifyOptions(loss=loss, joint_laws="auto")
    )
    assert np.flatnonzero(of.estimate.suspect).tolist() == bad.tolist()
    assert not of.estimate.faults
    findings = stated(of.document)
    assert not {"doubtful-residuals", "too-many-outliers"} & set(findings)
    if loss == "cauchy":
        assert "bad-rows" not in findings
        assert of.estimate.chi2_reduced < of.estimate.chi2_band[1]
        assert tool_error(of.estimate) < 1.3 * of.predicted.rms
    else:
        assert (findings["bad-rows"].values["n"], findings["bad-rows"].values["fitted"]) == (22, 360)
        assert of.estimate.without_bad_rows.chi2_reduced < of.estimate.chi2_band[1]
        assert (of.estimate.weight == 1.0).all()
        expect = of.estimate.without_bad_rows.tool_moves
        assert tool_error(of.estimate) == pytest.approx(expect, rel=0.2)  # the fit without them errs too
        assert findings["tool-error-bad-rows"].values["moves"] == {"mm": 1e3 * expect}


def test_all_rows_of_a_kind_may_be_outliers():
    """A flat that is 3 mm from where it is described, touched once beside a hundred bars."""
    rng = np.random.default_rng(0)
    plane = Plane("p", (0.4, 0.1, 0.3), (0.0, 0.0, 1.0), 3e-5, 1e-5, 1e-4)
    touch = touches(plane, 1, rng)
    table = join(random_table(100, rng, SIGMA), touch.replace(value=touch.value + 3e-3))
    rig = replace(RIG, planes={"p": plane}, targets=TARGETS)
    estimate = identify(CHAIN, rig, table, free=FREE, options=SolverOptions(reject=True))
    np.testing.assert_array_equal(np.flatnonzero(estimate.weight == 0.0), [100])
    assert estimate.chi2_reduced < 1.5
