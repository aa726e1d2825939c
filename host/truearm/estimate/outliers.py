"""Outlying rows, left out of a least-squares fit one after the other according to their prediction by all other rows.

An outlier pushes its neighbours beyond the gate. As in the recursive solver, each round therefore leaves out only rows
at least half as far as the farthest. The rest is fitted again, and rows back within the gate return. Where the usual
row errs by more than its declared noise, the gate is wider in proportion.

If more than MOST of all rows are left out or beyond the gate of their declared noise, or more than LONGEST_RUN
consecutive ones, the model is wrong. Something moved, a label is wrong, or the noise is not as declared. Joint laws may
be what is missing then, so the rows that are farthest are still named if they ``matter``: a fit with laws decides
(``law_outliers``).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy import special

from truearm.estimate.fit import fit
from truearm.estimate.information import observe
from truearm.estimate.problem import Problem
from truearm.estimate.solution import Options, Solution, goodness_of
from truearm.estimate.whitened_rows import gate, only, squared_distances, whitened_blocks
from truearm.results import Figures, OtherFit
from truearm.types import Floats, Indices, Mask

MOST = 0.05  # of the rows
LONGEST_RUN = 3
MATTERING = 0.3  # of all squared distances: without such rows, the noise is smaller by a sixth
NEAR_FARTHEST = 0.25  # of the farthest squared distance: half the distance
MAX_ROUNDS = 50
GROSS = 10.0  # times the median row of its kind: beyond the errors of a robot that is merely uncalibrated
GROSS_ROUNDS = 5
MEDIAN_SPREAD = 2.33  # relative σ of the median of n squares of one residual each, times √n; of wider rows it is less


def gross_rows(problem: Problem, columns: Mask, x: Floats) -> tuple[Mask, Floats]:
    """Return the rows (n_rows,) to exclude from the start of a fit, and x (P,) without them.

    ``x`` is a fit of x[columns] to all rows. No row is gross if there are too many, or too many in sequence, for
    outliers.
    """
    gross, x_others = np.zeros(problem.n_rows, dtype=bool), x
    for _ in range(GROSS_ROUNDS):
        size = _times_the_median(problem, x_others, columns, gross)
        candidates = size > GROSS
        if np.array_equal(candidates, gross):
            break
        if not single(candidates):
            return np.zeros(problem.n_rows, dtype=bool), x
        gross = candidates
        if columns.any():
            x_others = fit(only(problem, ~gross), columns, x_others, Options()).x
    return gross, x_others


def _times_the_median(problem: Problem, x: Floats, columns: Mask, gross: Mask) -> Floats:
    """Return each row's whitened residual (n_rows,) over the median of those of its kind that are not gross."""
    size = np.zeros(problem.n_rows)
    for block in whitened_blocks(problem, x, columns):
        if block.row is not None:
            length = np.linalg.norm(block.residual, axis=1)
            accepted = length[~gross[block.row]]
            usual = float(np.median(accepted)) if accepted.size else 0.0
            size[block.row] = length / usual if usual > 0.0 else 0.0
    return size


def single(bad: Mask) -> bool:
    """Return whether so many of all rows can be outliers."""
    return bool(bad.sum() <= MOST * bad.size) and longest_run(bad) <= LONGEST_RUN


class Rejection(NamedTuple):
    """A fit without outliers, which have weight 0 in it."""

    found: Solution
    explained: bool  # by the declared noise, except for a share MOST of the rows


def without_outliers(
    problem: Problem, columns: Mask, solution: Solution, options: Options, gross: Mask
) -> Rejection | None:
    """Return the fit without outliers; None if there are none, or if the model is wrong.

    ``solution`` is a converged least-squares fit over x[columns] of all rows except those that are ``gross`` (n_rows,).
    """
    n = problem.n_rows
    included = ~gross
    options = options._replace(on_step=None)
    refit, seen_sets, settled = solution, set(), True
    for _ in range(MAX_ROUNDS):
        square, width = squared_distances(problem, refit.x, columns, refit.information.half, included.astype(float))
        chosen = within(square, gate(width) * misfit(square, width, included), included)
        if np.array_equal(chosen, included):
            break
        if (~chosen).sum() > MOST * n or chosen.tobytes() in seen_sets:
            settled = False  # where the misfit varies, clean rows follow those that are farthest
            break
        seen_sets.add(chosen.tobytes())
        included = chosen
        refit = fit(only(problem, included), columns, refit.x, options)
        if refit.status != "converged":
            return None
    else:
        return None
    if included.all() or not single(~included):
        return None
    explained = settled and bool((square > gate(width)).sum() <= MOST * n)
    if not explained and not matter(square, ~included):
        return None
    without = weightless(
        problem, columns, refit._replace(iterations=solution.iterations, message=solution.message), included
    )
    return Rejection(without, explained)


def within(distance: Floats, limit: Floats, included: Mask) -> Mask:
    """Return the rows for the next round: without the farthest, and with those that are back within the gate."""
    ratio = distance / limit
    worst = ratio[included].max(initial=0.0)
    leaving = included & (ratio > 1.0) & (ratio >= NEAR_FARTHEST * worst)
    returning = ~included & (ratio <= 1.0)
    return np.asarray((included & ~leaving) | returning)


def matter(square: Floats, out: Mask) -> bool:
    """Return whether rows bend a fit: whether they have a large share of the squared distances (n,).

    Where a model misfits, or real noise has long tails, a few clean rows are beyond any gate, and change nothing.
    """
    return bool(square[out].sum() > MATTERING * square.sum())


def weightless(problem: Problem, columns: Mask, solution: Solution, included: Mask) -> Solution:
    """Return a fit of the ``included`` rows (n_rows,) with the residuals of all rows, of which the others have weight 0."""
    information = solution.information._replace(residual=observe(problem, solution.x, columns).residual)
    return solution._replace(information=information, weight=included.astype(float))


def fit_with_all(problem: Problem, columns: Mask, complete: Solution, solution: Solution) -> OtherFit:
    """Return the fit of all rows, to compare with the one without outliers."""
    rms = {unit: figures.rms for unit, figures in Figures.by_unit(complete.information.residual).items()}
    reduced = goodness_of(problem, columns, complete).reduced
    return OtherFit(int((solution.weight == 0.0).sum()), complete.x, rms, reduced)


def misfit(square: Floats, width: Indices, included: Mask) -> Floats:
    """Return by how much (n,) the median of the ``included`` squared distances of each width exceeds that of noise, at least 1.

    The usual row errs in proportion, so that a row as far beyond the gate is no outlier. What chance may add to the
    median, two of its standard deviations, is taken off.
    """
    times = np.ones(square.size)
    for w in np.unique(width):
        of_width = included & (width == w)
        if of_width.any():
            usual = float(np.median(square[of_width])) / float(special.chdtri(w, 0.5))
            times[width == w] = max(1.0, usual / (1.0 + 2.0 * MEDIAN_SPREAD / math.sqrt(of_width.sum())))
    return times


def longest_run(flags: Mask) -> int:
    """Return the length of the longest run of set flags."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]])))
    return int((edges[1::2] - edges[::2]).max(initial=0))
