"""The mean error at poses that were not fitted, with its interval, and whether it is less than the nominal robot's.

The covariance of the parameters is based on the declared noise, so it does not include errors missing from the model.
Held-out rows do show them. Without held-out rows, each pose is left out in turn (``row_errors``).

Rows of one pose have correlated errors, so poses are counted: the interval is that of the mean of the poses' mean
errors (Student's t).

The calibrated and the nominal robot, with base and tool placed, are compared pose by pose. d is the mean magnitude of a
pose's errors after the calibration, less that before. Its magnitude is at most the distance between the two predictions,
so no outlier dominates. t is the mean of d in its standard errors. The calibration is better if t is below the quantile
of Student's t for CHANCE, and worse, and refused, if t is above that for 1 − CHANCE. Otherwise the poses show no
difference. With residuals in several units, a robot that is better in one of them is better.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy import special

from truearm.estimate.circumstances import poses
from truearm.kinds.table import ObservationTable
from truearm.results import Estimate, Gain, MeanChange, MeanError, Unusable
from truearm.types import Floats, Indices, Residuals

LEVEL = 0.95
LEAST_POSES = 2
CHANCE = 0.05  # of poses that seem to differ
SMALLEST = 1e-9  # m, rad: rounding of exact data is less


def mean_errors(error: Residuals, pose: Indices, held_out: bool) -> Mapping[str, MeanError]:
    """Return mean errors by SI unit, from the errors (n,) of rows (NaN for none) and the numbers (n,) of their poses.

    Empty for fewer than two poses.
    """
    means = {}
    for unit, errors in error.items():
        (by_pose,) = pose_means(pose, errors)
        n = by_pose.size
        if n < LEAST_POSES:
            continue
        half = float(special.stdtrit(n - 1, (1.0 + LEVEL) / 2.0) * by_pose.std(ddof=1) / np.sqrt(n))
        mean = float(by_pose.mean())
        means[unit] = MeanError(mean, max(mean - half, 0.0), mean + half, n, held_out)
    return means


def pose_means(pose: Indices, *errors: Floats) -> list[Floats]:
    """Return the mean magnitude of each of some errors (n,) at every pose that has rows with all of them."""
    judged = np.isfinite(errors).all(axis=0)
    _, number, count = np.unique(pose[judged], return_inverse=True, return_counts=True)
    return [np.bincount(number.ravel(), np.abs(error[judged])) / count for error in errors]


def with_gain(table: ObservationTable, estimate: Estimate) -> Estimate:
    """Return the estimate with its gain, and as not usable if it is worse than the nominal robot.

    Unchanged if it is not usable already, or did not converge: then its errors say nothing.
    """
    if estimate.unusable or estimate.status != "converged":
        return estimate
    changes = mean_changes(estimate.unfitted_error_before, estimate.unfitted_error, poses(table))
    estimate = replace(estimate, mean_change=changes)
    return replace(estimate, unusable=Unusable.WORSE) if gain_of(changes) is Gain.WORSE else estimate


def gain_of(changes: Mapping[str, MeanChange]) -> Gain | None:
    """Return the gain over all units: that of the best one; None if there is nothing to compare."""
    gains = {change.gain for change in changes.values()}
    order = (Gain.BETTER, Gain.WORSE, Gain.NONE)
    return next((gain for gain in order if gain in gains), None)


def mean_changes(before: Residuals, after: Residuals, pose: Indices) -> Mapping[str, MeanChange]:
    """Return mean errors by SI unit, from the errors (n,) of rows (NaN for none) and the numbers (n,) of their poses."""
    changes = {}
    for unit in before:
        nominal, calibrated = pose_means(pose, before[unit], after[unit])
        if nominal.size >= LEAST_POSES:
            gain = _gain(calibrated - nominal)
            changes[unit] = MeanChange(float(nominal.mean()), float(calibrated.mean()), nominal.size, gain)
    return changes


def _gain(change: Floats) -> Gain:
    """Return the gain for the changes (n,) of the poses' mean errors."""
    standard_error = float(change.std(ddof=1)) / np.sqrt(change.size)
    threshold = float(special.stdtrit(change.size - 1, 1.0 - CHANCE)) * standard_error
    if change.mean() < -threshold:
        return Gain.BETTER
    return Gain.WORSE if change.mean() > max(threshold, SMALLEST) else Gain.NONE
