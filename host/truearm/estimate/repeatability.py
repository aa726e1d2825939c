r"""Repeatability of a robot from visits to the same poses from different sides: spread, backlash and noise, with intervals.

Visit i of pose g has the length ℓ_i and the mean joint reading q_i, and joint j approached from the side s_ij = ±1 (the
direction of its last motion). The part explained by the readings is subtracted, y_i = ℓ_i − J_g (q_i − q̄_g). The rest
is noise to an identification, which takes the readings as correct. If the links lag their encoders by half the backlash
b,

    y_i = μ_g − ½ Σ_j J_gj s_ij b_j + e_i,

which is a linear regression: it gives b with its t intervals, and the spread of e. Visits to one pose from one side
differ by e alone (pure error), so an F test shows whether b explains the differences between the sides (lack of fit).

Intervals are 95 %: χ² for standard deviations of Gaussian numbers, t for means and regressions, and order statistics
for quantiles.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtr, chdtri, fdtrc, stdtrit

from truearm.errors import ProblemError
from truearm.text import counted
from truearm.types import Floats

LEVEL = 0.95
MISFIT = 1e-3  # a smaller probability of the lack of fit is reported
SAME_POSE = 2e-3  # rad or m in each joint; servo and settling errors are far smaller, and poses differ by more
UNSEEN = 1e-4  # of the largest: below it, a joint's effect on the bar per radian is negligible


class Interval(NamedTuple):
    """An estimate and its 95 % interval; NaN where unknown."""

    value: float
    low: float
    high: float


UNKNOWN = Interval(float("nan"), float("nan"), float("nan"))


@dataclass(frozen=True)
class Visited:
    """n visits to poses.

    ``jac`` (n, j): ∂length/∂joints. ``length_var`` (n,): variance of the mean length from its samples. ``reading_var``
    (n, j): variance of the mean reading, including quantisation.
    """

    length: Floats
    length_var: Floats
    q: Floats
    side: Floats  # (n, j)
    jac: Floats
    reading_var: Floats


@dataclass(frozen=True)
class Repeatability:
    """Repeatability and backlash of a robot.

    ``along`` [m] is the spread of the length at one pose from one side, and ``unexplained`` the part that the readings
    do not explain. ``backlash`` (j) [rad or m] is the full width by which the link lags the encoder; ``backlash_sigma``
    (j) is its standard deviation. ``spread`` (j) is that of the mean reading at one pose from one side, and
    ``difference`` (j) that of the mean reading between the sides, up minus down. ``bar_sigma`` and ``joint_sigma`` (j)
    are the values to give to an identification: see ``repeatability()``. ``n_sides`` counts the combinations of pose and
    approach direction. ``misfit`` is the probability of differences
    between the sides at least this large if backlash were the only cause; NaN if too few visits repeat.
    """

    n_visits: int
    n_poses: int
    n_sides: int
    along: Interval
    unexplained: Interval
    backlash: tuple[Interval, ...]
    backlash_sigma: tuple[float, ...]
    spread: tuple[Interval, ...]
    difference: tuple[Interval, ...]
    misfit: float
    bar_sigma: Interval
    joint_sigma: tuple[Interval, ...]


def repeatability(visited: Visited) -> Repeatability:
    """Return repeatability and backlash from visits. Raises ProblemError if too few of them repeat.

    ``bar_sigma``² is the residual variance of the regression minus the part due to samples and joint readings, which an
    identification counts separately. ``joint_sigma``² is the variance of a mean reading plus b²/4: if the side is
    unknown, the link is off by ±b/2. On average b² is too large by its variance, which errs on the safe side.
    """
    pose = poses_of(visited.q)
    sided = np.all(visited.side != 0.0, axis=1)
    visited, pose = _select(visited, sided), pose[sided]
    approach = _numbered(np.column_stack([pose, visited.side]))
    n, n_poses, n_sides = len(pose), len(np.unique(pose)), len(np.unique(approach))
    if n - n_sides < 3:
        raise ProblemError(
            f"too few repetitions: {counted(n, 'dwell')} with a known approach direction, in {counted(n_sides, 'combination')} of pose and direction; "
            "record a plan of truearm plan characterize, which repeats them"
        )
    jac = _group_means(visited.jac, pose)
    explained = np.sum(jac * (visited.q - _group_means(visited.q, pose)), axis=1)
    y = visited.length - explained
    pure, raw = (_within(values, approach) for values in (y, visited.length))
    width, cov, residual, freedom = _regression(y, -0.5 * jac * visited.side, pose)
    t = _t(freedom)
    sigma_b = np.sqrt(np.diag(cov))
    backlash = tuple(Interval(b, b - t * s, b + t * s) for b, s in zip(width.tolist(), sigma_b.tolist(), strict=True))
    readings = np.nanmean(visited.reading_var, axis=0)
    known = float(np.mean(visited.length_var) + np.mean(np.square(jac) @ readings))
    variance = float(residual @ residual) / freedom
    return Repeatability(
        n_visits=n,
        n_poses=n_poses,
        n_sides=n_sides,
        along=_sigma(raw, n - n_sides),
        unexplained=_sigma(pure, n - n_sides),
        backlash=backlash,
        backlash_sigma=tuple(sigma_b.tolist()),
        spread=tuple(_sigma(_within(column, approach), n - n_sides) for column in visited.q.T),
        difference=tuple(
            _difference(column, pose, side) for column, side in zip(visited.q.T, visited.side.T, strict=True)
        ),
        misfit=_misfit(variance, freedom, pure, n - n_sides),
        bar_sigma=_less(_sigma(variance, freedom), known),
        joint_sigma=tuple(_joint_sigma(*pair) for pair in zip(backlash, readings.tolist(), strict=True)),
    )


def poses_of(q: Floats, tolerance: float = SAME_POSE) -> NDArray[np.int64]:
    """Return the number (n,) of the pose of each visit: visits within the tolerance of a pose's first visit share it."""
    pose = np.full(len(q), -1, dtype=np.int64)
    for i in range(len(q)):
        if pose[i] < 0:
            near = np.all(np.abs(q - q[i]) <= tolerance, axis=1) & (pose < 0)
            pose[near] = pose.max() + 1
    return pose


