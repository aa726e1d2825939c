"""Repeatability from visits from several sides: estimates compared with the truth, and intervals with the claimed coverage."""

import numpy as np
import pytest
from scipy import stats

from truearm.errors import ProblemError
from truearm.estimate.repeatability import (
    CONFIDENCE,
    Visits,
    allan,
    mean_interval,
    poses_of,
    quantile_interval,
    repeatability,
    rounding_variance,
    sigma_interval,
)
from truearm.plan.approaches import approach_directions

JOINTS, POSES, ROUNDS = 6, 4, 3
BACKLASH = np.array([4e-4, 2e-4, 3e-4, 5e-4, 0.0, 8e-4])
SIGMA, SERVO, SAMPLES = 84e-6, 5e-5, 1e-6  # m, rad, m
JAC = np.random.default_rng(0).uniform(-0.5, 0.5, (POSES, JOINTS))
RUNS = 200


def visited(rng, bend=0.0):
    """Return visits as planned by ``plan characterize``; ``bend``: how much of joint 1's backlash depends on the pose, rad."""
    side = np.tile(approach_directions(JOINTS), (POSES * ROUNDS, 1))
    pose = np.repeat(np.arange(POSES), ROUNDS * len(approach_directions(JOINTS)))
    n = len(pose)
    strayed = SERVO * rng.standard_normal((n, JOINTS))
    width = BACKLASH + bend * np.where(pose % 2, 1.0, -1.0)[:, None] * (np.arange(JOINTS) == 0)
    true = strayed - 0.5 * side * width
    length = 0.46 + np.sum(JAC[pose] * true, axis=1) + np.hypot(SIGMA, SAMPLES) * rng.standard_normal(n)
    q = 0.5 * pose[:, None] + strayed
    return Visits(length, np.full(n, SAMPLES**2), q, side, JAC[pose], np.full((n, JOINTS), 1e-14))


def coverage(intervals, truth):
    return np.mean([one.low <= truth <= one.high for one in intervals])


def covers(share, runs=RUNS):
    """Return whether a share of runs is consistent with 95 %, within 99.9 %."""
    low, high = stats.binom.ppf([0.0005, 0.9995], runs, CONFIDENCE) / runs
    return low <= share <= high


@pytest.fixture(scope="module")
def runs():
    rng = np.random.default_rng(5)
    return [repeatability(visited(rng)) for _ in range(RUNS)]


def test_backlash_and_spreads_are_found_with_their_intervals(runs):
    for joint, truth in enumerate(BACKLASH):
        ours = [one.backlash_si[joint] for one in runs]
        assert covers(coverage(ours, truth))
        values = np.array([one.value for one in ours])
        assert abs(np.mean(values) - truth) < 4.0 * np.std(values) / np.sqrt(RUNS)
    assert covers(coverage([one.unexplained_m for one in runs], np.hypot(SIGMA, SAMPLES)))
    assert covers(coverage([one.bar_sigma_m for one in runs], SIGMA))
    for joint in range(JOINTS):
        assert covers(coverage([one.reading_spread_si[joint] for one in runs], SERVO))
        assert covers(coverage([one.reading_difference_si[joint] for one in runs], 0.0))
    # With what the servo strays by: √(σ² + Σ J² servo²), of all poses together.
    along = np.sqrt(SIGMA**2 + SAMPLES**2 + SERVO**2 * np.mean(np.sum(JAC**2, axis=1)))
    assert covers(coverage([one.along_m for one in runs], along))
    for joint in np.flatnonzero(BACKLASH):
        assert coverage([one.joint_sigma_si[joint] for one in runs], 0.5 * BACKLASH[joint]) > 0.9
    assert np.median([one.joint_sigma_si[4].value for one in runs]) < 1e-4  # no backlash, so next to nothing
    p = np.array([one.misfit_probability for one in runs])
    assert stats.kstest(p, "uniform").pvalue > 1e-3
    rng = np.random.default_rng(6)
    bent = [repeatability(visited(rng, bend=1.5e-3)) for _ in range(20)]
    assert max(one.misfit_probability for one in bent) < 1e-3
    assert min(one.bar_sigma_m.value for one in bent) > SIGMA  # what is left over is counted as the bar's


