"""Outlying rows, left out of a least-squares fit according to their prediction by all other rows.

Fits and choices of rows alternate until the choice no longer changes (``settled``). An outlier pushes its neighbours
beyond the gate, so each round leaves out only rows at least half as far as the farthest, and takes others back. Where
the usual row errs by more than its declared noise, the gate is wider in proportion.

With more than MOST of all rows out, or more than LONGEST_RUN consecutive ones, the model is wrong. Rows that are
farthest are still named if they ``matter``: what is missing may be joint laws, and a fit with them decides
(``joint_laws``).

More rows may be *bad*: they bend a least-squares fit too far. The choice then starts at the fit with the Cauchy loss,
which ends near the good rows. Bad rows are named, not left out, if χ² of all others is in its range, at most MOST_BAD
are bad, and they follow each other no more than by chance.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy import special

from truearm.estimate.fit import fit
from truearm.estimate.information import observe
from truearm.estimate.prediction import moves
from truearm.estimate.problem import Problem
from truearm.estimate.row_errors import Judge, RowErrors
from truearm.estimate.solution import Options, Solution, goodness_of, rms_of
from truearm.estimate.solvers import Loss
from truearm.estimate.uncertainty import Goodness
from truearm.estimate.whitened_rows import gate, only, whitened_blocks
from truearm.model.chain import Chain
from truearm.results import OtherFit
from truearm.types import Floats, Indices, Mask

MOST = 0.05  # of the rows
LONGEST_RUN = 3
MATTERING = 0.3  # of all squared distances: without such rows, the noise is smaller by a sixth
NEAR_FARTHEST = 0.25  # of the farthest squared distance: half the distance
MAX_ROUNDS = 50
GROSS = 10.0  # times the median row of its kind: beyond the errors of a robot that is merely uncalibrated
GROSS_ROUNDS = 5
MOST_BAD = 0.25  # of the rows
LEAST_LEFT = 10.0  # degrees of freedom of the other rows: with fewer, leaving out rows explains anything
HEAVY = 2.0  # times the misfit of the usual row: with less, the whole fit is bad and not some rows
CHANCE = 0.01  # probability of a longer run of bad rows in random order
MEDIAN_SPREAD = 2.33  # relative σ of the median of n squares of one residual each, times √n; of wider rows it is less


def gross_rows(problem: Problem, columns: Mask, x: Floats) -> tuple[Mask, Floats]:
    """Return the rows (n_rows,) to exclude from the start of a fit, and x (P,) without them.

    ``x`` is a fit of x[columns] to all rows. No row is gross if there are too many, or too many in sequence, for
    outliers.
    """
    gross, x_others = np.zeros(problem.n_rows, dtype=bool), x
    for _ in range(GROSS_ROUNDS):
        size = _times_the_median(problem, x_others, gross)
        candidates = size > GROSS
        if np.array_equal(candidates, gross):
            break
        if not single(candidates):
            return np.zeros(problem.n_rows, dtype=bool), x
        gross = candidates
        x_others = fit(only(problem, ~gross), columns, x_others, Options(is_near=True)).x
    return gross, x_others


def _times_the_median(problem: Problem, x: Floats, gross: Mask) -> Floats:
    """Return each row's whitened residual (n_rows,) over the median of those of its kind that are not gross."""
    size = np.zeros(problem.n_rows)
    for block in whitened_blocks(problem, x, np.zeros(x.size, dtype=bool)):
        if block.row is not None:
            length = np.linalg.norm(block.residual, axis=1)
            accepted = length[~gross[block.row]]
            usual = float(np.median(accepted)) if accepted.size else 0.0
            size[block.row] = length / usual if usual > 0.0 else 0.0
    return size


def single(bad: Mask) -> bool:
    """Return whether so many of all rows can be outliers."""
    return bool(bad.sum() <= MOST * bad.size) and longest_run(bad) <= LONGEST_RUN


class Settled(NamedTuple):
    """The fit of the rows that a choice includes, (n_rows,), and the errors of each row.

    ``is_stable`` is False if the choice recurs or leaves out too many rows, or if the fit does not converge.
    """

    fit: Solution
    included: Mask
    rows: RowErrors
    is_stable: bool


def settled(
    problem: Problem,
    columns: Mask,
    solution: Solution,
    weight: Floats,
    choose: Callable[[Floats, Indices, Mask], Mask],
    largest_share: float,
    options: Options,
    judge: Judge,
) -> Settled:
    """Alternate the choice of rows and their fit, from a ``solution`` over x[columns].

    ``weight`` (n_rows,) is that of the rows.

    ``choose`` returns the rows to include by their squared distances, their widths, and the rows included so far. At
    most the part ``largest_share`` of all may be left out.
    """
    included, choices, is_stable = weight > 0.0, set[bytes](), False
    for _ in range(MAX_ROUNDS):
        rows = judge(solution, weight)
        chosen = choose(rows.distance**2, rows.width, included)
        is_stable = np.array_equal(chosen, included)
        if is_stable or (~chosen).mean() > largest_share or chosen.tobytes() in choices:
            break
        choices.add(chosen.tobytes())
        included, weight = chosen, chosen.astype(float)
        how_to = options._replace(on_step=None, is_near=True)
        solution = fit(only(problem, included), columns, solution.x, how_to)
        if solution.status != "converged":
            break
    return Settled(solution, included, rows, is_stable)


