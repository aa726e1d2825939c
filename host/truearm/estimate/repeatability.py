"""Repeatability of a robot from visits to the same poses from different sides: spread, backlash, noise, intervals.

Visit i of pose g has the length ℓ_i and the mean reading q_i, and joint j approached from the side s_ij = ±1. The part
explained by the readings is subtracted, y_i = ℓ_i − J_g (q_i − q̄_g): the rest is noise to an identification. If the
links lag their encoders by half the backlash b,

    y_i = μ_g − ½ Σ_j J_gj s_ij b_j + e_i,

a linear regression. Visits to one pose from one side differ by e alone, so an F test shows whether b explains the
differences between the sides (lack of fit).

Intervals are 95 %: χ² for standard deviations, t for means and regressions, order statistics for quantiles.

The Allan deviation shows how a sensor's mean wanders with the averaging time. Its degrees of freedom are those of white
noise (Riley, NIST SP 1065, 2008, §5.4.1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri, fdtrc, stdtrit
from scipy.stats import quantile_test, sem

from truearm.errors import ProblemError
from truearm.text import counted
from truearm.types import Floats, Ints

CONFIDENCE = 0.95
TAILS = np.array([0.5 - 0.5 * CONFIDENCE, 0.5 + 0.5 * CONFIDENCE])
MISFIT = 1e-3  # a smaller probability of the lack of fit is reported
SAME_POSE = 2e-3  # rad or m in each joint; servo and settling errors are far smaller, and poses differ by more
LEAST_FREEDOM = 5.0  # of an Allan deviation
UNSEEN = 1e-4  # of the largest: below it, a joint's effect on the bar per radian is negligible


@dataclass(frozen=True)
class Interval:
    """An estimate and its 95 % interval; NaN where unknown."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Visits:
    """n visits to poses, of j joints; all in m and rad.

    ``side``: the direction of the last motion, NaN where unknown. ``jac``: ∂length/∂joints. ``length_var``: variance of
    the mean length from its samples. ``reading_var``: variance of the mean reading, including quantisation.
    """

    length: Floats  # (n,)
    length_var: Floats  # (n,)
    q: Floats  # (n, j)
    side: Floats  # (n, j)
    jac: Floats  # (n, j)
    reading_var: Floats  # (n, j)


@dataclass(frozen=True)
class Repeatability:
    """Repeatability and backlash of a robot in m and rad; tuples have one entry per joint.

    ``sides`` counts the combinations of pose and approach direction. ``along_m`` is the spread of the length at one
    pose from one side, and ``unexplained_m`` the part that the readings do not explain. ``backlash_si`` is the full
    width by which the link lags the encoder, with its standard deviation. ``reading_spread_si`` is that of the mean
    reading at one pose from one side, and ``reading_difference_si`` that of the mean readings between the sides, up
    minus down. ``misfit_probability``: of differences between the sides at least this large if backlash were the only
    cause; NaN if too few visits repeat. ``bar_sigma_m`` and ``joint_sigma_si`` are for an identification: see
    ``repeatability()``.
    """

    visits: int
    poses: int
    sides: int
    along_m: Interval
    unexplained_m: Interval
    backlash_si: tuple[Interval, ...]
    backlash_sigma_si: tuple[float, ...]
    reading_spread_si: tuple[Interval, ...]
    reading_difference_si: tuple[Interval, ...]
    misfit_probability: float
    bar_sigma_m: Interval
    joint_sigma_si: tuple[Interval, ...]


