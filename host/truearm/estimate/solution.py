"""The common interface of all solvers: what they receive and return, so that ``identify`` can treat them alike."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.estimate.information import Information
from truearm.estimate.levenberg_marquardt import Damping, Ends
from truearm.estimate.problem import Problem
from truearm.estimate.solvers import SOLVERS, Loss
from truearm.estimate.uncertainty import Goodness, goodness, prior_shares
from truearm.results import Figures
from truearm.types import Floats, Residuals


class Options(NamedTuple):
    """Options of a solver; a solver ignores those that it does not use."""

    max_iterations: int = 50
    loss: Loss = Loss.LINEAR  # for lm and map
    damping: Damping = Damping()  # for lm, map and ls
    on_step: Callable[[int, Residuals], None] | None = None  # called with the iteration and the residuals
    ends: Ends | None = None  # for lm, map and ls: whether to end before the minimum
    is_near: bool = False  # for lm and map: the start is the minimum of nearly the same rows


class Solution(NamedTuple):
    """The result of a solver. ``status`` is "converged", "max_iterations" or "stalled"."""

    x: Floats  # (P,)
    status: str
    message: str
    iterations: int
    information: Information  # at x, of the observations used and the prior, unweighted
    covariance: Floats  # (k, k) as reported by the solver; zero along null directions
    weight: Floats  # (n_rows,) 1: as declared; 0: left out; in between: from a robust loss
    prior_sigma: Floats  # (k,) σ of the prior in ``information``, about the problem's start; inf for none


Solver = Callable[[Problem, NDArray[np.bool_], Floats, Options], Solution]


def solver_named(name: str) -> Solver:
    """Return the function of a solver, loading its module. Raises KeyError for an unknown name."""
    solver: Solver = import_module(f"{__package__}.{SOLVERS[name].module}").solve
    return solver


def whole(x: Floats, columns: NDArray[np.bool_], values: Floats) -> Floats:
    """Return x (P,) with x[columns] replaced."""
    out = x.copy()
    out[columns] = values
    return out


def prior_error(problem: Problem, columns: NDArray[np.bool_], x: Floats) -> tuple[Floats, Floats]:
    """Return the prior about x[columns]: mean − x (k,) and σ (k,)."""
    return (problem.start - x)[columns], problem.prior_sigma[columns]


def of_data(problem: Problem, columns: NDArray[np.bool_], solution: Solution) -> tuple[float, int]:
    """Return χ² and number of scalar residuals of the observations alone, without the prior."""
    has_prior = np.isfinite(solution.prior_sigma)
    error = (problem.start - solution.x)[columns][has_prior] / solution.prior_sigma[has_prior]
    information = solution.information
    return max(information.chi2 - float(error @ error), 0.0), information.n_residuals - int(has_prior.sum())


def goodness_of(problem: Problem, columns: NDArray[np.bool_], solution: Solution) -> Goodness:
    """Return the quality of a fit of x[columns]."""
    shares = prior_shares(solution.information.half, solution.prior_sigma)
    return goodness(*of_data(problem, columns, solution), shares)


def rms_of(residual: Residuals, rows: NDArray[np.bool_] | slice = slice(None)) -> dict[str, float]:
    """Return the RMS of some rows' residuals by SI unit."""
    return {unit: figures.rms for unit, figures in Figures.by_unit(residual, rows).items()}
