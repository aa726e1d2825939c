"""Recursive estimation (Renders 1991, II-F): one observation at a time, with a gate against outliers.

docs/explanation/estimation.md has the formulas: the paper's (18) and (20), corrected, with P = S Sᵀ.

A pass processes every row once, all linearised at one x, from the same prior. The next pass is linearised where the
last one ended, so no data count twice. A pass that would increase χ² is repeated from a narrower prior, by the rule of
``lm``. (``renders1991`` has the paper's III-E.)

During a pass the gate compares a row with those before it, as is possible live. The final decision, after the passes,
compares each row with all others. Each round leaves out rows beyond the gate that are at least half as far as the
farthest.

``update`` needs the filter and one row, ``minimise`` all rows. P(0) must be finite: an unknown without a prior starts
with ``DIFFUSE``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.estimate import levenberg_marquardt as lm
from truearm.estimate.information import covariance, observe, spectrum, with_prior
from truearm.estimate.parameter_update import Step, added, stepper
from truearm.estimate.problem import Problem
from truearm.estimate.solution import Options, Solution, prior_error, whole
from truearm.estimate.whitened_rows import GATE_LEVEL, deleted_distance, gate, only, whitened_blocks
from truearm.types import Floats

DIFFUSE = 10.0  # σ of an unknown without a prior; 1e5 times what millimetre work would leave, 1e-10 in the result
NEAR_FARTHEST = 0.25  # of the farthest squared distance: half the distance
MAX_ROUNDS = 50


class Filter(NamedTuple):
    """The estimate after some rows: correction Δ and square root S of its covariance P = S Sᵀ."""

    delta: Floats  # (k,)
    root: Floats  # (k, k)


class Rows(NamedTuple):
    """Whitened observations linearised at one x; w scalar rows per observation, padded with zeros to the widest."""

    jac: Floats  # (n, w, k)
    residual: Floats  # (n, w)
    width: NDArray[np.intp]  # (n,) scalar rows that are not padding
    row: NDArray[np.intp]  # (n,) rows of the table; -1: knowledge (a known distance), not subject to the gate
    noise_root: Floats  # (n, w, w) noise_root @ residual is in m


class Pass(NamedTuple):
    """One pass through all rows, with the state of each row just before it was processed."""

    filter: Filter
    innovation: Floats  # (n, w) whitened, r − J Δ(N−1): the prediction error of Fig. 4 is noise_root @ innovation
    distance: Floats  # (n,) squared Mahalanobis distance of the innovation


class Ending(NamedTuple):
    """The result of the passes; ``distance`` is each row's final distance, ``used`` the rows that P and x are based on."""

    x: Floats  # (k,)
    status: str
    message: str
    passes: int
    covariance: Floats  # (k, k)
    used: NDArray[np.bool_]  # (n,) of ``rows``
    distance: Floats  # (n,) squared, see ``deleted_distance``
    rows: Rows  # at x
    first: Pass  # of the first pass, as seen live


def start(mean_minus_x: Floats, sigma: Floats) -> Filter:
    """Return the prior: Δ(0) = mean − x (k,), P(0) = diag(σ²); an infinite σ becomes ``DIFFUSE`` about x itself."""
    some = np.isfinite(sigma)
    return Filter(np.where(some, mean_minus_x, 0.0), np.diag(np.where(some, sigma, DIFFUSE)))


def update(state: Filter, jac: Floats, residual: Floats) -> tuple[Filter, Floats, float]:
    """Process one observation of w whitened rows: jac (w, k), residual (w,).

    Returns the new filter, the innovation (w,) and its squared Mahalanobis distance. Rows are independent after
    whitening, so they are processed one by one, and the distance is the sum of ν²/v over them. Measured: 18 µs per
    scalar row at 60 unknowns.
    """
    before = residual - jac @ state.delta
    delta, root, distance = state.delta, state.root, 0.0
    for j, r in zip(jac, residual, strict=True):
        seen = j @ root
        variance = seen @ seen + 1.0
        ahead = root @ seen
        innovation = r - j @ delta
        distance += innovation * innovation / variance
        delta = delta + ahead * (innovation / variance)
        root = root - np.multiply.outer(ahead / (variance + np.sqrt(variance)), seen)
    return Filter(delta, root), before, float(distance)


