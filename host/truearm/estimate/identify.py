"""Hop 7: from a table of observations to an Estimate. Validates, dispatches to a solver, says what was not seen."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from truearm.errors import ProblemError
from truearm.estimate.identifiability import Identifiability, identifiability
from truearm.estimate.information import RANK_TOLERANCE, Information, covariance, observe, seen, spectrum, with_prior
from truearm.estimate.lm import Minimum, minimise
from truearm.estimate.problem import Problem, build_problem, evaluate, settled
from truearm.model.chain import Chain
from truearm.observe.socket_distance import SocketDistanceRows
from truearm.types import Estimate, Floats, HeldOut, ObservationTable, Rig

SOLVERS = ("lm",)
LEAST_FREEDOM = 1e-6  # share of a row's residuals that must be left to judge by; rounding leaves 1e-12
Progress = Callable[[int, float], None]  # iteration, RMS of the residuals [m]


def identify(
    chain: Chain,
    rig: Rig,
    table: ObservationTable,
    *,
    free: NDArray[np.bool_] | None = None,
    hold_out: NDArray[np.bool_] | None = None,
    prior_sigma: Mapping[str, float] | Floats | None = None,
    solver: str = "lm",
    max_iterations: int = 50,
    progress: Progress | None = None,
) -> Estimate:
    """Identify the robot's free parameters and the rig's unknowns.

    free : (p,) robot parameters to identify, default all; the rig's unknowns always are.
    hold_out : (n,) rows that are not used to fit but to judge, default none. Unknowns of the rig that only these rows
        touch (the sockets of a place that was held out) are estimated on them, with the robot fixed.
    prior_sigma : σ of robot parameters about their nominal values, by name or (p,) with inf for none; default none.
    progress : called with (iteration, RMS [m]) after each step.

    Raises ProblemError for masks of the wrong shape, no row to fit, an unknown solver, and what ``build_problem``
    raises. Rank and convergence are fields of the result.
    """
    started = time.perf_counter()
    free = _mask("free", free, len(chain.parameters), default=True)
    held = _mask("hold_out", hold_out, len(table), default=False)
    if solver not in SOLVERS:
        raise ProblemError(f"solver {solver!r} is not known; use {', '.join(SOLVERS)}")
    if held.all():
        raise ProblemError("no observations are left to fit; hold out less")
    problem = build_problem(chain, rig, table.select(~held), prior_sigma)
    columns = np.concatenate([free, np.ones(len(problem.names) - free.size, dtype=bool)])
    history: list[float] = []

    def on_step(iteration: int, information: Information) -> None:
        history.append(_rms(information.residual))
        if progress is not None:
            progress(iteration, history[-1])

    before = observe(problem, problem.start, columns).residual
    minimum, x = solve(problem, columns, problem.start, max_iterations, on_step)
    found, matrix = _what_is_seen(problem, columns, x, minimum)
    identifiable = _spread(found.identifiable, columns)
    variance = np.where(identifiable, np.diag(matrix), np.nan)
    held_before, error_before = _judge(problem, problem.start, rig, table, held)
    held_after, error_after = _judge(problem, x, rig, table, held)
    freedom = minimum.information.n_residuals - int(seen(spectrum(minimum.information.root)).sum())
    return Estimate(
        status=minimum.status,
        message=minimum.message,
        solver=solver,
        iterations=minimum.iterations,
        parameter_names=problem.names,
        units=problem.units,
        nominal=problem.start,
        value=x,
        sigma=np.sqrt(variance),
        free=columns,
        identifiable=identifiable,
        covariance=matrix,
        n_robot_parameters=problem.n_robot,
        n_observations=problem.n_rows,
        rank=found.rank,
        rank_gap=found.gap,
        null_space=found.null_space,
        rms_before=_rms(before),
        rms_after=_rms(minimum.information.residual),
        rms_history=(_rms(before), *history),
        chi2_reduced=minimum.information.chi2 / freedom if freedom > 0 else float("nan"),
        held_out=held_after,
        held_out_before=held_before,
        residual=_merge(minimum.information.residual, error_after, held),
        residual_before=_merge(before, error_before, held),
        fitted=~held,
        seconds=time.perf_counter() - started,
    )


def solve(
    problem: Problem,
    columns: NDArray[np.bool_],
    x: Floats,
    max_iterations: int = 50,
    on_step: Callable[[int, Information], None] | None = None,
) -> tuple[Minimum, Floats]:
    """Minimise over x[columns] from x (P,), priors included; returns the minimum and the whole x."""

    def whole(part: Floats) -> Floats:
        out = x.copy()
        out[columns] = part
        return out

    def linearise(part: Floats) -> Information:
        error = problem.start[columns] - part
        return with_prior(observe(problem, whole(part), columns), error, problem.prior_sigma[columns])

    minimum = minimise(linearise, x[columns], max_iterations, on_step)
    return minimum, whole(minimum.x)


def _what_is_seen(
    problem: Problem, columns: NDArray[np.bool_], x: Floats, minimum: Minimum
) -> tuple[Identifiability, Floats]:
    """Rank and null space by the data and what is known of the rig, without the robot's prior; covariance with all."""
    n_robot = int(columns[: problem.n_robot].sum())
    rig_prior = problem.prior_sigma[columns]
    rig_prior[:n_robot] = np.inf
    data = with_prior(observe(settled(problem, x), x, columns), (problem.start - x)[columns], rig_prior)
    names = [name for name, is_free in zip(problem.names, columns, strict=True) if is_free]
    matrix = np.zeros((x.size, x.size))
    matrix[np.ix_(columns, columns)] = covariance(spectrum(minimum.information.root))
    return identifiability(data.root, n_robot, names), matrix


