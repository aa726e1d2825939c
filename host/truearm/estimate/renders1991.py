"""The procedure of Renders 1991, III-E, run by run, to reproduce the paper. Use ``map`` for actual work.

"… taking the covariance matrix P_N of the previous run for P_0 of the next run, and the estimates of the previous run
for the initial guess". Each run is the batch solution (12), linearised where the last one ended, with the posterior of
the last one as its prior. But both are based on the same data. After k runs the data count k times: P is about k times
too small, and errors of the first linearisation are kept as if they had been measured and decay only as 1/k. The result
contains a warning about this.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from truearm.estimate.information import Information, covariance, fold, observe, spectrum, with_prior
from truearm.estimate.levenberg_marquardt import damped_step, promise
from truearm.estimate.problem import Problem
from truearm.estimate.solution import Options, Solution, prior_error, whole
from truearm.types import Floats

RUN_END = 0.01  # of the RMS residual, or of the declared noise where that is larger


def solve(problem: Problem, columns: NDArray[np.bool_], x: Floats, options: Options) -> Solution:
    """Repeat runs from x (P,) over x[columns] until "further runs do not improve the solution".

    That is when the RMS residual falls by less than 1 %, or by less than 1 % of the declared noise. On data without
    noise it decays as 1/runs indefinitely, because the error of the first linearisation does.
    """
    error, sigma = prior_error(problem, columns, x)
    prior = np.diag(np.where(np.isfinite(sigma), 1.0 / sigma, 0.0))
    data = observe(problem, x, columns)
    status, runs = "max_iterations", 0
    while runs < options.max_iterations:
        if not np.isfinite(data.chi2):
            status = "stalled"
            break
        root, rhs = _fused(prior, prior @ error, data)
        decomposition = spectrum(root)
        delta, _ = damped_step(decomposition, promise(decomposition, rhs), 0.0)
        x_next = whole(x, columns, x[columns] + delta)
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            data_next = observe(problem, x_next, columns)
        fall = np.sqrt(data.chi2) - np.sqrt(data_next.chi2)
        smallest = RUN_END * np.sqrt(max(data.chi2, data.n_residuals))
        x, data, prior, error, runs = x_next, data_next, root, np.zeros_like(error), runs + 1
        if options.on_step is not None:
            options.on_step(runs, data.residual)
        if abs(fall) < smallest:
            status = "converged"
            break
    # x itself follows the data roughly as with one prior and k times the data's weight, so with the prior's σ times √k.
    sigma = sigma * np.sqrt(max(runs, 1))
    information = with_prior(data, (problem.start - x)[columns], sigma)
    claimed = covariance(spectrum(prior))
    return Solution(x, status, warning(runs), runs, information, claimed, np.ones(problem.n_rows), sigma)


def warning(runs: int) -> str:
    """Return a warning about the effect of the procedure on the covariance."""
    return (
        f"ended after {runs} runs. Each run uses the posterior of the previous run as its prior, so the same data count "
        f"{runs} times: σ is about {np.sqrt(max(runs, 1)):.1f} times too small, and the error of the first linearisation "
        "decreases only as 1/runs. Use the solver map for a valid covariance"
    )


def _fused(prior: Floats, target: Floats, data: Information) -> tuple[Floats, Floats]:
    """Return root (k, k) and right side (k,) of the data and the rows of a ``prior`` (k, k) of ``target`` (k,)."""
    k = len(prior)
    rows = [np.column_stack([prior, target]), np.column_stack([data.root, data.rhs])]
    triangle = fold(np.zeros((k + 1, k + 1)), np.concatenate(rows))
    return triangle[:k, :k], triangle[:k, k]