def mean_interval(values: Floats) -> Interval:
    """Return the mean of independent numbers (n,), ignoring NaN, and its t interval."""
    values = values[np.isfinite(values)]
    if values.size < 2:
        return UNKNOWN
    mean, half = float(np.mean(values)), float(np.std(values, ddof=1) / np.sqrt(values.size))
    half *= _t(values.size - 1)
    return Interval(mean, mean - half, mean + half)


def quantile_interval(values: Floats, share: float) -> Interval:
    """Return a quantile of independent numbers (n,) of any distribution, with an interval between two of them; ignores NaN.

    If n is too small for an order statistic above the quantile, its upper end is infinite.
    """
    values = np.sort(values[np.isfinite(values)])
    n = values.size
    if not n:
        return UNKNOWN
    below = bdtr(np.arange(n + 1), n, share)  # probability that at most this many are below the quantile
    low, high = np.searchsorted(below, [0.5 - 0.5 * LEVEL, 0.5 + 0.5 * LEVEL]).tolist()
    return Interval(
        float(np.quantile(values, share)),
        float(values[low - 1]) if low >= 1 else 0.0,
        float(values[high]) if high < n else float("inf"),
    )


def sigma_interval(variances: Floats) -> Interval:
    """Return the standard deviation from independent estimates (n,) of one variance with unknown degrees of freedom."""
    mean, low, high = mean_interval(variances)
    return Interval(float(np.sqrt(mean)), float(np.sqrt(max(low, 0.0))), float(np.sqrt(high)))


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


def _select(visited: Visited, rows: NDArray[np.bool_]) -> Visited:
    return Visited(**{name: getattr(visited, name)[rows] for name in Visited.__dataclass_fields__})


def _numbered(rows: Floats) -> NDArray[np.int64]:
    """Return the number (n,) of each row among the distinct ones."""
    return np.asarray(np.unique(rows, axis=0, return_inverse=True)[1]).reshape(-1)


