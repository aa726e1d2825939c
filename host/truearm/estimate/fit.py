"""The batch fit behind ``lm`` and ``map``: minimise the cost of the observations and one fixed prior, starting at x.

With a robust loss the fit runs in stages that begin with least squares (``robust`` explains why). Each stage may use
all permitted iterations, and the result reports whether the last one converged. With uncertain joint readings, the
weights depend on the x at which they were computed. They are updated at each linearisation, and two values of x are
compared under the weights of the first (``information.weighed``).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from truearm.estimate import levenberg_marquardt as lm
from truearm.estimate.information import Information, covariance, observe, spectrum, weighed, with_prior
from truearm.estimate.parameter_update import stepper
from truearm.estimate.problem import Problem, held
from truearm.estimate.robust import sandwich, stages
from truearm.estimate.solution import Options, Solution, prior_error, whole
from truearm.estimate.solvers import Loss
from truearm.estimate.whitened_rows import observe_robustly
from truearm.progress import Advance, step
from truearm.types import Floats

THINNED_TO = 20_000  # observations, or up to twice as many
USUAL_ITERATIONS = 8  # of a fit that converges, to estimate the remaining time


def fit(problem: Problem, columns: NDArray[np.bool_], x: Floats, options: Options = Options()) -> Solution:  # noqa: B008 (frozen)
    """Minimise from x (P,) over x[columns]; the prior's mean is the problem's start.

    From 2 THINNED_TO observations on, a regular selection of them is fitted first, unless the start is near: this costs
    little, and ends close to the minimum.
    """
    stride = sum(len(group.sensor_cov) for group in problem.groups) // THINNED_TO
    if stride > 1 and columns.any() and not options.is_near:
        thinned = (group if group.row is None else group.take(slice(None, None, stride)) for group in problem.groups)
        x = fit(replace(problem, groups=tuple(thinned)), columns, x, options._replace(on_step=None)).x
    unknowns, iterations, prior = x[columns], 0, problem.prior_sigma[columns]
    for loss in stages(options.loss):
        linearise, cost = _callbacks(problem, columns, x, loss)
        with step(f"fitting {unknowns.size} unknowns to {problem.n_rows} rows") as advance:
            minimum = lm.minimise(
                linearise,
                unknowns,
                options.max_iterations,
                _counted(iterations, options, advance),
                damping=options.damping,
                cost=cost,
                move=stepper(problem, columns),
                ends=options.ends,
            )
        unknowns, iterations = minimum.x, iterations + minimum.iterations
    x = whole(x, columns, unknowns)
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


solve = fit  # the solver ``lm``


def _counted(earlier: int, options: Options, advance: Advance) -> Callable[[int, Information], None]:
    """Report each step, counting through all stages."""

    def on_step(iteration: int, information: Information) -> None:
        advance(min(iteration / USUAL_ITERATIONS, 0.9))
        if options.on_step is not None:
            options.on_step(earlier + iteration, information.residual)

    return on_step


def _callbacks(
    problem: Problem, columns: NDArray[np.bool_], x: Floats, loss: Loss
) -> tuple[Callable[[Floats], Information], Callable[[Floats, Floats], float] | None]:
    """Return ``linearise`` and ``cost`` for ``lm.minimise``."""

    def data_at(weighted: Problem, point: Floats, free: NDArray[np.bool_]) -> Information:
        if loss is Loss.LINEAR:
            return observe(weighted, point, free)
        return observe_robustly(weighted, point, free, loss)[0]

    def linearised(weighted: Problem, unknowns: Floats) -> Information:
        point = whole(x, columns, unknowns)
        return with_prior(data_at(weighted, point, columns), *prior_error(problem, columns, point))

    if problem.joint_cov is None and held(problem, x) is problem:
        return lambda unknowns: linearised(problem, unknowns), None
    nothing = np.zeros_like(columns)

    @lru_cache(maxsize=1)
    def weighed_at(unknowns: bytes) -> Problem:
        point = whole(x, columns, np.frombuffer(unknowns))
        return weighed(held(problem, point), point)

    def cost(goal: Floats, start: Floats) -> float:
        weighted, point = weighed_at(start.tobytes()), whole(x, columns, goal)
        data = data_at(weighted, point, nothing)
        error, sigma = prior_error(problem, columns, point)
        return data.chi2 + float(((error / sigma) ** 2).sum())

    return lambda unknowns: linearised(problem, unknowns), cost