class Rejection(NamedTuple):
    """A fit without outliers, which have weight 0 in it."""

    fit: Solution
    explained: bool  # by the declared noise, except for a share MOST of the rows


def without_outliers(
    problem: Problem, columns: Mask, solution: Solution, options: Options, gross: Mask, judge: Judge
) -> Rejection | None:
    """Return the fit without outliers; None if there are none, or if the model is wrong.

    ``solution`` is a converged least-squares fit over x[columns] of all rows except those that are ``gross`` (n_rows,).
    """

    def choose(square: Floats, width: Indices, included: Mask) -> Mask:
        return within(square, gate(width) * misfit(square, width, included), included)

    # Where the misfit varies, the choice may not settle: clean rows follow those that are farthest.
    good = settled(problem, columns, solution, (~gross).astype(float), choose, MOST, options, judge)
    if good.fit.status != "converged" or good.included.all() or not single(~good.included):
        return None
    explained = good.is_stable and bool(good.rows.beyond.mean() <= MOST)
    if not explained and not matter(good.rows.distance**2, ~good.included):
        return None
    refit = good.fit._replace(iterations=solution.iterations, message=solution.message)
    return Rejection(weightless(problem, columns, refit, good.included), explained)


class WithoutBad(NamedTuple):
    """The fit without the bad rows: which they are, each row's distance [σ] from its prediction by it (n_rows,), χ²."""

    bad: Mask
    distance: Floats
    solution: Solution
    quality: Goodness


def without_bad_rows(
    problem: Problem, columns: Mask, solution: Solution, quality: Goodness, options: Options, judge: Judge
) -> WithoutBad | None:
    """Return the fit without the bad rows; None if there are none, or if they do not explain χ².

    ``solution`` is the least-squares fit of all rows over x[columns], with the ``quality`` that is out of its range.
    """
    rows = judge(solution, solution.weight)
    usual = float(np.nanmax(misfit(rows.distance**2, rows.width, np.isfinite(rows.distance)), initial=1.0))
    if not quality.reduced > HEAVY * usual:
        return None
    robust = fit(problem, columns, solution.x, options._replace(on_step=None, loss=Loss.CAUCHY))

    def choose(square: Floats, width: Indices, included: Mask) -> Mask:
        return ~(square > gate(width))

    good = settled(problem, columns, robust, robust.weight, choose, MOST_BAD, options, judge)
    bad = ~good.included
    if not good.is_stable or not bad.any() or longest_run(bad) > _longest_by_chance(bad):
        return None
    remaining = goodness_of(problem, columns, good.fit)
    explained = remaining.explained and remaining.freedom >= LEAST_LEFT
    return WithoutBad(bad, good.rows.distance, good.fit, remaining) if explained else None


def _longest_by_chance(bad: Mask) -> float:
    """Return the longest run of the bad rows that is not beyond chance if they are in random order."""
    return max(LONGEST_RUN, math.log(CHANCE / bad.size) / math.log(bad.mean()))


def fit_without(bad: WithoutBad, chain: Chain, x: Floats, q: Floats) -> OtherFit:
    """Return the fit without the bad rows; x (P,) is the fit with them, and q (n, j) are the poses."""
    rms = rms_of(bad.solution.information.residual, ~bad.bad)
    return OtherFit(int(bad.bad.sum()), bad.solution.x, rms, bad.quality.reduced, moves(chain, x, bad.solution.x, q))


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
    """Return a fit of the ``included`` rows (n_rows,) with the residuals of all, of which the others have weight 0."""
    residual, nothing = problem.no_residuals(), np.zeros_like(columns)
    of_others = observe(only(problem, ~included), solution.x, nothing).residual
    for unit, errors in (*solution.information.residual.items(), *of_others.items()):
        np.copyto(residual[unit], errors, where=np.isfinite(errors))
    return solution._replace(
        information=solution.information._replace(residual=residual), weight=included.astype(float)
    )


def fit_with_all(problem: Problem, columns: Mask, complete: Solution, solution: Solution) -> OtherFit:
    """Return the fit of all rows, to compare with the one without outliers."""
    reduced = goodness_of(problem, columns, complete).reduced
    return OtherFit(int((solution.weight == 0.0).sum()), complete.x, rms_of(complete.information.residual), reduced)


def misfit(square: Floats, width: Indices, included: Mask) -> Floats:
    """Return by how much (n,) the median square of each width exceeds that of noise, at least 1.

    Only ``included`` rows count.

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
