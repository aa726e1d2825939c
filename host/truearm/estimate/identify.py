"""Identify an Estimate from a table of observations. Validates input, calls a solver and analyses the null space."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm import option_defaults
from truearm.errors import ProblemError
from truearm.estimate.bad_rows import MOST as MOST_BAD
from truearm.estimate.bad_rows import without_bad_rows
from truearm.estimate.fit import fit
from truearm.estimate.frame_choice import mounting
from truearm.estimate.further_measurements import additions
from truearm.estimate.identifiability import (
    Identifiability,
    hardly_seen,
    identifiability,
    identifiable_columns,
    is_weakly_identifiable,
    observability,
    spread,
    suggested_free,
)
from truearm.estimate.information import half, observe, of_rows, spectrum, with_prior
from truearm.estimate.levenberg_marquardt import idle
from truearm.estimate.mean_error import mean_errors
from truearm.estimate.measured_order import poses
from truearm.estimate.other_fits import with_all_rows, without_bad
from truearm.estimate.outliers import gross_rows, weightless, without_outliers
from truearm.estimate.pose_effect import pose_effect
from truearm.estimate.prior import weak_prior
from truearm.estimate.problem import (
    Problem,
    build_problem,
    modelled_of,
    settled,
    without_effect_priors,
    without_knowledge,
)
from truearm.estimate.row_errors import left_out_errors, row_errors
from truearm.estimate.solution import Options, Solution, of_data
from truearm.estimate.solvers import SOLVERS, Loss, with_loss
from truearm.estimate.solvers import solver as solver_of
from truearm.estimate.systematic_effects import Modelled
from truearm.estimate.uncertainty import goodness, prior_shares
from truearm.estimate.validation import has_freedom
from truearm.estimate.whitened_rows import only, weighted_chi2
from truearm.kinds.table import ObservationTable
from truearm.model.chain import Chain
from truearm.results import Effect, Estimate, Figures, HeldOut, MeanError, NullDirection
from truearm.types import Floats, Residuals, Rigs, not_left_out
from truearm.units import UNITS

TIME_OFFSET = "time_offset"
DAMPINGS = ("scaled", "plain")
WORTH = 1e-4  # of χ², by all of the last steps: a figure of the nominal robot, and a start, need no more
Progress = Callable[[int, Mapping[str, float]], None]  # iteration, RMS of the residuals by SI unit


@dataclass(frozen=True)
class SolverOptions:
    """Options of an identification.

    solver : one of SOLVERS; each is a module that documents its method.
    loss : "linear", "huber" or "cauchy" (robust.py), for the solvers lm and map.
    damping : for lm: "scaled" columns (Marquardt) or "plain" λI (Goswami's (10)).
    progress : called with (iteration, RMS by SI unit) after each step.
    effects : systematic errors to estimate as well; their rows are rows of the table.
    leave_out : rows to neither fit nor validate on: the first, and the one after the last, from 0.
    reject : fit again without outliers (``outliers``), for a least-squares fit by lm or map.
    outliers : (n,) rows known to be outliers, instead of those that the fit itself would reject.
    """

    solver: str = option_defaults.SOLVER
    loss: str = option_defaults.LOSS
    damping: str = "scaled"
    max_iterations: int = option_defaults.MAX_ITERATIONS
    progress: Progress | None = None
    effects: tuple[Effect, ...] = ()
    leave_out: tuple[tuple[int, int], ...] = ()
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
    prior_sigma: Mapping[str, float] | Floats | None = None,
    prefer: NDArray[np.bool_] | None = None,
    options: SolverOptions = DEFAULTS,
) -> Estimate:
    """Identify the robot's free parameters and the rig's unknowns.

    free : (p,) robot parameters to identify, default all; the rig's unknowns are always identified.
    hold_out : (n,) rows to validate on instead of fitting them, default none. Unknowns of the rig that only these rows
        touch (such as the sockets of a held-out place, or the pose of a line) are estimated on them, with the robot
        fixed.
    prior_sigma : σ of robot parameters about their nominal values, by name or (p,) with inf for none; default none.
    prefer : (p,) parameters that the suggested free set should preferably contain, a robot file's ``free``; default
    none.
    options : solver, loss, damping, maximum number of iterations, and progress callback.

    Raises ProblemError for masks of the wrong shape, no row to fit, an unknown solver, loss or damping, a loss for a
    solver without losses, and for the same reasons as ``build_problem``. Rank and convergence are fields of the result.
    """
    started = time.perf_counter()
    free = _mask("free", free, len(chain.parameters), default=True)
    held = _mask("hold_out", hold_out, len(table), default=False)
    prefer = _mask("prefer", prefer, len(chain.parameters), default=False)
    _check_choice(options.solver, options.loss, options.damping)
    left_out = rows_left_out(options.leave_out, len(table))
    held = held & ~left_out
    fitted = ~(held | left_out)
    if not fitted.any():
        raise ProblemError("nothing-left", what="observations")
    modelled = modelled_of(chain, rig, table, options.effects)
    problem = build_problem(chain, rig, table.select(fitted), prior_sigma, [one.select(fitted) for one in modelled])
    columns = problem.columns(free)
    history: list[dict[str, float]] = []

    def on_step(iteration: int, residual: Residuals) -> None:
        history.append(rms_of(residual))
        if options.progress is not None:
            options.progress(iteration, history[-1])

    x_raw, raw = _raw(problem, options.max_iterations)
    gross = np.zeros(problem.n_rows, dtype=bool)
    rejects = options.reject and SOLVERS[options.solver].has_loss and options.loss == Loss.LINEAR
    of_rig = problem.of_rig
    if options.outliers is not None:
        gross = options.outliers[fitted]
        x_raw = fit(only(problem, ~gross), of_rig, x_raw, Options()).x if of_rig.any() else x_raw
    elif rejects:
        gross, x_raw = gross_rows(problem, of_rig, x_raw)
    raw = observe(problem, x_raw, columns).residual if gross.any() else raw
    pose = poses(table.select(fitted))
    nominal = _before(problem, columns, x_raw, raw, gross)
    how_to = Options(options.max_iterations, Loss(options.loss), options.damping == "plain", on_step)
    # Robot and a distant rig together make a curved valley; a rig that was fitted alone is a closer start (decision 19).
    start = x_raw if SOLVERS[options.solver].starts_from_rig else problem.start
    solve = solver_of(options.solver)
    found = every = solve(problem, columns, start, how_to)
    begun = solve(only(problem, ~gross), columns, start, how_to._replace(on_step=None)) if gross.any() else every
    rejected = None
    if options.outliers is not None:
        found = weightless(problem, columns, begun, ~gross)
    elif rejects and begun.status == "converged":
        rejected = without_outliers(problem, columns, begun, how_to, gross)
        found = rejected.found if rejected is not None and rejected.explained else every
    x, information = found.x, found.information
    parts = spectrum(information.root)
    shares = prior_shares(half(parts), found.prior_sigma)
    unweighted = goodness(*of_data(problem, columns, found), shares)
    loss = Loss(options.loss)
    rows = row_errors(problem, x, columns, half(parts), found.weight, pose)
    distance, beyond = rows.distance, rows.beyond
    fit_quality, bad = unweighted, None
    if rejects and found is every and found.status == "converged" and not fit_quality.explained:
        bad = without_bad_rows(problem, columns, found, fit_quality, how_to)
    if loss is not Loss.LINEAR:  # outliers that it tolerates are named, and not a misfit of the others
        tolerated = only(problem, ~beyond if beyond.mean() <= MOST_BAD else np.ones_like(beyond))
        fit_quality = goodness(*weighted_chi2(tolerated, x, loss), shares)
    taken = only(problem, found.weight > 0.0)
    still = settled(taken, x)
    data = of_rows(still, x, columns)
    names = problem.names_of(columns)
    sight = determined(still, x, columns, modelled, data.root)
    suggested = suggested_free(data.root, int(free.sum()), prefer[free])
    unit = weak_prior(chain)[free]
    weak = hardly_seen(data.root, suggested.size, unit, names)
    only_weak = suggested.all() and len(weak) > 0
    wanting = (identifiable_columns(data.root, suggested.size, unit), unit) if only_weak else (suggested, None)
    untimed = _untimed(data.root, names)
    known = dict(zip(problem.names, x, strict=True))
    if bad is not None:
        distance, beyond = bad.distance, bad.bad
    identifiable = spread(sight.identifiable & ~np.isin(names, untimed), columns)
    matrix = np.zeros((x.size, x.size))
    # Robust losses and the solvers that estimate the noise from the residuals include it in their covariance.
    as_declared = loss is Loss.LINEAR and not SOLVERS[options.solver].reads_noise
    shared = pose_effect(taken, x, columns, half(parts), pose) if as_declared else None
    matrix[np.ix_(columns, columns)] = found.covariance if shared is None else shared.covariance
    held_before, error_before = judged(problem, nominal.x, rig, table, held, modelled)
    held_after, error_after = judged(problem, x, rig, table, held, modelled)
    if held_after is not None:
        unfitted, unfitted_before = (merged({}, error, fitted, held) for error in (error_after, error_before))
    else:
        inliers, error = taken, rows.left_out
        if loss is not Loss.LINEAR:
            inliers = only(problem, ~beyond)
            error = left_out_errors(inliers, x, columns, half(parts), pose)
        robots = error, left_out_errors(inliers, nominal.x, nominal.mounts, nominal.root, pose)
        unfitted, unfitted_before = (merged(each, {}, fitted, held) for each in robots)
    if not np.any(columns & ~nominal.mounts):
        unfitted_before = {}
    unexplained: Mapping[str, MeanError] = {}
    if not fit_quality.explained:
        unexplained = mean_errors(unfitted, poses(table), held_out=held_after is not None)
    used = not_left_out(found.weight)
    estimate = Estimate(
        status=found.status,
        message=found.message,
        solver=options.solver,
        iterations=found.iterations,
        parameter_names=problem.names,
        units=problem.units,
        nominal=problem.start,
        value=x,
        sigma=np.sqrt(np.where(identifiable, np.diag(matrix), np.nan)),
        free=columns,
        identifiable=identifiable,
        covariance=matrix,
        n_robot_parameters=problem.n_robot,
        n_observations=problem.n_rows,
        rank=sight.rank,
        rank_gap=sight.gap,
        null_space=sight.null_space,
        rms_before=rms_of(nominal.residual, used),
        rms_raw=rms_of(raw, used),
        rms_after=rms_of(information.residual, used),
        rms_history={unit: tuple(rms[unit] for rms in (rms_of(raw), *history)) for unit in raw},
        chi2_reduced=fit_quality.reduced,
        held_out=held_after,
        held_out_before=held_before,
        residual=merged(information.residual, error_after, fitted, held),
        residual_before=merged(nominal.residual, error_before, fitted, held),
        fitted=fitted,
        left_out=left_out,
        seconds=0.0,
        loss=options.loss,
        chi2_band=fit_quality.band,
        chi2_freedom=fit_quality.freedom,
        distance=_merge(distance, np.nan, fitted, held),
        weight=_merge(found.weight, np.nan, fitted, held),
        outlying=spread((found if rejected is None else rejected.found).weight == 0.0, fitted),
        suspect=spread(beyond | (found.weight == 0.0), fitted),
        observability=observability(data.root, int(free.sum()), suggested, unit, data.n_residuals),
        suggested_free=spread(suggested, free),
        hardly_seen=(*weak, *(NullDirection((name,), (1.0,)) for name in untimed)),
        additions=additions(chain, rig, table.select(fitted), names, data.root, known, *wanting),
        prior_sigma=_prior(problem, columns, found),
        unexplained=unexplained,
        unfitted_error=unfitted,
        unfitted_error_before=unfitted_before,
        with_outliers=None if found is every else with_all_rows(problem, columns, every, found),
        without_bad_rows=None if bad is None else without_bad(bad, chain, x, table.q[fitted]),
        parts=rows.parts,
        pose_error=None if shared is None else shared.error,
        unseen=sight.unseen,
    )
    return replace(estimate, seconds=time.perf_counter() - started)


def _prior(problem: Problem, columns: NDArray[np.bool_], found: Solution) -> Floats:
    """Return σ (P,) of the prior that the solver used; inf for none."""
    sigma = problem.prior_sigma.copy()
    sigma[columns] = found.prior_sigma
    return sigma


def rows_left_out(spans: Sequence[tuple[int, int]], n: int) -> NDArray[np.bool_]:
    """Return a mask (n,) of the rows in some spans. Raises ProblemError for a span that is not within the table."""
    out = np.zeros(n, dtype=bool)
    for first, last in spans:
        if not 0 <= first < last <= n:
            rows = f"row {last}" if last == first + 1 else f"rows {first + 1} to {last}"
            raise ProblemError(f"{rows} cannot be left out: the table has rows 1 to {n}")
        out[first:last] = True
    return out


def determined(
    problem: Problem, x: Floats, columns: NDArray[np.bool_], effects: Sequence[Modelled], root: Floats | None = None
) -> Identifiability:
    """Return what the rows determine of x[columns], linearised at x. Its ``unseen`` (P, d) has a row for each unknown.

    ``problem`` is ``settled``; ``root`` (k, k) is that of its rows with the priors of effects, where it was computed.
    """
    if root is None or effects:
        root = of_rows(without_effect_priors(problem, effects), x, columns).root
    sight = identifiability(root, int(columns[: problem.n_robot].sum()), problem.names_of(columns))
    unseen = np.zeros((x.size, sight.unseen.shape[1]))
    unseen[columns] = sight.unseen
    return sight._replace(unseen=unseen)


def _untimed(root: Floats, names: Sequence[str]) -> list[str]:
    """Return the time offsets that the data hardly determine, whose sigma would be meaningless."""
    offsets = [k for k, name in enumerate(names) if name.rpartition(".")[2] == TIME_OFFSET]
    return [names[k] for k in offsets if is_weakly_identifiable(root, k, UNITS["s"].weak_sigma)]


def _check_choice(solver: str, loss: str, damping: str) -> None:
    for what, given, known in (
        ("solver", solver, SOLVERS),
        ("loss", loss, tuple(Loss)),
        ("damping", damping, DAMPINGS),
    ):
        if given not in known:
            raise ProblemError("wrong-value", place=what, value=given, names=list(known))
    if loss != Loss.LINEAR and not SOLVERS[solver].has_loss:
        raise ProblemError(f"solver {solver} has no robust loss; use {' or '.join(with_loss())}, or loss linear")
    if damping != "scaled" and solver != "lm":
        raise ProblemError(f"solver {solver} has no damping setting; use lm")


def _raw(problem: Problem, max_iterations: int) -> tuple[Floats, Residuals]:
    """Return x (P,) and residuals of the nominal robot, with the rig's unknowns fitted to it.

    An unmeasured position of a ball or chuck is not an error of the robot. With a guessed rig, the identification would
    be credited with correcting it.
    """
    rig_only = problem.of_rig
    if not rig_only.any():
        return problem.start, observe(problem, problem.start, rig_only).residual
    # The nominal robot's errors do not make rows outliers: no gate and no robust loss.
    found = fit(problem, rig_only, problem.start, Options(max_iterations, ends=idle(WORTH)))
    return found.x, found.information.residual


class _Nominal(NamedTuple):
    """The nominal robot with base and tool placed: x (P,), residuals, the fitted columns (P,), the root of their covariance."""

    x: Floats
    residual: Residuals
    mounts: NDArray[np.bool_]
    root: Floats


def _before(
    problem: Problem, columns: NDArray[np.bool_], x: Floats, raw: Residuals, gross: NDArray[np.bool_]
) -> _Nominal:
    """Return the nominal robot, with base and tool placed by the rows that are not gross.

    Starts from the result of ``_raw``. The mounting of base and tool is not an error of the robot either. Only the free
    parameters that move nothing else are fitted, with the rig's unknowns.
    """
    mounted = mounting(problem.chain, x[: problem.n_robot]).either & columns[: problem.n_robot]
    mounts, residual = problem.columns(mounted), raw
    if mounted.any():
        found = fit(only(problem, ~gross), mounts, x, Options(ends=idle(WORTH)))
        x, information = found.x, found.information
        residual = observe(problem, x, mounts).residual if gross.any() else information.residual
    else:
        prior = (problem.start - x)[mounts], problem.prior_sigma[mounts]
        information = with_prior(observe(problem, x, mounts), *prior)
    return _Nominal(x, residual, mounts, half(spectrum(information.root)))


def judged(
    fitted: Problem,
    x_fit: Floats,
    rig: Rigs,
    table: ObservationTable,
    held: NDArray[np.bool_],
    modelled: Sequence[Modelled],
) -> tuple[HeldOut | None, Residuals]:
    """Return errors on the held-out rows with the robot of x_fit; the rig's unknowns from x_fit, otherwise from these rows."""
    if not held.any():
        return None, {}
    rows = table.select(held)
    if modelled:  # the items that these rows use
        names = build_problem(fitted.chain, rig, rows).errors.names
        modelled = [effect.select(held) for effect in modelled if effect.column in names]
    # The known distance between sockets must not help to place them: the error is the spread about each socket.
    problem = without_knowledge(build_problem(fitted.chain, rig, rows, None, modelled))
    known = dict(zip(fitted.names, x_fit, strict=True))
    columns = np.array([name not in known for name in problem.names])
    solution = fit(problem, columns, problem.at(known), Options())
    error, x = solution.information.residual, solution.x
    judging = has_freedom(problem, columns, x)
    error = {unit: np.where(judging, of, np.nan) for unit, of in error.items()}
    if not judging.any():
        return None, error
    settled_here, left_out = int(columns.sum()), int((~judging).sum())
    return HeldOut(Figures.by_unit(error, judging), int(judging.sum()), settled_here, left_out), error


def _mask(name: str, mask: NDArray[np.bool_] | None, size: int, default: bool) -> NDArray[np.bool_]:
    if mask is None:
        return np.full(size, default)
    mask = np.asarray(mask)
    if mask.shape != (size,) or mask.dtype != bool:
        raise ProblemError(f"{name} must be {size} booleans, is {mask.dtype} of shape {mask.shape}")
    return mask


def rms_of(residual: Residuals, rows: NDArray[np.bool_] | slice = slice(None)) -> dict[str, float]:
    return {unit: figures.rms for unit, figures in Figures.by_unit(residual, rows).items()}


def merged(fitted: Residuals, held_out: Residuals, rows: NDArray[np.bool_], held: NDArray[np.bool_]) -> Residuals:
    units = [unit for unit in UNITS if unit in fitted or unit in held_out]
    return {unit: _merge(fitted.get(unit, np.nan), held_out.get(unit, np.nan), rows, held) for unit in units}


def _merge(
    fitted: Floats | float, held_out: Floats | float, rows: NDArray[np.bool_], held: NDArray[np.bool_]
) -> Floats:
    """Return values (n,) for all rows, NaN for those left out."""
    out = np.full(held.size, np.nan)
    out[rows], out[held] = fitted, held_out
    return out
