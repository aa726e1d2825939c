"""The mean error at poses that were not fitted, with its interval; valid even where the model leaves errors unexplained.

The covariance of the parameters is based on the declared noise, so it does not include errors missing from the model.
Held-out rows do show them. Without held-out rows, each pose is left out in turn: with the leverage H = J P Jᵀ of all
its rows together, the fit without them leaves the residual (I − H)⁻¹e, to first order, and no refit is needed.

Rows of one pose have correlated errors, so poses are counted: the interval is that of the mean of the poses' mean
errors (Student's t).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy import special

from truearm.estimate.problem import Problem
from truearm.estimate.whitened_rows import ALONE, whitened_blocks
from truearm.kinds.group import unit_columns
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
        judged = np.isfinite(errors)
        _, number, count = np.unique(pose[judged], return_inverse=True, return_counts=True)
        if count.size < LEAST_POSES:
            continue
        by_pose = np.bincount(number.ravel(), np.abs(errors[judged])) / count
        half = float(special.stdtrit(count.size - 1, (1.0 + LEVEL) / 2.0) * by_pose.std(ddof=1) / np.sqrt(count.size))
        mean = float(by_pose.mean())
        means[unit] = MeanError(mean, max(mean - half, 0.0), mean + half, int(count.size), held_out)
    return means


def left_out_errors(
    problem: Problem, x: Floats, columns: NDArray[np.bool_], covariance_root: Floats, pose: Indices
) -> Residuals:
    """Return the magnitude (n_rows,) of each row's error in a fit without its pose, by SI unit.

    NaN if leaving out the pose makes something undetermined.
    """
    # J S takes the place of J block by block: with many rows, both of all blocks would be tens of megabytes each.
    blocks = [
        block._replace(jac=block.jac @ covariance_root)
        for block in whitened_blocks(problem, x, columns)
        if block.row is not None
    ]
    errors = problem.no_residuals()
    if not blocks:  # no parameter is free
        return errors
    numbers = np.concatenate([np.repeat(pose[block.row], block.residual.shape[1]) for block in blocks])
    jac = np.concatenate([block.jac.reshape(block.residual.size, covariance_root.shape[1]) for block in blocks])
    residual = np.concatenate([block.residual.ravel() for block in blocks])
    order = np.argsort(numbers, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(numbers[order])) + 1):
        pose_jac = jac[rows]
        if rows.size <= pose_jac.shape[1]:
            matrix, error = np.eye(rows.size) - pose_jac @ pose_jac.T, residual[rows]
        else:  # (I − SSᵀ)⁻¹e = e + S(I − SᵀS)⁻¹Sᵀe, with S = pose_jac
            matrix, error = np.eye(pose_jac.shape[1]) - pose_jac.T @ pose_jac, pose_jac.T @ residual[rows]
        determined = not matrix.size or np.linalg.eigvalsh(matrix)[0] > ALONE
        error = np.linalg.solve(matrix, error) if determined else np.full(error.shape, np.nan)
        residual[rows] = error if rows.size <= pose_jac.shape[1] else residual[rows] + pose_jac @ error
    first = 0
    for block in blocks:
        n, width = block.residual.shape
        error = (block.noise_root @ residual[first : first + n * width].reshape(n, width, 1))[..., 0]
        for unit, columns_of_unit in unit_columns(block.components).items():
            errors[unit][block.row] = np.linalg.norm(error[:, columns_of_unit], axis=1)
        first += n * width
    return errors
