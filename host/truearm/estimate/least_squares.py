"""Plain least squares, for comparison (Renders 1991, II-I): S_x = I, S_q = 0, P(0) = P₀·I with P₀ large.

All residuals in metres have equal weight, joint readings are taken as exact, and no parameter has prior information.
The noise is then estimated from the residuals: the covariance is s²·(JᵀJ + I/P₀)⁻¹ with s² = Σf²/(m − k). The reported
χ² still uses the declared σ, so that results of different solvers can be compared.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from truearm.estimate.fit import fit
from truearm.estimate.information import observe, seen, spectrum
from truearm.estimate.problem import Problem
from truearm.estimate.solution import Options, Solution
from truearm.estimate.solvers import Loss
from truearm.types import Floats

P0 = 1e6  # m² and rad², "an arbitrary large number"


def solve(problem: Problem, columns: NDArray[np.bool_], x: Floats, options: Options) -> Solution:
    """Solve by least squares over x[columns] from x (P,)."""
    solution = fit(unweighted(problem), columns, x, options._replace(loss=Loss.LINEAR))
    data = observe(problem, solution.x, columns)
    rank = int(seen(spectrum(data.root)).sum())
    square = solution.information.chi2 - float((((problem.start - solution.x)[columns]) ** 2).sum()) / P0
    variance = square / max(data.n_residuals - rank, 1)
    no_prior = np.full(columns.sum(), np.inf)
    return solution._replace(information=data, covariance=solution.covariance * variance, prior_sigma=no_prior)


def unweighted(problem: Problem) -> Problem:
    """Return the problem with the weights of plain least squares."""
    groups = tuple(replace(g, sensor_cov=np.ones(g.sensor_cov.shape[:2])) for g in problem.groups)
    return replace(problem, groups=groups, joint_cov=None, prior_sigma=np.full(problem.start.size, np.sqrt(P0)))
