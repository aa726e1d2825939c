"""Individual whitened observations, for solvers that weight or judge single observations.

``information.observe`` folds all rows into one triangle at once. A robust loss, the recursive filter and standardised
residuals first need the rows of each observation, w of them for w scalar residuals. These are whitened by C⁻¹ = L Lᵀ,
so that their noise has unit covariance.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import special

from truearm.estimate.information import Information, fold
from truearm.estimate.problem import Problem, blocks, note
from truearm.estimate.residual_noise import residual_cov, whiten
from truearm.estimate.robust import Moments, clean_square, weigh
from truearm.estimate.solvers import Loss
from truearm.types import Floats, Indices, Residuals

GATE_LEVEL = 1e-6  # a clean row is flagged once in a million
ALONE = 1e-9  # 1 − leverage, below which a residual is rounding and has no information


class Block(NamedTuple):
    """Some observations of one kind, linearised and whitened."""

    row: Indices | None  # (n,) rows of the table; None for knowledge, such as distances between sockets
    components: tuple[str, ...]  # w SI units
    jac: Floats  # (n, w, k)
    residual: Floats  # (n, w)
    cov: Floats  # (n, w) or (n, w, w)

    @property
    def noise_root(self) -> Floats:
        """Return L (n, w, w): L times whitened residuals is in the components' units again."""
        return noise_root(self.cov)


def whitened_blocks(
    problem: Problem, x: Floats, columns: NDArray[np.bool_], residual: Residuals | None = None
) -> Iterator[Block]:
    """Return all observations at x (P,), derivatives by x[columns]; ``residual`` receives the residuals by unit."""
    for block in blocks(problem):
        lin = block.evaluate(problem.chain, x)
        if residual is not None:
            note(block, lin.residual, residual)
        cov = residual_cov(block.sensor_cov, lin.jac_joints, problem.joint_cov)
        stacked = np.concatenate([lin.jac_by(columns), lin.residual[:, None]], axis=1)
        stacked = stacked.reshape(len(cov), cov.shape[1], -1)
        whiten(stacked.T, cov)
        yield Block(block.row, block.COMPONENTS, stacked[:, :, :-1], stacked[:, :, -1], cov)


def observe_robustly(
    problem: Problem, x: Floats, columns: NDArray[np.bool_], loss: Loss
) -> tuple[Information, Moments, Floats]:
    """Return the same as ``information.observe``, with observations weighted by √w(s) of the loss; χ² is then Σρ(s).

    Also returns the moments for ``robust.sandwich`` and the weights (n_rows,).
    """
    k = int(columns.sum())
    triangle = np.zeros((k + 1, k + 1))
    residual, weights = problem.no_residuals(), np.ones(problem.n_rows)
    moments, chi2, count = Moments(), 0.0, 0
    for block in whitened_blocks(problem, x, columns, residual):
        length, width = np.linalg.norm(block.residual, axis=1), block.residual.shape[1]
        weighed = weigh(Loss.LINEAR if block.row is None else loss, length, width)
        if block.row is not None:
            weights[block.row] = weighed.weight
        moments = moments.plus(weighed, length, width)
        chi2 += float(weighed.cost.sum())
        count += block.residual.size
        stacked = (
            np.concatenate([block.jac, block.residual[..., None]], axis=2) * np.sqrt(weighed.weight)[:, None, None]
        )
        triangle = fold(triangle, stacked.reshape(-1, k + 1))
    return Information(triangle[:k, :k], triangle[:k, k], chi2, count, residual), moments, weights


def weighted_chi2(problem: Problem, x: Floats, loss: Loss) -> tuple[float, int]:
    """Return χ² at x (P,) with all squares weighted by a robust loss, and the number of residuals.

    It is in units of clean observations: for these, its mean is that of χ² without weights.
    """
    nothing, chi2, count = np.zeros(x.size, dtype=bool), 0.0, 0
    for block in whitened_blocks(problem, x, nothing):
        block_loss = Loss.LINEAR if block.row is None else loss
        length, width = np.linalg.norm(block.residual, axis=1), block.residual.shape[1]
        weight = weigh(block_loss, length, width).weight
        chi2 += float(weight @ length**2) * (
            1.0 if block_loss is Loss.LINEAR else width / clean_square(block_loss, width)
        )
        count += block.residual.size
    return chi2, count


def leverages(sensitivity: Floats) -> Floats:
    """Return H (n, w, w) of ``sensitivity`` (n, w, r) = J S, with P = S Sᵀ."""
    return np.asarray(sensitivity @ sensitivity.swapaxes(1, 2))


def distance_without(leverage: Floats, residual: Floats, weight: Floats) -> Floats:
    """Return the squared distance (n,) of each observation from its prediction by all others.

    It is χ² of the observation's width for a clean one. With the ``leverage`` H = J P Jᵀ (n, w, w), a removed
    observation leaves the residual (I − ωH)⁻¹e, whose covariance is then I + H(I − ωH)⁻¹. The distance is

        eᵀ [(I − ωH)(I − ωH + H)]⁻¹ e .

    An observation that alone determines an unknown has no residual along it: nothing contradicts it.
    """
    clear = np.eye(leverage.shape[1]) - weight[:, None, None] * leverage
    solved, _ = solve_semidefinite(clear @ (clear + leverage), residual)
    return np.asarray((solved * residual).sum(axis=1))


def solve_semidefinite(matrix: Floats, vector: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Solve n small systems with semidefinite matrices (n, w, w) for vectors (n, w) in their ranges.

    Returns a solution (n, w) each, and whether it is the only one (n,). The systems are eliminated together, which is
    ten times as fast as one after the other.
    """
    augmented = np.concatenate([matrix, vector[:, :, None]], axis=2).transpose(1, 2, 0).copy()
    regular = np.ones(len(matrix), dtype=bool)
    for i in range(len(augmented)):
        pivot = augmented[i, i].copy()
        regular &= pivot > ALONE
        row = augmented[i, i:] / np.where(pivot > ALONE, pivot, np.inf)
        augmented[:, i:] -= augmented[:, i, None] * row
        augmented[i, i:] = row
    return augmented[:, -1].T, regular


def gate(width: NDArray[np.intp] | int) -> Floats:
    """Return the squared distance that a clean row of ``width`` residuals exceeds with probability GATE_LEVEL."""
    widths, index = np.unique(width, return_inverse=True)
    return np.asarray(special.chdtri(widths, GATE_LEVEL)[index])


def only(problem: Problem, included: NDArray[np.bool_]) -> Problem:
    """Return the problem without the table's rows that are not ``included`` (n_rows,); rows keep their numbers.

    The problem of all rows is the problem itself, not a copy.
    """
    if included.all():
        return problem
    groups = (group if group.row is None else group.take(included[group.row]) for group in problem.groups)
    return replace(problem, groups=tuple(group for group in groups if len(group.sensor_cov)))


def noise_root(cov: Floats) -> Floats:
    """Return L (n, w, w) for variances (n, w) or covariances (n, w, w)."""
    if cov.ndim == 3:
        return np.asarray(np.linalg.cholesky(cov))
    out = np.zeros((*cov.shape, cov.shape[1]))
    out[:, range(cov.shape[1]), range(cov.shape[1])] = np.sqrt(cov)
    return out


def in_units(noise_root: Floats, whitened: Floats) -> Floats:
    """Return ``noise_root`` (n, w, w) times vectors (n, w): whitened ones in the units of the components."""
    return np.asarray((noise_root @ whitened[..., None])[..., 0])
