"""One identification: the fit by a solver, outliers, what the rows determine, and errors on rows left out."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm import option_defaults
from truearm.errors import ProblemError
from truearm.estimate.circumstances import poses
from truearm.estimate.fit import fit
from truearm.estimate.frame_choice import mounting
from truearm.estimate.identifiability import (
    Identifiability,
    additions,
    hardly_seen,
    identifiability,
    identifiable_columns,
    is_weakly_identifiable,
    observability,
    spread,
    suggested_free,
)
from truearm.estimate.information import observe, of_rows
from truearm.estimate.law_fit import covariance_with, is_of_arm, learned_scatter
from truearm.estimate.levenberg_marquardt import Damping, Ends
from truearm.estimate.outliers import (
    MOST_BAD,
    WithoutBad,
    fit_with_all,
    fit_without,
    gross_rows,
    weightless,
    without_bad_rows,
    without_outliers,
)
from truearm.estimate.problem import Problem, build_problem, settled, without_effect_priors
from truearm.estimate.row_errors import Judge, RowErrors, judging, left_out_errors
from truearm.estimate.solution import Options, Solution, goodness_of, rms_of, solver_named
from truearm.estimate.solvers import SOLVERS, Loss
from truearm.estimate.uncertainty import Goodness, goodness, prior_shares, weak_prior
from truearm.estimate.validation import judge_problem, mean_errors
from truearm.estimate.whitened_rows import only, weighted_chi2
from truearm.kinds.table import ObservationTable
from truearm.model.chain import Chain
from truearm.results import Addition, Effect, Estimate, Figures, HeldOut, MeanError, NullDirection, Observability
from truearm.types import Floats, Indices, Residuals, Rigs, not_left_out
from truearm.units import UNITS

TIME_OFFSET = "time_offset"
Progress = Callable[[int, Mapping[str, float]], None]  # iteration, RMS of the residuals by SI unit


@dataclass(frozen=True)
class SolverOptions:
    """Options of an identification.

    solver : one of SOLVERS; each is a module that documents its method.
    loss : "linear", "huber" or "cauchy" (robust.py), for the solvers lm and map.
    progress : called with (iteration, RMS by SI unit) after each step.
    effects : systematic errors to estimate as well; their rows are rows of the table.
    leave_out : (n,) rows to neither fit nor validate on, default none.
    reject : fit again without outliers (``outliers``), for a least-squares fit by lm or map.
    outliers : (n,) rows known to be outliers, instead of those that the fit itself would reject.
    """

    solver: str = option_defaults.SOLVER
    loss: str = option_defaults.LOSS
    max_iterations: int = option_defaults.MAX_ITERATIONS
    progress: Progress | None = None
    effects: tuple[Effect, ...] = ()
    leave_out: NDArray[np.bool_] | None = None
    reject: bool = False
    outliers: NDArray[np.bool_] | None = None


DEFAULTS = SolverOptions()


def identify(
    chain: Chain,
    rig: Rigs,
    table: ObservationTable,
    *,
    free: NDArray[np.bool_] | None = None,
    hold_out: NDArray[np.bool_] | None = None,
    prior_sigma: Floats | None = None,
    prefer: NDArray[np.bool_] | None = None,
    options: SolverOptions = DEFAULTS,
) -> Estimate:
    """Identify the robot's free parameters and the rig's unknowns.

    free : (p,) robot parameters to identify, default all; the rig's unknowns are always identified.
    hold_out : (n,) rows to validate on instead of fitting them, default none. Unknowns of the rig that only these rows
        touch (such as the sockets of a held-out place, or the pose of a line) are estimated on them, with the robot
        fixed.
    prior_sigma : (p,) σ of robot parameters about their nominal values, inf for none; default none.
    prefer : (p,) parameters that the suggested free set should preferably contain, a robot file's ``free``; default
        none.
    options : solver, loss, maximum number of iterations, and progress callback.

    Raises ProblemError if there is no row to fit, and for the same reasons as ``build_problem``. Rank and convergence
    are fields of the result.
    """
    started = time.perf_counter()
    task = _task(chain, rig, table, (free, prefer), hold_out, prior_sigma, options)
    problem, columns, fitted, held = task.problem, task.columns, task.fitted, task.held
    history: list[dict[str, float]] = []

    def on_step(iteration: int, residual: Residuals) -> None:
        history.append(rms_of(residual))
        if options.progress is not None:
            options.progress(iteration, history[-1])

    nominal, judge = _nominal(task, options), judging(problem, columns, task.pose)
    solution, complete, outlying = _solved(task, nominal, options, judge, on_step)
    x, root = solution.x, solution.information.half
    fitted_problem = only(problem, solution.weight > 0.0)
    quality = _quality(task, solution, solution is complete, judge, options)
    # Robust losses and the solvers that estimate the noise from the residuals include it in their covariance.
    as_declared = options.loss == Loss.LINEAR and not SOLVERS[options.solver].reads_noise
    covariance = np.zeros((x.size, x.size))
    covariance[np.ix_(columns, columns)] = solution.covariance
    scatter = None
    if as_declared and solution.status == "converged" and columns.any():
        scatter = learned_scatter(fitted_problem, x, columns, task.pose, quality.fit)
    if scatter is not None and scatter.n and is_of_arm(scatter):
        covariance[np.ix_(columns, columns)] = covariance_with(scatter, fitted_problem, x, columns, root, task.pose)
    sight = _sight(task, solution, fitted_problem)
    included = not_left_out(solution.weight)
    prior = problem.prior_sigma.copy()
    prior[columns] = solution.prior_sigma
    return Estimate(
        **sight._asdict(),
        **_errors(task, nominal, solution, quality)._asdict(),
        status=solution.status,
        message=solution.message,
        solver=options.solver,
        iterations=solution.iterations,
        parameter_names=problem.names,
        units=problem.units,
        nominal=problem.start,
        value=x,
        sigma=np.sqrt(np.where(sight.identifiable, np.diag(covariance), np.nan)),
        free=columns,
        covariance=covariance,
        n_robot_parameters=problem.n_robot,
        n_observations=problem.n_rows,
        rms_before=rms_of(nominal.residual, included),
        rms_raw=rms_of(nominal.raw, included),
        rms_after=rms_of(solution.information.residual, included),
        rms_history={unit: tuple(rms[unit] for rms in (rms_of(nominal.raw), *history)) for unit in nominal.raw},
        chi2_reduced=quality.fit.reduced,
        fitted=fitted,
        left_out=task.left_out,
        loss=options.loss,
        chi2_band=quality.fit.band,
        chi2_freedom=quality.fit.freedom,
        distance=_merge(quality.rows.distance, np.nan, fitted, held),
        weight=_merge(solution.weight, np.nan, fitted, held),
        outlying=spread(outlying, fitted),
        suspect=spread(quality.rows.beyond | (solution.weight == 0.0), fitted),
        prior_sigma=prior,
        with_outliers=None if solution is complete else fit_with_all(problem, columns, complete, solution),
        without_bad_rows=quality.bad and fit_without(quality.bad, chain, x, table.q[fitted]),
        parts=quality.rows.parts,
        scatter=scatter,
        seconds=time.perf_counter() - started,
    )


class _Task(NamedTuple):
    """What is to be identified from which rows of a table; ``problem`` has the fitted ones."""

    chain: Chain
    rig: Rigs
    table: ObservationTable
    fitted: NDArray[np.bool_]  # (n,) disjoint, as are the next two
    held: NDArray[np.bool_]
    left_out: NDArray[np.bool_]
    free: NDArray[np.bool_]  # (p,)
    prefer: NDArray[np.bool_]  # (p,)
    effects: tuple[Effect, ...]
    problem: Problem
    columns: NDArray[np.bool_]  # (P,) the free ones of the robot, and the rig's unknowns
    pose: Indices  # of each fitted row


def _task(
    chain: Chain,
    rig: Rigs,
    table: ObservationTable,
    parameters: tuple[NDArray[np.bool_] | None, NDArray[np.bool_] | None],
    hold_out: NDArray[np.bool_] | None,
    prior_sigma: Floats | None,
    options: SolverOptions,
) -> _Task:
    """Build the problem; ``parameters`` are the masks of the free and of the preferred ones."""
    p = len(chain.parameters)
    free = np.ones(p, dtype=bool) if parameters[0] is None else parameters[0]
    prefer = np.zeros(p, dtype=bool) if parameters[1] is None else parameters[1]
    held = np.zeros(len(table), dtype=bool) if hold_out is None else hold_out
    left_out = np.zeros(len(table), dtype=bool) if options.leave_out is None else options.leave_out
    held = held & ~left_out
    fitted = ~(held | left_out)
    if not fitted.any():
        raise ProblemError("nothing-left", what="observations")
    problem = build_problem(chain, rig, table, prior_sigma, options.effects, fitted)
    masks, pose = (fitted, held, left_out, free, prefer), poses(table.select(fitted))
    return _Task(chain, rig, table, *masks, options.effects, problem, problem.columns(free), pose)


def _rejects(options: SolverOptions) -> bool:
    return options.reject and SOLVERS[options.solver].has_loss and options.loss == Loss.LINEAR


class _Nominal(NamedTuple):
    """The nominal robot: x (P,) and residuals with the rig fitted to it, and with base and tool placed too.

    ``mounts`` are the columns (P,) that place them, with the rig's, ``root`` is that of their covariance, and ``gross``
    (n_rows,) are rows that no robot near the nominal one explains.
    """

    x_raw: Floats
    raw: Residuals
    x: Floats
    residual: Residuals
    mounts: NDArray[np.bool_]
    root: Floats
    gross: NDArray[np.bool_]


def _nominal(task: _Task, options: SolverOptions) -> _Nominal:
    """Return the nominal robot.

    An unmeasured position of a ball or chuck is not an error of the robot. With a guessed rig, the identification would
    be credited with correcting it. Nor are its errors outliers: that fit has no gate and no robust loss. The mounting
    of base and tool is not an error of the robot either. It is placed by the rows that are not gross, with only the
    free parameters that move nothing else.
    """
    problem, of_rig = task.problem, task.problem.of_rig
    placed = fit(problem, of_rig, problem.start, Options(options.max_iterations, ends=Ends()))
    x, raw, gross = placed.x, placed.information.residual, np.zeros(problem.n_rows, dtype=bool)
    if options.outliers is not None:
        gross = options.outliers[task.fitted]
        x = fit(only(problem, ~gross), of_rig, x, Options()).x
    elif _rejects(options):
        gross, x = gross_rows(problem, of_rig, x)
    if gross.any():
        raw = observe(problem, x, of_rig).residual
    mounted = mounting(task.chain, x[: problem.n_robot]).either & task.columns[: problem.n_robot]
    mounts = problem.columns(mounted)
    if mounted.any() or gross.any():
        placed = fit(only(problem, ~gross), mounts, x, Options(ends=Ends()))
    if not mounted.any():
        return _Nominal(x, raw, x, raw, mounts, placed.information.half, gross)
    residual = observe(problem, placed.x, of_rig).residual if gross.any() else placed.information.residual
    return _Nominal(x, raw, placed.x, residual, mounts, placed.information.half, gross)


def _solved(
    task: _Task, nominal: _Nominal, options: SolverOptions, judge: Judge, on_step: Callable[[int, Residuals], None]
) -> tuple[Solution, Solution, NDArray[np.bool_]]:
    """Return the fit, that of all rows, and which rows (n_rows,) are outlying.

    The first two are the same unless outliers were left out.
    """
    problem, columns, gross = task.problem, task.columns, nominal.gross
    # Robot and a distant rig together make a curved valley; a rig fitted alone is a closer start (decision 19).
    start, damping = problem.start, Damping(start=0.0)
    if SOLVERS[options.solver].starts_from_rig:
        start, damping = nominal.x_raw, Damping()
    how_to = Options(options.max_iterations, Loss(options.loss), damping, on_step)
    solve = solver_named(options.solver)
    complete = solve(problem, columns, start, how_to)
    begun = solve(only(problem, ~gross), columns, start, how_to._replace(on_step=None)) if gross.any() else complete
    if options.outliers is not None:
        return weightless(problem, columns, begun, ~gross), complete, gross
    if _rejects(options) and begun.status == "converged":
        rejected = without_outliers(problem, columns, begun, how_to, gross, judge)
        if rejected is not None:
            return rejected.fit if rejected.explained else complete, complete, rejected.fit.weight == 0.0
    return complete, complete, complete.weight == 0.0


class _Quality(NamedTuple):
    """How well the rows fit.

    ``bad`` are more rows than can be left out, but explain a misfit; ``inliers`` lacks them.
    """

    fit: Goodness
    bad: WithoutBad | None
    rows: RowErrors
    inliers: Problem


def _quality(task: _Task, solution: Solution, is_complete: bool, judge: Judge, options: SolverOptions) -> _Quality:
    """Judge the rows by a fit; ``is_complete``: it used all rows."""
    problem, columns, rows = task.problem, task.columns, judge(solution, solution.weight)
    quality = goodness_of(problem, columns, solution)
    if options.loss != Loss.LINEAR:  # outliers that it tolerates are named, and not a misfit of the others
        inliers = only(problem, ~rows.beyond)
        tolerated = inliers if rows.beyond.mean() <= MOST_BAD else problem
        root = solution.information.half
        shares = prior_shares(root, solution.prior_sigma)
        quality = goodness(*weighted_chi2(tolerated, solution.x, Loss(options.loss)), shares)
        left_out = left_out_errors(inliers, solution.x, columns, root, task.pose)
        return _Quality(quality, None, rows._replace(left_out=left_out), inliers)
    bad = None
    if _rejects(options) and is_complete and solution.status == "converged" and not quality.explained:
        bad = without_bad_rows(problem, columns, solution, quality, Options(options.max_iterations), judge)
    if bad is not None:
        rows = rows._replace(distance=bad.distance, beyond=bad.bad)
    return _Quality(quality, bad, rows, only(problem, solution.weight > 0.0))


class _Sight(NamedTuple):
    """Fields of the estimate: what the rows determine."""

    rank: int
    rank_gap: float
    null_space: tuple[NullDirection, ...]
    unseen: Floats
    identifiable: NDArray[np.bool_]
    suggested_free: NDArray[np.bool_]
    observability: Observability
    hardly_seen: tuple[NullDirection, ...]
    additions: tuple[Addition, ...]


def _sight(task: _Task, solution: Solution, fitted_problem: Problem) -> _Sight:
    """Return what the rows of the fitted problem determine, linearised at its solution."""
    x, columns, n_free = solution.x, task.columns, int(task.free.sum())
    still, data = settled(fitted_problem, x), solution.information
    if still is not fitted_problem or not np.array_equal(solution.prior_sigma, task.problem.rig_prior[columns]):
        data = of_rows(still, x, columns)
    names = task.problem.names_of(columns)
    sight = determined(still, x, columns, data.root)
    suggested = suggested_free(data.root, n_free, task.prefer[task.free])
    unit = weak_prior(task.chain)[task.free]
    weak = hardly_seen(data.root, suggested.size, unit, names)
    only_weak = suggested.all() and len(weak) > 0
    wanting = (identifiable_columns(data.root, suggested.size, unit), unit) if only_weak else (suggested, None)
    untimed = _untimed(data.root, names)
    values = dict(zip(task.problem.names, x, strict=True))
    return _Sight(
        rank=sight.rank,
        rank_gap=sight.gap,
        null_space=sight.null_space,
        unseen=sight.unseen,
        identifiable=spread(sight.identifiable & ~np.isin(names, untimed), columns),
        suggested_free=spread(suggested, task.free),
        observability=observability(data.root, n_free, suggested, unit, data.n_residuals),
        hardly_seen=(*weak, *(NullDirection((name,), (1.0,)) for name in untimed)),
        additions=additions(task.chain, task.rig, task.table.select(task.fitted), names, data.root, values, *wanting),
    )


class _Errors(NamedTuple):
    """Fields of the estimate: residuals, and errors where nothing was fitted, also the nominal robot's (``before``)."""

    held_out: HeldOut | None
    held_out_before: HeldOut | None
    residual: Residuals
    residual_before: Residuals
    unfitted_error: Residuals
    unfitted_error_before: Residuals
    unexplained: Mapping[str, MeanError]