def _judge(
    fit: Problem, x_fit: Floats, rig: Rig, table: ObservationTable, held: NDArray[np.bool_]
) -> tuple[HeldOut | None, Floats]:
    """Errors on the held-out rows with the robot of x_fit; the rig's unknowns from x_fit, or else from these rows."""
    if not held.any():
        return None, np.zeros(0)
    problem = build_problem(fit.chain, rig, table.select(held))
    # The known distance between sockets must not help to place them: the error is the spread about each socket.
    problem = replace(problem, groups=tuple(g for g in problem.groups if not isinstance(g, SocketDistanceRows)))
    known = dict(zip(fit.names, x_fit, strict=True))
    columns = np.array([name not in known for name in problem.names])
    x = np.array([known.get(name, value) for name, value in zip(problem.names, problem.start, strict=True)])
    minimum, x = solve(problem, columns, x)
    error = minimum.information.residual
    judging = _has_freedom(problem, columns, x)
    if not judging.any():
        return None, error
    size = np.abs(error[judging])
    settled_here, left_out = int(columns.sum()), int((~judging).sum())
    return HeldOut(_rms(size), float(size.mean()), float(size.max()), size.size, settled_here, left_out), error


def _has_freedom(problem: Problem, columns: NDArray[np.bool_], x: Floats) -> NDArray[np.bool_]:
    """Rows (n,) that the unknowns x[columns], settled on them, could not make to fit whatever they say.

    The trace of a row's block of the hat matrix J (JᵀJ)⁺ Jᵀ is its number of residuals where they fit by construction:
    the only seat in a socket, say.
    """
    free = np.ones(problem.n_rows, dtype=bool)
    if not columns.any():
        return free
    groups = [group for group in problem.groups if not isinstance(group, SocketDistanceRows)]
    whole = [(group.row, evaluate(problem, group, x).jac_params[:, columns]) for group in groups]
    basis, weight, _ = np.linalg.svd(np.concatenate([jac for _, jac in whole]), full_matrices=False)
    hat = np.sum(basis[:, weight > RANK_TOLERANCE * weight.max(initial=0.0)] ** 2, axis=1)
    at = 0
    for row, jac in whole:
        share = hat[at : at + len(jac)].reshape(row.size, -1).mean(axis=1)
        free[row[share > 1.0 - LEAST_FREEDOM]] = False
        at += len(jac)
    return free


def _mask(name: str, mask: NDArray[np.bool_] | None, size: int, default: bool) -> NDArray[np.bool_]:
    if mask is None:
        return np.full(size, default)
    mask = np.asarray(mask)
    if mask.shape != (size,) or mask.dtype != bool:
        raise ProblemError(f"{name} must be {size} booleans, is {mask.dtype} of shape {mask.shape}")
    return mask


def _rms(residual: Floats) -> float:
    return float(np.sqrt(np.mean(residual**2)))


def _spread(flags: NDArray[np.bool_], columns: NDArray[np.bool_]) -> NDArray[np.bool_]:
    out = np.zeros(columns.size, dtype=bool)
    out[columns] = flags
    return out


def _merge(fitted: Floats, held_out: Floats, held: NDArray[np.bool_]) -> Floats:
    out = np.empty(held.size)
    out[~held], out[held] = fitted, held_out
    return out
