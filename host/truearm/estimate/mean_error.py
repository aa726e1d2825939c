"""The mean error at poses that were not fitted, with its interval; valid even where the model leaves errors unexplained.

The covariance of the parameters is based on the declared noise, so it does not include errors missing from the model.
Held-out rows do show them. Without held-out rows, each pose is left out in turn (``row_errors``).

Rows of one pose have correlated errors, so poses are counted: the interval is that of the mean of the poses' mean
errors (Student's t).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy import special

from truearm.results import MeanError
from truearm.types import Floats, Indices, Residuals

LEVEL = 0.95
LEAST_POSES = 2


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
