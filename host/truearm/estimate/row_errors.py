"""What each row of a fit shows: its distance from the others, its error without its pose, its share of noise.

One walk over the whitened rows serves all three; no refit is needed. With the noise R of a pose (``pose_noise``), the
residuals e and their leverage H = J P Jᵀ, the fit without the pose leaves R (R − H)⁻¹e, to first order and with
unchanged variances. From the prediction by all other rows, also those of its pose, row i has the squared distance

    f_iᵀ (M_ii)⁻¹ f_i , f = R⁻¹e , M = R⁻¹ − R⁻¹H R⁻¹ .

A fit absorbs the part H R⁻¹ of noise, so a row's residual has the expected mean square tr(L (I − H R⁻¹)_ii Lᵀ) of
declared noise. L is the root of its declared covariance. Anything above that is unexplained.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.estimate.pose_noise import PoseNoise, RowsByPose, pose_rows
from truearm.estimate.problem import Problem
from truearm.estimate.solution import Solution
from truearm.estimate.whitened_rows import distance_without, gate, in_units, leverages, noise_root, solve_semidefinite
from truearm.kinds.group import Group, unit_columns
from truearm.results import ResidualParts
from truearm.types import Floats, Indices, Residuals
from truearm.units import UNITS


class RowErrors(NamedTuple):
    """Figures of n rows, NaN for those that are not judged; errors by SI unit."""

    distance: Floats  # (n,) from the prediction by all other rows, in σ
    beyond: NDArray[np.bool_]  # (n,) farther than one clean row in a million
    width: Indices  # (n,) residuals of a row
    left_out: Residuals  # magnitude of the error in a fit without the row's pose; NaN where that is undetermined
    parts: Mapping[str, ResidualParts]  # of the RMS residual: due to declared noise, and the rest


Judge = Callable[[Solution, Floats], RowErrors]


def judging(problem: Problem, columns: NDArray[np.bool_], pose: Indices) -> Judge:
    """Return ``row_errors`` of fits of x[columns] with the weights (n,) of their rows.

    Those of the last fit are kept.
    """
    last: dict[bytes, RowErrors] = {}

    def judge(solution: Solution, weight: Floats) -> RowErrors:
        fit = solution.x.tobytes() + weight.tobytes()
        if fit not in last:
            last.clear()
            last[fit] = row_errors(problem, solution.x, columns, solution.information.half, weight, pose)
        return last[fit]

    return judge


def row_errors(
    problem: Problem,
    x: Floats,
    columns: NDArray[np.bool_],
    root: Floats,
    weight: Floats,
    pose: Indices,
    noise: PoseNoise | None = None,
) -> RowErrors:
    """Judge the rows at x (P,) with the covariance ``root @ root.T`` (k, k) of x[columns].

    ``weight`` (n,) are the rows' weights in the fit; one of weight 0 is predicted, and has no part in the errors.
    ``pose`` (n,) are the numbers of the rows' poses, and ``noise`` is that of the fit, None as declared.
    """
    distance, width = np.full(problem.n_rows, np.nan), np.ones(problem.n_rows, dtype=np.intp)
    left_out, squares = problem.no_residuals(), dict[str, list[Floats]]()
    pose_number = np.where(weight > 0.0, pose, pose + 1 + pose.max(initial=0))  # a pose of what is predicted alone
    for poses in _poses(problem, x, columns, root, pose_number, noise):
        leverage, residual = leverages(poses.rows[..., :-1]), poses.rows[..., -1:]
        f, absorbed, hat, covariance = residual, leverage, leverage, None
        if noise is not None:
            covariance = poses.covariances(noise)
            inverse = np.linalg.inv(covariance).astype(float)
            f, absorbed = inverse @ residual, leverage @ inverse
            hat = inverse @ absorbed
        expanded = [poses.expanded(array) for array in (residual, f, _without_pose(leverage, residual, covariance))]
        for group, row, declared, place in poses.kinds:
            w = group.sensor_cov.shape[1]
            e, f, alone = (array[:, place].reshape(row.size, w) for array in expanded)
            row_hat = poses.own_blocks(hat, 0.0, place, w)
            if noise is not None:
                precision = poses.own_blocks(inverse, 1.0 / noise.sensor, place, w)
                whitening = np.linalg.inv(np.linalg.cholesky(precision))
                f, row_hat = in_units(whitening, f), whitening @ row_hat @ whitening.swapaxes(1, 2)
            distance[row] = np.sqrt(distance_without(row_hat, f, weight[row]))
            width[row] = w
            fitted, root_declared = weight[row] > 0.0, noise_root(declared)
            unfitted = np.eye(w) - poses.own_blocks(absorbed, 0.0, place, w)
            due = ((root_declared @ unfitted) * root_declared).sum(axis=2)
            errors = in_units(root_declared, e)
            for unit, components in unit_columns(group.COMPONENTS).items():
                shares = np.maximum(due[:, components].sum(axis=1), 0.0), (errors[:, components] ** 2).sum(axis=1)
                squares.setdefault(unit, []).append(np.stack(shares)[:, fitted])
            _note(left_out, group, root_declared, np.where(fitted[:, None], alone, np.nan))
    joined = {unit: np.concatenate(squares[unit], axis=1) for unit in UNITS if unit in squares}
    means = {unit: square.mean(axis=1) for unit, square in joined.items() if square.size}
    parts = {u: ResidualParts(math.sqrt(due), math.sqrt(max(total - due, 0.0))) for u, (due, total) in means.items()}
    return RowErrors(distance, distance**2 > gate(width), width, left_out, parts)


def left_out_errors(problem: Problem, x: Floats, columns: NDArray[np.bool_], root: Floats, pose: Indices) -> Residuals:
    """Return the magnitude (n_rows,) of each row's error in a fit without its pose, by SI unit (``row_errors``)."""
    errors = problem.no_residuals()
    for poses in _poses(problem, x, columns, root, pose, None):
        alone = poses.expanded(_without_pose(leverages(poses.rows[..., :-1]), poses.rows[..., -1:], None))
        for group, row, declared, place in poses.kinds:
            _note(errors, group, noise_root(declared), alone[:, place].reshape(row.size, -1))
    return errors


