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
    out = {}
    for unit, of in error.items():
        some = np.isfinite(of)
        _, number, count = np.unique(pose[some], return_inverse=True, return_counts=True)
        if count.size < LEAST_POSES:
            continue
        means = np.bincount(number.ravel(), np.abs(of[some])) / count
        half = float(special.stdtrit(count.size - 1, (1.0 + LEVEL) / 2.0) * means.std(ddof=1) / np.sqrt(count.size))
        mean = float(means.mean())
        out[unit] = MeanError(mean, max(mean - half, 0.0), mean + half, int(count.size), held_out)
    return out


def left_out_errors(
    problem: Problem, x: Floats, columns: NDArray[np.bool_], covariance_root: Floats, pose: Indices
) -> Residuals:
    """Return the magnitude (n_rows,) of each row's error in a fit without its pose, by SI unit.

    NaN if leaving out the pose makes something undetermined.
    """
    # J S takes the place of J block by block: with many rows, both of all blocks would be tens of megabytes each.
    parts = [
        block._replace(jac=block.jac @ covariance_root)
        for block in whitened_blocks(problem, x, columns)
        if block.row is not None
    ]
    out = problem.no_residuals()
    if not parts:  # no parameter is free
        return out
    numbers = np.concatenate([np.repeat(pose[block.row], block.residual.shape[1]) for block in parts])
    seen = np.concatenate([block.jac.reshape(block.residual.size, covariance_root.shape[1]) for block in parts])
    left = np.concatenate([block.residual.ravel() for block in parts])
    order = np.argsort(numbers, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(numbers[order])) + 1):
        own = seen[rows]
        if rows.size <= own.shape[1]:
            rest, error = np.eye(rows.size) - own @ own.T, left[rows]
        else:  # (I − SSᵀ)⁻¹e = e + S(I − SᵀS)⁻¹Sᵀe, with S = own
            rest, error = np.eye(own.shape[1]) - own.T @ own, own.T @ left[rows]
        determined = not rest.size or np.linalg.eigvalsh(rest)[0] > ALONE
        error = np.linalg.solve(rest, error) if determined else np.full(error.shape, np.nan)
        left[rows] = error if rows.size <= own.shape[1] else left[rows] + own @ error
    at = 0
    for block in parts:
        n, width = block.residual.shape
        error = (block.noise_root @ left[at : at + n * width].reshape(n, width, 1))[..., 0]
        for unit, of in unit_columns(block.components).items():
            out[unit][block.row] = np.linalg.norm(error[:, of], axis=1)
        at += n * width
    return out
