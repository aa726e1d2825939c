"""Bad rows that are too many to be left out, but without which the declared noise explains all others.

``outliers`` leaves out at most 5 % of the rows. More of them bend a least-squares fit too far. The Cauchy loss ends
near the fit of the good rows. Rows beyond the gate from there are then left out of a least-squares fit, rows back
within the gate return, until nothing changes.

The rows are bad on three conditions: χ² of all others is then in its range, at most MOST of all rows are bad, and they
follow each other no more than by chance. A robot whose model is wrong, or whose noise is larger than declared, fails
the first. Something that moved for some time fails the last.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from truearm.estimate.fit import fit
from truearm.estimate.outliers import LONGEST_RUN, longest_run, misfit
from truearm.estimate.prediction import moves
from truearm.estimate.problem import Problem
from truearm.estimate.solution import Options, Solution, goodness_of
from truearm.estimate.solvers import Loss
from truearm.estimate.uncertainty import Goodness
from truearm.estimate.whitened_rows import gate, only, squared_distances
from truearm.model.chain import Chain
from truearm.results import Figures, OtherFit
from truearm.types import Floats, Mask

MOST = 0.25  # of the rows
LEAST_LEFT = 10.0  # degrees of freedom of the other rows: with fewer, leaving out rows explains anything
ROUNDS = 10
HEAVY = 2.0  # times the misfit of the usual row: with less, the whole fit is bad and not some rows
CHANCE = 0.01  # probability of a longer run of bad rows in random order


class WithoutBad(NamedTuple):
    """The fit without the bad rows: which they are, each row's distance [σ] from its prediction by it (n_rows,), χ²."""

    bad: Mask
    distance: Floats
    solution: Solution
    quality: Goodness


def without_bad_rows(
    problem: Problem, columns: Mask, solution: Solution, quality: Goodness, options: Options
) -> WithoutBad | None:
    """Return the fit without the bad rows; None if there are none, or if they do not explain χ².

    ``solution`` is the least-squares fit of all rows over x[columns], with the ``quality`` that is out of its range.
    """
    square, width = squared_distances(problem, solution.x, columns, solution.information.half, np.ones(problem.n_rows))
    usual = float(np.nanmax(misfit(square, width, np.isfinite(square)), initial=1.0))
    if not quality.reduced > HEAVY * usual:
        return None
    options = options._replace(on_step=None)
    refit = fit(problem, columns, solution.x, options._replace(loss=Loss.CAUCHY))
    included, weight = np.zeros(problem.n_rows, dtype=bool), refit.weight
    for _ in range(ROUNDS):
        square, width = squared_distances(problem, refit.x, columns, refit.information.half, weight)
        chosen = ~(square > gate(width))
        if np.array_equal(chosen, included):
            break
        included, weight = chosen, chosen.astype(float)
        if (~included).mean() > MOST:
            return None
        refit = fit(only(problem, included), columns, refit.x, options)
    else:
        return None
    if included.all() or refit.status != "converged" or longest_run(~included) > _longest_by_chance(~included):
        return None
    remaining = goodness_of(problem, columns, refit)
    explained = remaining.explained and remaining.freedom >= LEAST_LEFT
    return WithoutBad(~included, np.sqrt(square), refit, remaining) if explained else None


def _longest_by_chance(bad: Mask) -> float:
    """Return the longest run of the bad rows that is not beyond chance if they are in random order."""
    return max(LONGEST_RUN, math.log(CHANCE / bad.size) / math.log(bad.mean()))


def fit_without(bad: WithoutBad, chain: Chain, x: Floats, q: Floats) -> OtherFit:
    """Return the fit without the bad rows; x (P,) is the fit with them, and q (n, j) are the poses."""
    rms = {unit: figures.rms for unit, figures in Figures.by_unit(bad.solution.information.residual, ~bad.bad).items()}
    distance = moves(chain, x, bad.solution.x, q)
    return OtherFit(int(bad.bad.sum()), bad.solution.x, rms, bad.quality.reduced, distance)
