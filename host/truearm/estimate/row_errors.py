"""What each row of a fit shows: its distance from the others, its error without its pose, and its share of declared noise.

One walk over the whitened rows serves all three. With the leverage H = J P Jᵀ of all rows of a pose together, the fit
without them leaves the residual (I − H)⁻¹e to first order. No refit is needed.

Least squares absorbs the part H of rows with unit noise, so a row's residual has the expected mean square tr(L (I − H)
Lᵀ). L is the root of its declared covariance. Anything above that is unexplained.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.estimate.problem import Problem
from truearm.estimate.whitened_rows import (
    by_pose,
    distance_without,
    gate,
    in_units,
    leverages,
    seen_by,
    solve_semidefinite,
    whitened_blocks,
)
from truearm.kinds.group import unit_columns
from truearm.results import ResidualParts
from truearm.types import Floats, Indices, Residuals
from truearm.units import UNITS


class RowErrors(NamedTuple):
    """Figures of n rows, NaN for those that are not judged; errors by SI unit."""

    distance: Floats  # (n,) from the prediction by all other rows, in σ
    beyond: NDArray[np.bool_]  # (n,) farther than one clean row in a million
    left_out: Residuals  # magnitude of the error in a fit without the row's pose; NaN where that is undetermined
    parts: Mapping[str, ResidualParts]  # of the RMS residual: due to declared noise, and the rest


def row_errors(
    problem: Problem, x: Floats, columns: NDArray[np.bool_], root: Floats, weight: Floats, pose: Indices
) -> RowErrors:
    """Judge the rows at x (P,) with the covariance ``root @ root.T`` (k, k) of x[columns].

    ``weight`` (n,) are the rows' weights in the fit; one of weight 0 is predicted, and has no part in the errors.
    ``pose`` (n,) are the numbers of the rows' poses.
    """
    distance, beyond = np.full(problem.n_rows, np.nan), np.zeros(problem.n_rows, dtype=bool)
    left_out, squares = problem.no_residuals(), dict[str, list[Floats]]()
    for blocks in _seen(problem, x, columns, root, pose):
        for row, units, sensitivity, residual, noise_root in blocks:
            leverage = leverages(sensitivity)
            square = distance_without(leverage, residual, weight[row])
            distance[row], beyond[row] = np.sqrt(square), square > gate(residual.shape[1])
            included = weight[row] > 0.0
            unfitted = noise_root[included] @ (np.eye(residual.shape[1]) - leverage[included])
            declared = (unfitted * noise_root[included]).sum(axis=2)
            errors = in_units(noise_root, residual)[included]
            for unit, of_unit in unit_columns(units).items():
                due = np.maximum(declared[:, of_unit].sum(axis=1), 0.0)
                squares.setdefault(unit, []).append(np.stack([due, (errors[:, of_unit] ** 2).sum(axis=1)]))
        _leave_out(left_out, [block.select(weight[block.row] > 0.0) for block in blocks], pose)
    joined = {unit: np.concatenate(squares[unit], axis=1) for unit in UNITS if unit in squares}
    means = {unit: square.mean(axis=1) for unit, square in joined.items() if square.size}
    shares = {u: ResidualParts(math.sqrt(due), math.sqrt(max(total - due, 0.0))) for u, (due, total) in means.items()}
    return RowErrors(distance, beyond, left_out, shares)


def left_out_errors(problem: Problem, x: Floats, columns: NDArray[np.bool_], root: Floats, pose: Indices) -> Residuals:
    """Return the magnitude (n_rows,) of each row's error in a fit without its pose, by SI unit, as ``row_errors`` does."""
    errors = problem.no_residuals()
    for blocks in _seen(problem, x, columns, root, pose):
        _leave_out(errors, blocks, pose)
    return errors


class _Seen(NamedTuple):
    """Rows of one kind: their numbers (n,), units, S as the rows see it (n, w, r), whitened residual and noise root."""

    row: Indices
    units: tuple[str, ...]
    seen: Floats
    residual: Floats
    noise_root: Floats

    def select(self, rows: NDArray[np.bool_]) -> _Seen:
        return self if rows.all() else _Seen(self.row[rows], self.units, *(part[rows] for part in self[2:]))


def _seen(
    problem: Problem, x: Floats, columns: NDArray[np.bool_], root: Floats, pose: Indices
) -> Iterator[list[_Seen]]:
    """Yield the rows in lists of whole poses."""
    for piece in by_pose(problem, pose):
        blocks = whitened_blocks(piece, x, columns)
        yield [
            _Seen(b.row, b.components, seen_by(b.jac, root), b.residual, b.noise_root)
            for b in blocks
            if b.row is not None
        ]


def _leave_out(errors: Residuals, blocks: Sequence[_Seen], pose: Indices) -> None:
    """Set the magnitudes of the rows' errors in fits without their poses."""
    blocks = [block for block in blocks if block.row.size]
    if not blocks:
        return
    numbers = np.concatenate([np.repeat(pose[block.row], block.residual.shape[1]) for block in blocks])
    seen = np.concatenate([block.seen.reshape(block.residual.size, -1) for block in blocks])
    residual = _without_each_pose(numbers, seen, np.concatenate([block.residual.ravel() for block in blocks]))
    ends = np.cumsum([block.residual.size for block in blocks])[:-1]
    for block, own in zip(blocks, np.split(residual, ends), strict=True):
        error = in_units(block.noise_root, own.reshape(block.residual.shape))
        for unit, of_unit in unit_columns(block.units).items():
            errors[unit][block.row] = np.linalg.norm(error[:, of_unit], axis=1)


def _without_each_pose(pose: Indices, sensitivity: Floats, residual: Floats) -> Floats:
    """Return (I − SSᵀ)⁻¹e pose by pose for S = ``sensitivity`` (m, r) and e = ``residual`` (m,); NaN where it is undetermined.

    With more residuals than columns, e + S(I − SᵀS)⁻¹Sᵀe. Poses with equally many residuals are computed together.
    """
    order = np.argsort(pose, kind="stable")
    _, first, count = np.unique(pose[order], return_index=True, return_counts=True)
    out = np.empty_like(residual)
    for size in np.unique(count):
        rows = order[first[count == size][:, None] + np.arange(size)]
        of_poses, e = sensitivity[rows], residual[rows]
        is_wide = size <= of_poses.shape[2]
        turned = of_poses.swapaxes(1, 2)
        inner = of_poses @ turned if is_wide else turned @ of_poses
        right_side = e if is_wide else (turned @ e[..., None])[..., 0]
        solved, determined = solve_semidefinite(np.eye(inner.shape[1]) - inner, right_side)
        without = solved if is_wide else e + (of_poses @ solved[..., None])[..., 0]
        out[rows] = np.where(determined[:, None], without, np.nan)
    return out