def run(state: Filter, rows: Rows, used: NDArray[np.bool_]) -> Pass:
    """Process all rows in order; rows that are not ``used`` are evaluated but not included."""
    innovation, distance = np.zeros_like(rows.residual), np.zeros(len(rows.residual))
    for i, width in enumerate(rows.width.tolist()):
        after, innovation[i, :width], distance[i] = update(state, rows.jac[i, :width], rows.residual[i, :width])
        if used[i]:
            state = after
    return Pass(state, innovation, distance)


def solve(problem: Problem, columns: NDArray[np.bool_], x: Floats, options: Options) -> Solution:
    """Estimate recursively over x[columns] from x (P,); rows beyond the gate have weight 0 in the result."""

    def linearise(part: Floats) -> Rows:
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            return rows_of(problem, whole(x, columns, part), columns)

    def on_pass(passes: int, part: Floats) -> None:
        if options.on_step is not None:
            options.on_step(passes, observe(problem, whole(x, columns, part), columns).residual)

    mean, sigma = problem.start[columns], problem.prior_sigma[columns]
    ending = minimise(
        linearise, x[columns], mean, sigma, options.max_iterations, on_pass, move=stepper(problem, columns)
    )
    x = whole(x, columns, ending.x)
    weight = np.ones(problem.n_rows)
    of_table = ending.rows.row >= 0
    weight[ending.rows.row[of_table]] = ending.used[of_table]
    data = observe(only(problem, weight > 0.0), x, columns)
    data = data._replace(residual=observe(problem, x, columns).residual)
    information = with_prior(data, *prior_error(problem, columns, x))
    claimed = covariance(spectrum(information.root))
    return Solution(x, ending.status, ending.message, ending.passes, information, claimed, weight, sigma)


def rows_of(problem: Problem, x: Floats, columns: NDArray[np.bool_]) -> Rows:
    """Return all observations at x (P,) in the order of the table, preceded by prior knowledge."""
    blocks = list(whitened_blocks(problem, x, columns))
    widest = max((b.residual.shape[1] for b in blocks), default=1)
    k = int(columns.sum())
    if not blocks:
        return Rows(np.zeros((0, 1, k)), np.zeros((0, 1)), *(np.zeros(0, np.intp),) * 2, np.zeros((0, 1, 1)))
    jac, residual, noise = [], [], []
    for b in blocks:
        more = widest - b.residual.shape[1]
        jac.append(np.pad(b.jac, ((0, 0), (0, more), (0, 0))))
        residual.append(np.pad(b.residual, ((0, 0), (0, more))))
        noise.append(np.pad(b.noise_root, ((0, 0), (0, more), (0, more))))
    width = np.concatenate([np.full(len(b.residual), b.residual.shape[1]) for b in blocks])
    row = np.concatenate([np.full(len(b.residual), -1) if b.row is None else b.row for b in blocks])
    order = np.argsort(row, kind="stable")
    jac_all, residual_all, noise_all = (np.concatenate(part)[order] for part in (jac, residual, noise))
    return Rows(jac_all, residual_all, width[order], row[order], noise_all)


def minimise(
    linearise: Callable[[Floats], Rows],
    x: Floats,
    mean: Floats,
    sigma: Floats,
    max_passes: int,
    on_pass: Callable[[int, Floats], None] | None = None,
    move: Step = added,
) -> Ending:
    """Repeat passes from x (k,) until neither x nor the set of rows within the gate changes.

    ``linearise(x)`` returns all rows at x; the prior is ``mean`` (k,) ± ``sigma`` (k,), inf for none. Relinearising
    ends with a pass whose step changes the predictions of the rows by an RMS of 1e-6 of their σ, or of their residuals.
    Then the gate is applied. Failure to converge is a status, not an exception.
    """
    rows = linearise(x)
    used = np.ones(len(rows.residual), dtype=bool)
    limit = np.where(rows.row < 0, np.inf, gate(rows.width, GATE_LEVEL))
    first: Pass | None = None
    seen_sets: set[bytes] = set()
    rounds, passes, damping = 0, 0, 0.0
    search = _Search(linearise, mean, sigma, move)
    while True:
        now = run(start(mean - x, sigma), rows, used)
        first = first or now
        state = now.filter
        moved = float(np.linalg.norm(rows.jac @ state.delta))
        if not np.isfinite(moved):
            return _ending(
                x, "stalled", "residuals or derivatives are not finite numbers", passes, state, used, rows, first
            )
        settled = moved <= lm.RELATIVE_END * max(np.sqrt(rows.residual.size), np.linalg.norm(rows.residual[used]))
        if passes == max_passes and not settled:
            message = f"{max_passes} passes were not enough"
            return _ending(x, "max_iterations", message, passes, state, used, rows, first)
        if not settled:
            nearer = _nearer(search, x, rows, used, state.delta, damping)
            if nearer is None:
                message = "no pass reduces the residuals"
                return _ending(x, "stalled", message, passes, state, used, rows, first)
            x, rows, damping = nearer
            passes += 1
            if on_pass is not None:
                on_pass(passes, x)
            continue
        distance = deleted_distance(rows.jac, rows.residual, state.root, used.astype(float))
        chosen = within(distance, limit, used)
        rounds += 1
        if np.array_equal(chosen, used):
            return _ending(x, "converged", _verdict(used), passes, state, used, rows, first)
        if chosen.tobytes() in seen_sets or rounds > MAX_ROUNDS:
            return _ending(
                x, "stalled", "from pass to pass, other rows are left out as outliers", passes, state, used, rows, first
            )
        seen_sets.add(used.tobytes())
        used = chosen