def test_visits_that_are_few_sorted_or_show_nothing():
    once = visited(np.random.default_rng(1))
    rows = np.arange(8)
    few = Visits(**{name: getattr(once, name)[rows] for name in Visits.__dataclass_fields__})
    with pytest.raises(ProblemError, match="too few repetitions"):
        repeatability(few)
    together = Visits(**{**vars(once), "side": np.repeat(once.side[:, :1], JOINTS, axis=1)})
    with pytest.raises(ProblemError, match="always change together"):
        repeatability(together)
    jac = visited(np.random.default_rng(2)).jac * (np.arange(JOINTS) != 5)
    told = repeatability(Visits(**{**vars(visited(np.random.default_rng(2))), "jac": jac}))
    assert np.isnan(told.backlash_si[5].value)
    assert told.joint_sigma_si[5].high == np.inf
    q = np.array([[0.0, 0.0], [0.5, 0.0], [0.001, 0.0], [0.5, 0.0015], [0.5, 0.01]])
    assert poses_of(q).tolist() == [0, 1, 0, 1, 2]


def test_intervals_of_means_and_quantiles():
    rng = np.random.default_rng(7)
    draws = [rng.exponential(1.0, 60) for _ in range(RUNS)]
    # Order statistics never cover less than they say; of a skewed distribution t may, by 2 % at n = 60.
    for share in (0.5, 0.9):
        assert coverage([quantile_interval(d, share) for d in draws], -np.log(1.0 - share)) > 0.92
    gauss = [rng.standard_normal(60) for _ in range(RUNS)]
    assert covers(coverage([mean_interval(d) for d in gauss], 0.0))
    variances = [np.var(rng.standard_normal((60, 20)), axis=1, ddof=1) for _ in range(RUNS)]
    assert coverage([sigma_interval(v) for v in variances], 1.0) > 0.91  # χ² of 19 degrees is skewed too
    assert quantile_interval(np.array([1.0, 2.0]), 0.95).high == np.inf
    assert np.isnan(mean_interval(np.array([np.nan, 1.0])).value)


def test_what_rounding_leaves_in_a_mean():
    """Against the mean of what is rounded, over all places x between two steps: E = Σ P(rounded ≥ k), k > 0, less Σ P(< k), k ≤ 0."""
    x, k = np.linspace(0.0, 1.0, 400, endpoint=False), np.arange(-8, 10)[:, None]
    for sigma in (1e-6, 0.1, 0.2, 0.3, 0.5):
        at_least = stats.norm.sf((k - 0.5 - x) / sigma)
        mean = np.sum(np.where(k > 0, at_least, at_least - 1.0), axis=0)
        expected = rounding_variance(np.array([1.0]), np.array([sigma]))[0]
        assert np.var(mean - x) == pytest.approx(expected, rel=0.01)
    assert rounding_variance(np.array([1.0]), np.array([0.0]))[0] == pytest.approx(1.0 / 12.0, rel=0.005)
    assert rounding_variance(np.array([0.0]), np.array([0.0]))[0] == 0.0


def test_allan_deviation_of_white_noise_and_of_a_walk():
    rng = np.random.default_rng(9)
    inside = total = 0
    for _ in range(60):
        told = allan([rng.standard_normal(1000) for _ in range(2)], 0.01)
        low, high = (stats.chi2.ppf(p, told.freedom) / told.freedom for p in (0.025, 0.975))
        ratio = told.deviation**2 * (told.tau_s / 0.01)
        inside, total = inside + int(np.sum((ratio >= low) & (ratio <= high))), total + ratio.size
    # Neighbouring times of one run hang together: a twentieth of them as independent as runs.
    assert inside / total == pytest.approx(0.95, abs=4.0 * np.sqrt(0.05 * 0.95 / 60))
    walk = allan([1e-3 * np.cumsum(rng.standard_normal(4000)) + 0.1 * rng.standard_normal(4000) for _ in range(8)], 1.0)
    # White noise 0.1/√m and a walk 1e-3·√(m/3) cross at m = 173; the floor lies there.
    assert 32 < walk.tau_s[np.argmin(walk.deviation)] < 1000
    assert allan([], 0.01).tau_s.size == 0