def _group_means(values: Floats, group: NDArray[np.int64]) -> Floats:
    """Return the mean of its group for each row."""
    _, number, count = np.unique(group, return_inverse=True, return_counts=True)
    number = number.reshape(-1)
    sums = np.zeros((len(count), *values.shape[1:]))
    np.add.at(sums, number, values)
    return np.asarray((sums.T / count).T[number])


def _within(values: Floats, group: NDArray[np.int64]) -> float:
    """Return the variance about the means of the groups."""
    deviation = values - _group_means(values, group)
    return float(deviation @ deviation) / (len(values) - len(np.unique(group)))


def _regression(y: Floats, x: Floats, pose: NDArray[np.int64]) -> tuple[Floats, Floats, Floats, int]:
    """Return coefficients (j,), their covariance (j, j), residuals (n,) and degrees of freedom; NaN for empty columns."""
    y, x = y - _group_means(y, pose), x - _group_means(x, pose)
    size = np.linalg.norm(x, axis=0)
    seen = size > UNSEEN * max(float(size.max()), 1e-300)
    basis, root = np.linalg.qr(x[:, seen])
    if np.linalg.cond(root) > 1e6:
        raise ProblemError(
            "the approach directions of two or more joints always change together, so their backlash cannot be separated; "
            "record a plan of truearm plan characterize"
        )
    solution = np.linalg.solve(root, basis.T @ y)
    residual = y - x[:, seen] @ solution
    freedom = len(y) - len(np.unique(pose)) - int(seen.sum())
    inverse = np.linalg.inv(root)
    coefficient, cov = np.full(x.shape[1], np.nan), np.full((x.shape[1], x.shape[1]), np.nan)
    coefficient[seen] = solution
    cov[np.ix_(seen, seen)] = inverse @ inverse.T * float(residual @ residual) / freedom
    return coefficient, cov, residual, freedom


def _difference(q: Floats, pose: NDArray[np.int64], side: Floats) -> Interval:
    """Return the difference of one joint's readings (n,) between approaches from below and from above."""
    width, cov, _, freedom = _regression(q, 0.5 * side[:, None], pose)
    half = _t(freedom) * float(np.sqrt(cov[0, 0]))
    return Interval(float(width[0]), float(width[0]) - half, float(width[0]) + half)


def _misfit(variance: float, freedom: int, pure: float, pure_freedom: int) -> float:
    """Return the probability of so large a lack of fit by chance."""
    lacking = freedom - pure_freedom
    if lacking < 1 or pure <= 0.0:
        return float("nan")
    ratio = (variance * freedom - pure * pure_freedom) / lacking / pure
    return float(fdtrc(lacking, pure_freedom, max(ratio, 0.0)))


def _t(freedom: int) -> float:
    return float(stdtrit(freedom, 0.5 + 0.5 * LEVEL))


def _sigma(variance: float, freedom: int) -> Interval:
    """Return the standard deviation for an estimate of the variance with the given degrees of freedom."""
    low, high = chdtri(freedom, np.array([0.5 - 0.5 * LEVEL, 0.5 + 0.5 * LEVEL]))
    return Interval(*(float(np.sqrt(variance * freedom / q)) for q in (freedom, low, high)))


def _less(sigma: Interval, variance: float) -> Interval:
    """Return sigma without a part that is counted elsewhere, at least a tenth, so that no row has excessive weight."""
    return Interval(*(float(np.sqrt(max(value**2 - variance, (0.1 * value) ** 2))) for value in sigma))


def _joint_sigma(backlash: Interval, reading: float) -> Interval:
    """Return the standard deviation of a joint's reading: its own noise and half the backlash either way."""
    if not np.isfinite(backlash.value):  # a joint that does not affect the bar
        own = float(np.sqrt(reading))
        return Interval(own, own, float("inf"))
    low = 0.0 if backlash.low <= 0.0 <= backlash.high else min(abs(backlash.low), abs(backlash.high))
    high = max(abs(backlash.low), abs(backlash.high))
    squares = (backlash.value**2, low**2, high**2)
    return Interval(*(float(np.sqrt(reading + 0.25 * square)) for square in squares))