class _Search(NamedTuple):
    """The data that stay the same from pass to pass: rows as a function of x, prior, and step function."""

    linearise: Callable[[Floats], Rows]
    mean: Floats  # (k,)
    sigma: Floats  # (k,)
    move: Step


def _nearer(
    search: _Search, x: Floats, rows: Rows, used: NDArray[np.bool_], delta: Floats, damping: float
) -> tuple[Floats, Rows, float] | None:
    """Return the result of a pass that fits used rows and prior better than x does, and the next λ; None if there is none.

    ``delta`` is the result of an undamped pass.
    """
    before = _cost(rows, rows, used, (search.mean - x) / search.sigma)
    refused = False
    while damping <= lm.DAMPING_MAX:
        if damping:
            delta = run(_narrowed(search, x, rows, used, damping), rows, used).filter.delta
        goal = search.move(x, delta)
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            there = search.linearise(goal)
            chi2 = _cost(there, rows, used, (search.mean - goal) / search.sigma)
        if chi2 < before:
            ahead = rows._replace(residual=rows.residual - rows.jac @ delta)
            predicted = before - _cost(ahead, rows, used, (search.mean - x - delta) / search.sigma)
            return goal, there, lm.after_step(damping, (before - chi2) / predicted, refused)
        refused, damping = True, lm.after_refusal(damping)
    return None


def _narrowed(search: _Search, x: Floats, rows: Rows, used: NDArray[np.bool_], damping: float) -> Filter:
    """Return the prior combined with one that holds x, with λ times the weight of all rows: Marquardt's damping in a filter."""
    known = np.where(np.isfinite(search.sigma), search.sigma, DIFFUSE) ** -2.0
    weight = known + damping * (known + (rows.jac[used] ** 2).sum(axis=(0, 1)))
    pull = np.where(np.isfinite(search.sigma), search.mean - x, 0.0)
    return Filter(pull * known / weight, np.diag(weight**-0.5))


def _cost(there: Rows, here: Rows, used: NDArray[np.bool_], prior: Floats) -> float:
    """Return χ² of residuals ``there`` with the weights of ``here``."""
    widest = there.residual.shape[1]
    padding = np.arange(widest) >= here.width[:, None]
    roots = here.noise_root + padding[:, :, None] * np.eye(widest)
    residual = np.linalg.solve(roots, there.noise_root @ there.residual[..., None])[..., 0]
    return float((residual[used] ** 2).sum() + prior @ prior)


def within(distance: Floats, limit: Floats, used: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the rows for the next round: without the farthest, and with those that are back within the gate."""
    far = distance / limit
    worst = far[used].max(initial=0.0)
    leaving = used & (far > 1.0) & (far >= NEAR_FARTHEST * worst)
    returning = ~used & (far <= 1.0)
    return np.asarray((used & ~leaving) | returning)


def _verdict(used: NDArray[np.bool_]) -> str:
    refused = int((~used).sum())
    return f"converged; {refused} of {used.size} observations were left out as outliers"


def _ending(
    x: Floats,
    status: str,
    message: str,
    passes: int,
    state: Filter,
    used: NDArray[np.bool_],
    rows: Rows,
    first: Pass,
) -> Ending:
    distance = deleted_distance(rows.jac, rows.residual, state.root, used.astype(float))
    return Ending(x, status, message, passes, state.root @ state.root.T, used, distance, rows, first)
