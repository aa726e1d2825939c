"""Renders 1991, Fig. 4: the prediction errors of maximum likelihood (ML) and of least squares (LS), point by point.

**The measure.** The prediction error of a point is the error that an estimator makes at it using only the points before
it (II-F): e_N = |Δx_N − J_N Δθ̂(N−1)|. A step of Fig. 4 is one point. ML is ahead at a step if its mean of e_N over
experiments is no larger. An experiment has lines of its own and a robot drawn from the prior. The paper shows one
experiment, but in a single one the better estimator is not closer at every point: compared with the P₀ that suits LS
best, ML is closer at four points of five. Theory guarantees the mean: by (25), (26) the estimator with the true
covariances has the smallest mean square error at every step. LS does not use the joints' noise S_q, the unequal sensors
S_x and the prior knowledge of the parameters. The last matters while points are few: "the accuracy levels become nearly
identical if a large number of measurement points is used" (III-G 5 c).

**Two things that the paper does not specify determine the result**, because robots drawn from III-C's 1 mm and 0.052
rad have errors of centimetres.

- *Where the model is linearised.* Half of 0.052² rad² times 0.7 m is 1 mm per joint, about five times the noise. In a
  pass that stays linearised at the nominal robot, the linearisation error dominates the errors of both estimators. Here
  each θ̂(N−1) is the minimum of the cost over the points before N, relinearised, with every point counted once
  (``fit``), and e_N = |measured − predicted at θ̂(N−1)|.
- *Through which robot a new line is placed.* "The first two points are used to compute an initial estimate of the
  position and the orientation of the line" (5 a). With the nominal robot this estimate is wrong by the robot's entire
  error: the first two points of every new line show 35 mm and 5 mm to both estimators, and a lead of a millimetre
  depends on chance or a wrong prior. Here a line is placed when its first points arrive, through the robot as its
  estimator knows it at that time; "the prediction error abruptly increases" still.

If both use the nominal robot (``one_pass``), ML is ahead at about four steps of five, whatever P₀. With new lines
placed this way but a single linearisation, it is ahead at 78 to 88 %; with only relinearisation, at 75 to 97 %.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.estimate import least_squares as ls
from truearm.estimate import recursive
from truearm.estimate.fit import fit
from truearm.estimate.information import observe
from truearm.estimate.problem import Problem, build_problem
from truearm.estimate.solution import Options
from truearm.estimate.whitened_rows import only
from truearm.model.chain import Chain
from truearm.model.robot import Robot
from truearm.reproduce.line_bench import MeasuredLines, line_rig, measured_lines, prior_of
from truearm.types import Floats, LinePlacement

N_LINES = 4
PLACING = 2  # points that place a line (III-G 5 a) and are not used for the identification
DEVICE_SIGMA = 0.1  # m: a line is placed through a robot with half as large an error
# Maximum number of linearisations per point, from the previous point's estimate. 50 change ML's mean error by 1 % and
# are in its favour: for LS with P₀ 1e6, which has many minima while points are few, the mean error rises from 1.2 to
# 1.4 mm.
RELINEARISED = 3


class Convergence(NamedTuple):
    """Prediction errors [m] of maximum likelihood and least squares at each step of one experiment."""

    ml: Floats  # (n,)
    ls: Floats  # (P₀, n): least squares started with each P(0) = P₀·I


class PredictionExperiment(NamedTuple):
    """The data given to both estimators."""

    problem: Problem  # every line placed by its first two points through the nominal robot
    session: MeasuredLines
    free: NDArray[np.bool_]  # (p,) robot parameters to identify


def experiment(robot: Robot, n_points: int, rng: np.random.Generator) -> PredictionExperiment:
    """Return four lines of ``n_points`` points, after two more points that place the line.

    The parameters of all rows that are not fixed are free, and truly have the uncertainty of III-C.
    """
    chain = robot.chain
    free = np.array([f and n.startswith("joint") for n, f in zip(chain.parameter_names, robot.free, strict=True)])
    prior = prior_of(chain)
    sigma = np.array([prior.get(name, np.inf) for name in chain.parameter_names])
    truth = chain.params_nominal + np.where(free, sigma, 0.0) * rng.standard_normal(free.size)
    session = measured_lines(chain, truth, N_LINES, n_points + PLACING, rng)
    problem = build_problem(chain, line_rig(session, LinePlacement.TWO_POINT, DEVICE_SIGMA), session.table, sigma)
    return PredictionExperiment(problem, session, free)


def convergence(
    robot: Robot, n_points: int, p0s: Sequence[float], rng: np.random.Generator, last: int | None = None
) -> Convergence:
    """Run one experiment, each prediction from its own minimum. ``last`` limits it to that many of the last steps."""
    problem, session, free = experiment(robot, n_points, rng)
    steps = last or N_LINES * n_points
    plain = [predictions(ls.unweighted(problem, p0), session, free, steps) for p0 in p0s]
    return Convergence(predictions(problem, session, free, steps), np.array(plain))


def one_pass(robot: Robot, n_points: int, p0s: Sequence[float], rng: np.random.Generator) -> Convergence:
    """Run one experiment literally: (18), (20) point by point, linearised and placed once, at the nominal robot."""
    problem, session, free = experiment(robot, n_points, rng)
    plain = [_innovations(ls.unweighted(problem, p0), session, free) for p0 in p0s]
    return Convergence(_innovations(problem, session, free), np.array(plain))


def _innovations(problem: Problem, session: MeasuredLines, free: NDArray[np.bool_]) -> Floats:
    """Return the prediction errors (n,) [m] of one pass of the recursive estimator."""
    columns = problem.columns(free)
    rows = recursive.rows_of(problem, problem.start, columns)
    identifying = np.arange(problem.n_rows) % (problem.n_rows // N_LINES) >= PLACING
    prior = recursive.start(np.zeros(columns.sum()), problem.prior_sigma[columns])
    seen = recursive.run(prior, rows, identifying)
    error = (rows.noise_root @ seen.innovation[..., None])[..., 0]
    return np.asarray(np.linalg.norm(error, axis=1)[identifying])


def predictions(problem: Problem, session: MeasuredLines, free: NDArray[np.bool_], last: int) -> Floats:
    """Return the prediction errors (last,) [m] of the last points that do not place a line, in the order of the table.

    free : (p,) robot parameters to identify.
    """
    lines = session.table.line
    observed = np.zeros(problem.n_rows, dtype=bool)
    columns = np.concatenate([free, np.zeros(problem.start.size - free.size, dtype=bool)])
    judged_from = N_LINES * (len(lines) // N_LINES - PLACING) - last
    x, errors = problem.start, []
    for name in session.by_hand:
        rows = np.flatnonzero(lines == name)
        device = np.array([n.startswith(f"line.{name}.") for n in problem.names])
        x = np.where(device, 0.0, fitted_to(problem, observed, columns, x))
        x[device] = placed(problem.chain, x, session, rows[:PLACING])
        # The prior of the device refers to its initial position.
        problem, columns = replace(problem, start=np.where(device, x, problem.start)), columns | device
        for row in rows[PLACING:]:
            if observed.sum() >= judged_from:
                x = fitted_to(problem, observed, columns, x)
                errors.append(observe(only(problem, np.arange(observed.size) == row), x, columns).residual["m"][row])
            observed[row] = True
    return np.array(errors)


def fitted_to(problem: Problem, observed: NDArray[np.bool_], columns: NDArray[np.bool_], x: Floats) -> Floats:
    """Return θ̂ (P,) from the points ``observed`` (n_rows,), with the search started at x (P,)."""
    return fit(only(problem, observed), columns, x, Options(RELINEARISED), 0.0).x if observed.any() else x


def placed(chain: Chain, x: Floats, session: MeasuredLines, rows: NDArray[np.intp]) -> Floats:
    """Return the device's parameters (6,) as placed by ``rows`` of one line through the robot of x (P,)."""
    known = zip(chain.parameters, x[: len(chain.parameters)].tolist(), strict=True)
    as_known = replace(chain, parameters=tuple(replace(p, nominal=value) for p, value in known))
    rig = line_rig(session, LinePlacement.TWO_POINT, DEVICE_SIGMA)
    return build_problem(as_known, rig, session.table.select(rows)).start[-6:]