def _errors(task: _Task, nominal: _Nominal, solution: Solution, quality: _Quality) -> _Errors:
    """Return the residuals, and the errors on held-out rows, or if there are none on each pose in a fit without it."""
    fitted, held = task.fitted, task.held
    judge = partial(judged, task.problem, rig=task.rig, table=task.table, held=held, effects=task.effects)
    held_out_before, of_held_before = judge(nominal.x)
    held_out, of_held = judge(solution.x)
    if held_out is not None:
        error, error_before = (merged({}, of_robot, fitted, held) for of_robot in (of_held, of_held_before))
    else:
        nominal_error = left_out_errors(quality.inliers, nominal.x, nominal.mounts, nominal.root, task.pose)
        error, error_before = (merged(robot, {}, fitted, held) for robot in (quality.rows.left_out, nominal_error))
    unexplained: Mapping[str, MeanError] = {}
    if not quality.fit.explained:
        unexplained = mean_errors(error, poses(task.table), held_out=held_out is not None)
    return _Errors(
        held_out=held_out,
        held_out_before=held_out_before,
        residual=merged(solution.information.residual, of_held, fitted, held),
        residual_before=merged(nominal.residual, of_held_before, fitted, held),
        unfitted_error=error,
        unfitted_error_before=error_before if np.any(task.columns & ~nominal.mounts) else {},
        unexplained=unexplained,
    )


