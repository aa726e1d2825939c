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
from truearm.estimate.whitened_rows import ALONE, by_pose, whitened_blocks
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
    errors = problem.no_residuals()
    for part in by_pose(problem, pose):
        blocks = list(whitened_blocks(part, x, columns))
        if not blocks:
            continue
        numbers = np.concatenate([np.repeat(pose[block.row], block.residual.shape[1]) for block in blocks])
        seen = np.concatenate([(block.jac @ covariance_root).reshape(block.residual.size, -1) for block in blocks])
        residual = np.concatenate([block.residual.ravel() for block in blocks])
        residual = _without_each_pose(numbers, seen, residual)
        of_blocks = np.split(residual, np.cumsum([block.residual.size for block in blocks])[:-1])
        for block, own in zip(blocks, of_blocks, strict=True):
            error = (block.noise_root @ own.reshape(*block.residual.shape, 1))[..., 0]
            for unit, of_unit in unit_columns(block.components).items():
                errors[unit][block.row] = np.linalg.norm(error[:, of_unit], axis=1)
    return errors


def _without_each_pose(pose: Indices, seen: Floats, residual: Floats) -> Floats:
    """Return (I − SSᵀ)⁻¹e pose by pose for S = ``seen`` (m, r) and e = ``residual`` (m,); NaN where it is undetermined.

    With more residuals than columns, e + S(I − SᵀS)⁻¹Sᵀe. Poses with equally many residuals are computed together.
    """
    order = np.argsort(pose, kind="stable")
    _, first, count = np.unique(pose[order], return_index=True, return_counts=True)
    out = np.empty_like(residual)
    for size in np.unique(count):
        rows = order[first[count == size][:, None] + np.arange(size)]
        own, e = seen[rows], residual[rows][..., None]
        turned = own.swapaxes(1, 2)
        few = size <= own.shape[2]
        inner = own @ turned if few else turned @ own
        values, vectors = np.linalg.eigh(np.eye(inner.shape[1]) - inner)
        determined = values.min(axis=1, initial=1.0)[:, None, None] > ALONE
        values = np.where(values > ALONE, values, np.nan)[..., None]
        solved = vectors @ ((vectors.swapaxes(1, 2) @ (e if few else turned @ e)) / values)
        out[rows] = np.where(determined, solved if few else e + own @ solved, np.nan)[..., 0]
    return out
