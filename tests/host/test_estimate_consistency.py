"""The χ² test behind the verdict: sessions with noise alone are consistent, sessions with an error in either are not."""

import fault_worlds as worlds
import numpy as np
import pytest
from puma_bench import CHAIN, TRUTH

from truearm.checks.examination import faults_beside
from truearm.estimate.validation import consistency, judge

FAULTS = {
    "chucks 0.2 mm off": worlds.chucks_off,
    "bar 0.1 mm long": lambda plan, rng: worlds.wrong_bar(plan, rng, 0.1e-3),
    "bar 0.1 mm short": lambda plan, rng: worlds.wrong_bar(plan, rng, -0.1e-3),
    "drift 0.2 mm": lambda plan, rng: worlds.drifting(plan, rng, 0.2e-3),
}
PLACES = ("fitted", "judging")


def judged(seed, fitted=worlds.clean, judging=worlds.clean):
    """A calibration from one session of 360 rows, tested by another of the same plan."""
    rng, plan = np.random.default_rng(seed), worlds.plan()
    estimate = worlds.identified(fitted(plan, rng))
    p = estimate.n_robot_parameters
    rows = judging(plan, rng)
    judgement = judge(CHAIN, worlds.RIG, rows, estimate.value[:p])
    return judgement, rows, consistency(judgement, estimate.covariance[:p, :p], np.zeros((p, 0)))


def result_of(seed, **worlds_of):
    return judged(seed, **worlds_of)[2]


def share_consistent(seeds, **worlds_of):
    found = [result_of(seed, **worlds_of) for seed in seeds]
    return np.mean([of.chi2 <= of.limit for of in found])


def test_chi2_is_that_of_its_degrees_of_freedom():
    """Noise and the calibration's covariance, nothing scaled: the mean of 6 values of 360 degrees, ± 5 σ."""
    found = [result_of(seed) for seed in range(6)]
    assert {of.freedom for of in found} == {360}, "every residual counts: the prior takes the robot's parameters off"
    assert np.mean([of.chi2 for of in found]) == pytest.approx(360.0, abs=5.0 * np.sqrt(720.0 / 6.0))


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("place", PLACES)
def test_a_fault_in_either_session_is_not_consistent(fault, place):
    judgement, rows, found = judged(1, **{place: FAULTS[fault]})
    assert found.chi2 > found.limit or faults_beside(judgement, found.ways, rows)


def test_an_exact_calibration_is_judged_by_noise_alone():
    rows = worlds.clean(worlds.plan(), np.random.default_rng(3))
    p = TRUTH.size
    found = consistency(judge(CHAIN, worlds.RIG, rows, TRUTH), np.zeros((p, p)), np.zeros((p, 0)))
    assert found.freedom == 360
    assert found.chi2 <= found.limit


@pytest.mark.soak
def test_97_of_100_clean_sessions_are_consistent():
    share = share_consistent(range(200))
    print(f"consistent: {share:.3f} of 200 clean worlds")
    assert share >= 0.97


@pytest.mark.soak
@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("place", PLACES)
def test_faults_are_called_consistent_in_5_of_100_at_most(fault, place):
    share = share_consistent(range(40), **{place: FAULTS[fault]})
    print(f"consistent: {share:.3f} of 40 worlds, {fault} in the {place} session")
    assert share <= 0.05