def _poses(
    problem: Problem, x: Floats, columns: NDArray[np.bool_], root: Floats, pose: Indices, noise: PoseNoise | None
) -> Iterator[RowsByPose]:
    """Yield the table's rows [J S|f] by pose, S the ``root``, on a basis of them and of motions by noise."""
    for poses in pose_rows(problem, x, columns, pose, root, noise is not None):
        if not poses.is_knowledge:
            columns_of = poses.rows if noise is None else np.concatenate([poses.rows, poses.moved], axis=2)
            yield poses.projected(columns_of)


def _note(errors: Residuals, group: Group, noise_root: Floats, whitened: Floats) -> None:
    """Write the magnitudes of a group's ``whitened`` errors (n, w) to their rows, unit by unit."""
    of_rows = in_units(noise_root, whitened)
    for unit, components in unit_columns(group.COMPONENTS).items():
        errors[unit][group.row] = np.linalg.norm(of_rows[:, components], axis=1)


def _without_pose(leverage: Floats, residual: Floats, covariance: Floats | None) -> Floats:
    """Return the residuals R (R − H)⁻¹e (n, w, 1) of fits without each pose.

    NaN where its rows alone determine an unknown.

    ``leverage`` is H (n, w, w), ``residual`` e (n, w, 1), and ``covariance`` R (n, w, w), None for I.
    """
    if covariance is None:
        solved, determined = solve_semidefinite(np.eye(leverage.shape[1]) - leverage, residual[..., 0])
        return np.where(determined[:, None], solved, np.nan)[..., None]
    scale = 1.0 / np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))[..., None]
    unabsorbed = (covariance - leverage) * scale * scale.swapaxes(1, 2)
    solved, determined = solve_semidefinite(unabsorbed, (scale * residual)[..., 0])
    return np.where(determined[:, None, None], covariance @ (scale * solved[..., None]), np.nan)