def determined(problem: Problem, x: Floats, columns: NDArray[np.bool_], root: Floats | None = None) -> Identifiability:
    """Return what the rows determine of x[columns], linearised at x. Its ``unseen`` (P, d) has a row for each unknown.

    ``problem`` is ``settled``; ``root`` (k, k) is that of its rows with the priors of effects, where it was computed.
    """
    if root is None or problem.effects:
        root = of_rows(without_effect_priors(problem), x, columns).root
    sight = identifiability(root, int(columns[: problem.n_robot].sum()), problem.names_of(columns))
    unseen = np.zeros((x.size, sight.unseen.shape[1]))
    unseen[columns] = sight.unseen
    return sight._replace(unseen=unseen)


def _untimed(root: Floats, names: Sequence[str]) -> list[str]:
    """Return the time offsets that the data hardly determine, whose sigma would be meaningless."""
    offsets = [k for k, name in enumerate(names) if name.rpartition(".")[2] == TIME_OFFSET]
    return [names[k] for k in offsets if is_weakly_identifiable(root, k, UNITS["s"].weak_sigma)]


def judged(
    fitted: Problem,
    x_fit: Floats,
    rig: Rigs,
    table: ObservationTable,
    held: NDArray[np.bool_],
    effects: Sequence[Effect],
) -> tuple[HeldOut | None, Residuals]:
    """Return errors on the held-out rows with the robot of x_fit.

    The rig's unknowns are from x_fit, otherwise from these rows.
    """
    if not held.any():
        return None, {}
    if effects:  # of the items that these rows use
        causes = {cause.name for cause in build_problem(fitted.chain, rig, table, rows=held).causes}
        effects = [effect for effect in effects if effect.what in causes]
    problem = build_problem(fitted.chain, rig, table, None, effects, held)
    judgement = judge_problem(problem, dict(zip(fitted.names, x_fit, strict=True)))
    judging = judgement.judging
    error = {unit: np.where(judging, residual, np.nan) for unit, residual in judgement.residual.items()}
    if not judging.any():
        return None, error
    count, left_out = int(judging.sum()), int((~judging).sum())
    return HeldOut(Figures.by_unit(error, judging), count, int(judgement.settled.sum()), left_out), error


def merged(fitted: Residuals, held_out: Residuals, rows: NDArray[np.bool_], held: NDArray[np.bool_]) -> Residuals:
    """Return residuals of all n rows by unit: ``fitted`` in ``rows`` (n,), ``held_out`` in ``held`` (n,), else NaN."""
    units = [unit for unit in UNITS if unit in fitted or unit in held_out]
    return {unit: _merge(fitted.get(unit, np.nan), held_out.get(unit, np.nan), rows, held) for unit in units}


def _merge(
    fitted: Floats | float, held_out: Floats | float, rows: NDArray[np.bool_], held: NDArray[np.bool_]
) -> Floats:
    """Return values (n,) for all rows, NaN for those left out."""
    out = np.full(held.size, np.nan)
    out[rows], out[held] = fitted, held_out
    return out