def repeatability(visits: Visits) -> Repeatability:
    """Return repeatability and backlash from visits. Raises ProblemError if too few of them repeat.

    ``bar_sigma_m``² is the residual variance of the regression minus the part due to samples and joint readings, which
    an identification counts separately, but at least a hundredth of it, so that no row has excessive weight.
    ``joint_sigma_si``² is the variance of a mean reading plus b²/4: if the side is unknown, the link is off by ±b/2. On
    average b² is too large by its variance, which errs on the safe side.
    """
    sided = np.isfinite(visits.side).all(axis=1)
    visits = Visits(**{name: column[sided] for name, column in vars(visits).items()})
    pose = poses_of(visits.q)
    approach = np.unique(np.column_stack([pose, visits.side]), axis=0, return_inverse=True)[1].reshape(-1)
    n, n_sides = len(pose), len(np.unique(approach))
    if n - n_sides < 3:
        raise ProblemError(
            f"too few repetitions: {counted(n, 'dwell')} with a known approach direction, in {counted(n_sides, 'combination')} of pose and direction; "
            "record a plan of truearm plan characterize, which repeats them"
        )
    jac = visits.jac - _deviations(visits.jac, pose)
    y = visits.length - np.sum(jac * _deviations(visits.q, pose), axis=1)
    backlash, backlash_sigma, variance, freedom = _regression(y, -0.5 * jac * visits.side, pose)
    pure = _spread(y, approach)
    reading_var = np.nanmean(visits.reading_var, axis=0)
    separate = float(np.mean(visits.length_var) + np.mean(np.square(jac) @ reading_var))
    readings = list(zip(visits.q.T, visits.side.T, strict=True))
    return Repeatability(
        visits=n,
        poses=len(np.unique(pose)),
        sides=n_sides,
        along_m=_spread(visits.length, approach),
        unexplained_m=pure,
        backlash_si=backlash,
        backlash_sigma_si=backlash_sigma,
        reading_spread_si=tuple(_spread(q, approach) for q, _ in readings),
        reading_difference_si=tuple(_regression(q, 0.5 * side[:, None], pose)[0][0] for q, side in readings),
        misfit_probability=_misfit((variance, freedom), (pure.value**2, n - n_sides)),
        bar_sigma_m=_without(variance_interval(variance, freedom), separate),
        joint_sigma_si=tuple(map(_joint_sigma, backlash, reading_var.tolist())),
    )


def poses_of(q: Floats) -> Ints:
    """Return the number (n,) of the pose of each visit: visits within SAME_POSE of a pose's first visit share it."""
    pose = np.full(len(q), -1, dtype=np.int64)
    for i in range(len(q)):
        if pose[i] < 0:
            is_near = np.all(np.abs(q - q[i]) <= SAME_POSE, axis=1) & (pose < 0)
            pose[is_near] = pose.max() + 1
    return pose


def mean_interval(values: Floats) -> Interval:
    """Return the mean of independent numbers (n,), ignoring NaN, and its t interval."""
    values = values[np.isfinite(values)]
    if values.size < 2:
        return Interval(np.nan, np.nan, np.nan)
    return _t_interval(float(values.mean()), float(sem(values)), values.size - 1)


def quantile_interval(values: Floats, share: float) -> Interval:
    """Return a quantile of independent positive numbers (n,) of any distribution, with its interval; ignores NaN.

    If n is too small for an order statistic above the quantile, the upper end is infinite.
    """
    values = values[np.isfinite(values)]
    if not values.size:
        return Interval(np.nan, np.nan, np.nan)
    low, high = quantile_test(values, p=share).confidence_interval(CONFIDENCE)
    return Interval(
        float(np.quantile(values, share)), float(np.nan_to_num(low)), float(np.nan_to_num(high, nan=np.inf))
    )


def sigma_interval(variances: Floats) -> Interval:
    """Return the standard deviation from independent estimates (n,) of one variance with unknown degrees of freedom."""
    mean = mean_interval(variances)
    return Interval(*np.sqrt(np.maximum([mean.value, mean.low, mean.high], 0.0)).tolist())


def variance_interval(variance: float, freedom: float) -> Interval:
    """Return the standard deviation for an estimate of the variance with these degrees of freedom."""
    low, high = np.sqrt(variance * freedom / chdtri(freedom, TAILS))
    return Interval(float(np.sqrt(variance)), float(low), float(high))


def rounding_variance(step: Floats, sigma: Floats) -> Floats:
    """Return the variance (j,) of the mean of many readings with steps (j,) and noise ``sigma`` (j,) before rounding.

    The mean has the error Σ_k (−1)^k step/(πk) exp(−2π²k²σ²/step²) sin(2πkx/step) (Widrow and Kollár, Quantization
    Noise, 2008), so over all x the variance Σ_k step²/(2π²k²) exp(−4π²k²σ²/step²): step²/12 without noise, and none
    with a noise of half a step.
    """
    k = np.arange(1, 200)[:, None]
    share = np.divide(sigma, step, out=np.full(step.shape, np.inf), where=step > 0.0)
    terms = np.exp(-4.0 * np.pi**2 * np.square(k * share)) / (2.0 * np.pi**2 * k**2)
    return np.asarray(np.square(step) * np.sum(terms, axis=0))


class Allan(NamedTuple):
    """Averaging times (k,) [s], deviations (k,) [unit of the samples], and degrees of freedom (k,)."""

    tau_s: Floats
    deviation: Floats
    freedom: Floats


