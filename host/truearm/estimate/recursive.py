"""Recursive estimation (Renders 1991, II-F): one observation at a time, with a gate against outliers.

docs/explanation/estimation.md has the formulas: the paper's (18) and (20), corrected, with P = S Sᵀ.

A pass processes every row once, all linearised at one x, from the prior. That x is where the batch fit of the same rows
ends, so no data count twice, and the pass moves it no further. (``renders1991`` has the paper's III-E, which linearises
anew where a pass ends.)

Live, a row would be compared with those before it. The decision about outliers compares each row with all others. Each
round leaves out rows beyond the gate that are at least half as far as the farthest.

``update`` needs the filter and one row, ``run`` all rows. P(0) must be finite: an unknown without a prior starts with
``DIFFUSE``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.estimate.fit import fit
from truearm.estimate.outliers import settled, weightless, within
from truearm.estimate.problem import Problem
from truearm.estimate.row_errors import judging
from truearm.estimate.solution import Options, Solution, prior_error
from truearm.estimate.whitened_rows import gate, whitened_blocks
from truearm.types import Floats, Indices, Mask

DIFFUSE = 10.0  # σ of an unknown without a prior; 1e5 times what millimetre work would leave, 1e-10 in the result


class Filter(NamedTuple):
    """The estimate after some rows: correction Δ and square root S of its covariance P = S Sᵀ."""

    delta: Floats  # (k,)
    root: Floats  # (k, k)


class WhitenedRow(NamedTuple):
    """A whitened observation linearised at one x."""

    number: int  # row of the table; −1: knowledge (a known distance), not subject to the gate
    jac: Floats  # (w, k)
    residual: Floats  # (w,)


def start(mean_minus_x: Floats, sigma: Floats) -> Filter:
    """Return the prior: Δ(0) = mean − x (k,), P(0) = diag(σ²); an infinite σ becomes ``DIFFUSE`` about x itself."""
    has_prior = np.isfinite(sigma)
    return Filter(np.where(has_prior, mean_minus_x, 0.0), np.diag(np.where(has_prior, sigma, DIFFUSE)))


def update(state: Filter, jac: Floats, residual: Floats) -> tuple[Filter, Floats, float]:
    """Process one observation of w whitened rows: jac (w, k), residual (w,).

    Returns the new filter, the innovation (w,) and its squared Mahalanobis distance. Rows are independent after
    whitening, so they are processed one by one, and the distance is the sum of ν²/v over them. Measured: 18 µs per
    scalar row at 60 unknowns.
    """
    innovations = residual - jac @ state.delta
    delta, root, distance = state.delta, state.root, 0.0
    for j, r in zip(jac, residual, strict=True):
        projected = j @ root
        variance = projected @ projected + 1.0
        ahead = root @ projected
        innovation = r - j @ delta
        distance += innovation * innovation / variance
        delta = delta + ahead * (innovation / variance)
        root = root - np.multiply.outer(ahead / (variance + np.sqrt(variance)), projected)
    return Filter(delta, root), innovations, float(distance)


def run(state: Filter, rows: Sequence[WhitenedRow], included: Mask) -> tuple[Filter, Floats]:
    """Process all rows in order; rows of the table that are not ``included`` (n_rows,) do not change the filter.

    Returns the filter, and the squared distance (n,) of each row from its prediction by those before it.
    """
    distance = np.zeros(len(rows))
    for i, row in enumerate(rows):
        updated, _, distance[i] = update(state, row.jac, row.residual)
        if row.number < 0 or included[row.number]:
            state = updated
    return state, distance


def solve(problem: Problem, columns: NDArray[np.bool_], x: Floats, options: Options) -> Solution:
    """Estimate recursively over x[columns] from x (P,); rows beyond the gate have weight 0 in the result."""
    solution, included = fit(problem, columns, x, options), np.ones(problem.n_rows, dtype=bool)
    iterations = solution.iterations
    if solution.status == "converged":
        judge = judging(problem, columns, np.arange(problem.n_rows))
        choice = settled(problem, columns, solution, included.astype(float), _by_gate, 1.0, options, judge)
        solution, included = choice.fit, choice.included
        if choice.is_stable:
            rows = rows_of(problem, solution.x, columns)
            state, _ = run(start(*prior_error(problem, columns, solution.x)), rows, included)
            message = f"converged; {(~included).sum()} of {included.size} observations were left out as outliers"
            solution = solution._replace(message=message, covariance=state.root @ state.root.T)
        elif solution.status == "converged":
            message = "from pass to pass, other rows are left out as outliers"
            solution = solution._replace(status="stalled", message=message)
    return weightless(problem, columns, solution._replace(iterations=iterations), included)


def _by_gate(square: Floats, width: Indices, included: Mask) -> Mask:
    return within(square, gate(width), included)


def rows_of(problem: Problem, x: Floats, columns: NDArray[np.bool_]) -> list[WhitenedRow]:
    """Return all observations at x (P,) in the order of the table, preceded by prior knowledge."""
    rows: list[WhitenedRow] = []
    for block in whitened_blocks(problem, x, columns):
        numbers = [-1] * len(block.residual) if block.row is None else block.row.tolist()
        rows += map(WhitenedRow, numbers, block.jac, block.residual)
    return sorted(rows, key=lambda row: row.number)
