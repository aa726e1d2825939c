"""The batch fit behind ``lm`` and ``map``: one cost, observations and one fixed prior, minimised from x.

With a robust loss the fit runs in stages, least squares first (robust.py says why); each has all the iterations that were granted,
and whether the last converged is what the result says. With uncertain joint readings the
weights belong to the x at which they were computed: they are renewed at each linearisation, and two x are compared
under those of the first (``information.weighed``).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from truearm.estimate import lm
from truearm.estimate.information import Information, covariance, observe, spectrum, weighed, with_prior
from truearm.estimate.parameter_update import stepper
from truearm.estimate.problem import Problem
from truearm.estimate.robust import sandwich, stages
from truearm.estimate.solution import Options, Solution, prior_error, whole
from truearm.estimate.solvers import Loss
from truearm.estimate.whitened_rows import observe_robustly
from truearm.types import Floats


def fit(
    problem: Problem, columns: NDArray[np.bool_], x: Floats, options: Options, damping: float = lm.DAMPING_START
) -> Solution:
    """Minimise from x (P,) over x[columns], beginning with ``damping``; the prior's mean is the problem's start."""
    part, iterations, prior = x[columns], 0, problem.prior_sigma[columns]
    for loss in stages(options.loss):
        linearise, cost = _callbacks(problem, columns, x, loss)
        minimum = lm.minimise(
            linearise,
            part,
            options.max_iterations,
            _counted(iterations, options),
            damping=damping,
            plain=options.plain,
            cost=cost,
            move=stepper(problem, columns),
        )
        part, iterations = minimum.x, iterations + minimum.iterations
    x = whole(x, columns, part)
    message = minimum.message if options.loss is Loss.LINEAR else f"{options.loss} loss: {minimum.message}"
    if options.loss is Loss.LINEAR:
        claimed = covariance(spectrum(minimum.information.root))
        weights, information = np.ones(problem.n_rows), minimum.information
        return Solution(x, minimum.status, message, iterations, information, claimed, weights, prior)
    _, moments, weights = observe_robustly(problem, x, columns, options.loss)
    data = observe(problem, x, columns)
    claimed = sandwich(data.root, prior, moments, data.n_residuals)
    information = with_prior(data, *prior_error(problem, columns, x))
    return Solution(x, minimum.status, message, iterations, information, claimed, weights, prior)


def solve(problem: Problem, columns: NDArray[np.bool_], x: Floats, options: Options) -> Solution:
    """The solver ``lm``: minimise over x[columns] from x (P,), damped from the first step on."""
    return fit(problem, columns, x, options)


def _counted(before: int, options: Options) -> Callable[[int, Information], None]:
    """Tell of each step, counting on over the stages."""

    def on_step(iteration: int, information: Information) -> None:
        if options.on_step is not None:
            options.on_step(before + iteration, information.residual)

    return on_step


def _callbacks(
    problem: Problem, columns: NDArray[np.bool_], x: Floats, loss: Loss
) -> tuple[Callable[[Floats], Information], Callable[[Floats, Floats], float] | None]:
    """``linearise`` and ``cost`` for ``lm.minimise``."""

    def at(of: Problem, part: Floats) -> Information:
        here = whole(x, columns, part)
        data = observe(of, here, columns) if loss is Loss.LINEAR else observe_robustly(of, here, columns, loss)[0]
        return with_prior(data, *prior_error(problem, columns, here))

    if problem.joint_cov is None:
        return lambda part: at(problem, part), None
    return lambda part: at(problem, part), lambda there, here: at(weighed(problem, whole(x, columns, here)), there).chi2