def allan(pieces: Sequence[Floats], period_s: float) -> Allan:
    """Return the Allan deviation of several gap-free pieces of evenly spaced samples (n,).

    The averaging times are 1, 2, 4 … samples, at most a third of a piece.
    """
    longest = max((piece.size for piece in pieces), default=0)
    rows = []
    for k in range(longest.bit_length()):
        m = 1 << k
        variances = [_allan_variance(piece, m) for piece in pieces if piece.size >= 3 * m]
        freedom = sum(f for _, f in variances)
        if freedom >= LEAST_FREEDOM:
            rows.append((m * period_s, np.sqrt(sum(v * f for v, f in variances) / freedom), freedom))
    return Allan(*np.array(rows).reshape(-1, 3).T)


def _allan_variance(samples: Floats, m: int) -> tuple[float, float]:
    """Return the variance of means of m samples, and its degrees of freedom if the noise is white."""
    n = samples.size
    sums = np.concatenate([[0.0], np.cumsum(samples - np.mean(samples))])
    means = (sums[m:] - sums[:-m]) / m
    variance = 0.5 * float(np.mean(np.square(means[m:] - means[:-m])))
    points = n + 1  # of the phase; the samples are its differences
    freedom = (1.5 * (points - 1) / m - 2.0 * (points - 2) / points) * 4.0 * m**2 / (4.0 * m**2 + 5.0)
    return variance, max(float(freedom), 1.0)


def _regression(y: Floats, columns: Floats, group: Ints) -> tuple[tuple[Interval, ...], tuple[float, ...], float, int]:
    """Fit y (n,) by columns (n, k) and a mean for each group.

    Return the coefficients and their standard deviations, NaN for columns without effect, the residual variance, and
    its degrees of freedom.
    """
    y, x = _deviations(y, group), _deviations(columns, group)
    size = np.linalg.norm(x, axis=0)
    affects = size > UNSEEN * max(float(size.max()), 1e-300)
    rank = int(np.linalg.matrix_rank(x[:, affects], rtol=1e-6))
    if rank < np.count_nonzero(affects):
        raise ProblemError(
            "the approach directions of two or more joints always change together, so their backlash cannot be separated; "
            "record a plan of truearm plan characterize"
        )
    inverse = np.linalg.pinv(x[:, affects])
    residual = y - x[:, affects] @ inverse @ y
    freedom = len(y) - len(np.unique(group)) - rank
    variance = float(residual @ residual) / freedom
    fitted = np.full((2, len(affects)), np.nan)
    fitted[:, affects] = inverse @ y, np.sqrt(variance) * np.linalg.norm(inverse, axis=1)
    intervals = (_t_interval(value, sigma, freedom) for value, sigma in fitted.T.tolist())
    return tuple(intervals), tuple(fitted[1].tolist()), variance, freedom


def _deviations(values: Floats, group: Ints) -> Floats:
    """Return values (n, …) minus the mean of their group."""
    member = np.equal.outer(group, np.unique(group)).astype(float)
    return np.asarray(values - member / member.sum(axis=0) @ (member.T @ values))


def _spread(values: Floats, group: Ints) -> Interval:
    """Return the standard deviation about the means of the groups."""
    deviation, freedom = _deviations(values, group), len(values) - len(np.unique(group))
    return variance_interval(float(deviation @ deviation) / freedom, freedom)


def _misfit(fit: tuple[float, int], pure: tuple[float, int]) -> float:
    """Return the probability of so large a lack of fit by chance, from variances and their degrees of freedom."""
    (variance, freedom), (pure_variance, repeats) = fit, pure
    lacking = freedom - repeats
    if lacking < 1 or pure_variance <= 0.0:
        return float("nan")
    ratio = (variance * freedom - pure_variance * repeats) / lacking / pure_variance
    return float(fdtrc(lacking, repeats, max(ratio, 0.0)))


def _t_interval(value: float, sigma: float, freedom: int) -> Interval:
    half = float(stdtrit(freedom, TAILS[1])) * sigma
    return Interval(value, value - half, value + half)


def _without(sigma: Interval, variance: float) -> Interval:
    """Return the standard deviation without a part of the variance, but at least a tenth of it."""
    squares = np.square([sigma.value, sigma.low, sigma.high])
    return Interval(*np.sqrt(np.maximum(squares - variance, 0.01 * squares)).tolist())


def _joint_sigma(backlash: Interval, reading_var: float) -> Interval:
    """Return the standard deviation of a joint's reading: its own noise and half the backlash either way."""
    low, high = sorted(np.abs([backlash.low, backlash.high]).tolist())
    widths = np.array([backlash.value, 0.0 if backlash.low <= 0.0 <= backlash.high else low, high])
    if np.isnan(backlash.value):  # a joint that does not affect the bar
        widths = np.array([0.0, 0.0, np.inf])
    return Interval(*np.sqrt(reading_var + 0.25 * np.square(widths)).tolist())
