"""The search of ``systematic``: every item in every form in which it can be off, and the most probable of them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np
import scipy.linalg

from truearm.estimate.problem import Problem
from truearm.estimate.systematic_effects import Cause
from truearm.estimate.systematic_score import (
    SEEN,
    Best,
    Family,
    Measured,
    ScoreTest,
    WhitenedResiduals,
    identity_minus,
    item_columns,
    label,
    log_chance,
    span_in_table,
    unfollowed,
)
from truearm.estimate.ties import first_within, largest_first
from truearm.results import DriftWith
from truearm.types import Floats, Indices
from truearm.units import UNITS

MOST_FINDINGS = 6
MOST_STEPS = 400  # rows at which a step is searched for; of more, an evenly spaced selection
WINDOW_KNOTS = 36  # of the rows at which a joint may begin or cease to be off; the best two are then refined
WANDER_KNOTS = 12
WANDER_SIGMA = tuple(2.0**-k for k in range(7))  # of a step of a random walk, in priors of the item's unit
LEAST_WARMING = 1.0  # °C: two steps of a microcontroller's internal sensor; less is not a temperature change
LEAST_SHARE = 0.05  # of χ² that noise does not explain, for an error that follows the last move
MOST_OFF = 20.0  # σ of manual mounting (units: 0.2 m, 1 rad, a gain of 20 %): nothing that was ever used is off by more
LEAST_ROWS = 5  # in which a step applies, and in which it does not: fewer are treated as outliers, one by one
MOST_BLOCK = 300  # rows: each of their residuals is a column
LIKELY = 0.95  # that an error begins and ends within the rows named
AS_LIKELY = math.log(100.0)  # explanations whose evidence differs by less are all reported
BLOCK_SIGMA = 10.0  # σ of the noise: how far a row that does not fit is off


def in_all_rows(problem: Problem) -> list[Cause]:
    """Return the items that can be off in all rows.

    An unknown number of the rig, or one that is allowed to be off, is a parameter. Only knowledge of it could be off, such
    as the distance of two sockets, and that is none of this item.
    """
    wide = np.array([UNITS[unit].wide_sigma for unit in problem.units])
    fitted = {name for name, sigma, of in zip(problem.names, problem.prior_sigma, wide, strict=True) if sigma >= of}
    return [cause for cause in problem.causes if cause.fault.constant and not fitted.issuperset(cause.numbers)]


def largest_errors(units: Sequence[str]) -> Floats:
    """Return by how much numbers of an item in some SI units can be off."""
    return np.array([MOST_OFF * UNITS[unit].wide_sigma for unit in units])


def families(problem: Problem, rows: WhitenedResiduals, how: Measured) -> Iterator[Family]:
    """Return every item in every form in which it can be off, without its sums."""
    n = how.row.size
    constant = in_all_rows(problem)
    for cause in problem.causes:
        off = rows.errors[:, problem.errors.indices(cause.numbers)].any(axis=1)
        used = np.flatnonzero(np.bincount(rows.row[off]))
        if used.size < 2 * LEAST_ROWS:
            continue
        if cause in constant:
            yield Family(cause, np.array([0]), np.array([n]))
        if cause.fault.step:
            first = _even(used[LEAST_ROWS : 1 - LEAST_ROWS], MOST_STEPS)
            yield Family(cause, first, np.full(first.size, n))
        if cause.fault.window:
            knots = np.append(_even(used[: 1 - LEAST_ROWS], WINDOW_KNOTS), n)
            first, last = (knots[of] for of in np.triu_indices(knots.size, 1))
            enough = (np.searchsorted(used, last) - np.searchsorted(used, first) >= LEAST_ROWS) & (last - first < n)
            yield Family(cause, first[enough], last[enough])
        if cause.fault.run:
            starts = run_starts(how)
            first, last = starts[:-2], starts[1:-1]  # an error in the last run is a step
            enough = np.searchsorted(used, last) - np.searchsorted(used, first) >= LEAST_ROWS
            if enough.any():
                yield Family(cause, first[enough], last[enough], runs=True)
        if cause.fault.drift:
            for number in np.unique(how.session[used]):
                mine = np.flatnonzero(how.session == number)
                for drift in (DriftWith.TIME, DriftWith.TEMPERATURE):
                    family = Family(cause, mine[:1], mine[-1:] + 1, drift)
                    along = how.table.during(cause.name, drift, *span_in_table(mine[0], mine[-1] + 1, how))
                    if along is not None and (drift is DriftWith.TIME or np.ptp(along) >= LEAST_WARMING):
                        yield family
        if cause.fault.moved:
            for drift in (DriftWith.DIRECTION, DriftWith.MOVE):
                if how.table.during(cause.name, drift, 0, how.total) is not None:
                    yield Family(cause, np.array([0]), np.array([n]), drift)


def run_starts(how: Measured) -> Indices:
    """Return the first row of each run, and the number of rows."""
    return np.concatenate([[0], np.flatnonzero(np.diff(how.run)) + 1, [how.run.size]])


def blocks_of_rows(how: Measured) -> Iterator[Family]:
    """Return first and last parts of the runs, and complete runs, of at most half the rows."""
    n = how.row.size
    starts = run_starts(how)
    spans = set[tuple[int, int]]()
    for a, b in pairwise(starts.tolist()):
        if b - a < LEAST_ROWS:
            continue
        for cut in _even(np.arange(a, b + 1), max(MOST_STEPS // (starts.size - 1), 8)).tolist():
            spans |= {(a, cut), (cut, b)}
    kept = sorted((a, b) for a, b in spans if LEAST_ROWS <= b - a <= min(n // 2, MOST_BLOCK))
    if kept:
        first, last = np.array(kept).T
        yield Family(None, first, last)


def _even(values: Indices, most: int) -> Indices:
    """Return at most this many of the values, evenly spaced, including the first and the last."""
    return values if values.size <= most else values[np.linspace(0, values.size - 1, most).astype(np.intp)]


def searched(found: Sequence[Best], every: Sequence[Family], test: ScoreTest) -> tuple[list[Best], ScoreTest]:
    """Return the findings followed by all others beyond chance, one after the other, each given those before it.

    Also returns the test with all of them as parameters.
    """
    out = list(found)
    now = test.given(out)
    while len(out) < MOST_FINDINGS:
        candidates = [_search(family, now) for family in every]
        beyond_chance = [of for of in candidates if of is not None and not test.by_chance(of.log_p)]
        if not beyond_chance:
            break
        best, *near = [beyond_chance[i] for i in largest_first([of.evidence for of in beyond_chance])]
        rivals = tuple(
            label(_in_fewer_rows(of, now), test.how) for of in near if of.evidence > best.evidence - AS_LIKELY
        )
        best = _refined(best._replace(rivals=(*_wanders(best, every, now), *rivals)), now)
        best = _in_fewer_rows(best, now)
        out.append(best)
        now = now.given([best])
    return out, now


def _search(family: Family, test: ScoreTest) -> Best | None:
    """Return the family's best candidate, or None if the parameters can follow all of them."""
    state = test.state
    drop, freedom, known = _block_drops(family, test.rows) if family.cause is None else _drops(family, test)
    if not freedom.any():
        return None
    follows_move = family.drift is not None and not family.drift.has_offset
    if follows_move and not state.explained and drop.max() < LEAST_SHARE * state.chi2:
        return None
    half_drop, variance = drop / 2.0, np.ones(1)
    if not state.explained:
        left = np.maximum(state.chi2 - drop, 1e-9 * state.chi2)
        half_drop, variance = np.log(state.chi2 / left) * state.freedom / 2.0, left / max(state.freedom, 1.0)
    log_count = math.log((freedom > 0).sum())
    evidence = half_drop - np.log1p(known / variance[:, None]).sum(axis=1) / 2.0 - log_count
    evidence = np.where(freedom > 0, evidence, -np.inf)
    at = first_within(evidence)
    log_p = float(log_chance(drop[[at]] / test.inflation, freedom[[at]], state)[0]) + log_count
    first, last = int(family.first[at]), int(family.last[at])
    return Best(
        family,
        first,
        last,
        float(drop[at]),
        int(freedom[at]),
        log_count,
        log_p,
        float(evidence[at]),
        _within(family, evidence),
    )


def _refined(best: Best, test: ScoreTest) -> Best:
    """Return an error of a joint with the rows at which it begins and ends, found between the neighbouring knots."""
    family, n = best.family, test.how.row.size
    if family.cause is None or not family.cause.fault.window or family.drift:
        return best
    knots = np.unique(np.concatenate([family.first, family.last]))
    for side in ("first", "last", "first"):
        value = getattr(best, side)
        near = np.searchsorted(knots, value) + np.array([-1, 1])
        if near[0] < 0 or near[1] >= knots.size:  # the first row, or the last
            continue
        values = np.arange(knots[near[0]] + 1, knots[near[1]])
        other = np.full(values.size, best.last if side == "first" else best.first)
        first, last = (values, other) if side == "first" else (other, values)
        enough = (last - first >= LEAST_ROWS) & ((n - last >= LEAST_ROWS) | (last == n))
        fine = Family(family.cause, first[enough], last[enough])
        found = _search(fine.summed(test.errors, test.rows, test.how), test) if enough.any() else None
        if found is None or first_within((found.drop, best.drop)):  # the best row of before is among the values
            continue
        log_p = found.log_p + best.log_count
        within = (found.within[0], best.within[1]) if side == "first" else (best.within[0], found.within[1])
        best = best._replace(first=found.first, last=found.last, drop=found.drop, log_p=min(log_p, 0.0), within=within)
    return best


def _within(family: Family, evidence: Floats) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the ranges of ``first`` and ``last`` of the family's most probable candidates (w,), up to the next ones."""
    order = np.argsort(-evidence, kind="stable")
    share = np.cumsum(np.exp(evidence[order] - evidence[order[0]]))
    likely = order[: int(np.searchsorted(share, LIKELY * share[-1])) + 1]

    def span(values: Indices) -> tuple[int, int]:
        if family.runs:
            return int(values[likely].min()), int(values[likely].max())
        every = np.unique(values)
        low, high = np.searchsorted(every, [values[likely].min(), values[likely].max()])
        before, after = every[max(low - 1, 0)], every[min(high + 1, every.size - 1)]
        return int(before + 1 if low else before), int(after - 1 if high + 1 < every.size else after)

    return span(family.first), span(family.last)


def _drops(family: Family, test: ScoreTest) -> tuple[Floats, Indices, Floats]:
    """Return the drop of χ² (w,), degrees of freedom (w,) and eigenvalues of V (w, d) for the family's spans.

    An item that would have to be off by more than MOST_OFF explains nothing.
    """
    rows, (w, d, _) = test.rows, family.left.shape
    numbers = () if family.cause is None else family.cause.numbers
    units = [test.errors.unit(number) for number in numbers]
    most = largest_errors(units) / [UNITS[unit].weak_sigma for unit in units]
    drop, freedom, known = np.zeros(w), np.zeros(w, dtype=np.intp), np.zeros((w, d))
    beside = np.concatenate([rows.added, rows.residual[:, None]], axis=1)
    for some, sums in family.sums(family.columns(test.errors, rows, test.how), (beside,), rows):
        by_added, score = sums[:, :, :-1], sums[:, :, -1]
        values, vectors = np.linalg.eigh(family.left[some] - by_added @ by_added.swapaxes(1, 2))
        seen = values > SEEN * family.size[some, None]
        along = np.einsum("wij,wi->wj", vectors, score)
        size = np.where(seen, along / np.where(seen, values, 1.0), 0.0)
        off = np.abs(np.einsum("wij,wj->wi", vectors, size)).reshape(len(size), -1, most.size)
        drop[some] = np.where((off <= most).all(axis=(1, 2)), (size * along).sum(axis=1), 0.0)
        freedom[some], known[some] = seen.sum(axis=1), np.where(seen, values, 0.0)
    return drop, freedom, known


def _block_drops(family: Family, rows: WhitenedResiduals) -> tuple[Floats, Indices, Floats]:
    """Return the same as ``_drops``, for leaving out each of the spans: eᵀ(I − Q Qᵀ)⁻¹e of its residuals.

    This is the form in the module docstring by Woodbury's identity. Spans with a common start or end are parts of the
    longest: with its I − Q Qᵀ = L Lᵀ they are sums of the squares of L⁻¹e.
    """
    cuts = np.searchsorted(rows.row, np.stack([family.first, family.last]))
    drop = np.zeros(family.first.size)
    begins, ends = (np.unique(side, return_inverse=True, return_counts=True) for side in cuts)
    forwards = begins[2][begins[1]] >= ends[2][ends[1]]
    for side, some in ((0, forwards), (1, ~forwards)):
        for at in np.unique(cuts[side, some]):
            mine = np.flatnonzero(some & (cuts[side] == at))
            which = slice(int(cuts[0, mine].min()), int(cuts[1, mine].max()))
            q, e = (part[:: -1 if side else 1] for part in (rows.of(which), rows.residual[which]))
            if not e.size:
                continue
            along = scipy.linalg.solve_triangular(np.linalg.cholesky(identity_minus(q, SEEN)), e, lower=True)
            squares = np.append(0.0, np.cumsum(along**2))
            drop[mine] = squares[cuts[1, mine] - cuts[0, mine]]
    freedom = cuts[1] - cuts[0]
    known = np.where(np.arange(freedom.max()) < freedom[:, None], BLOCK_SIGMA**2, 0.0)
    return drop, freedom, known


def _wanders(best: Best, every: Sequence[Family], test: ScoreTest) -> tuple[str, ...]:
    """Return the items whose gradual change is as probable as an error that begins or ends at a row.

    Of other items, nearly as probable is enough: which one to correct is then open.
    """
    if best.family.cause is None or best.family.drift or (best.first, best.last) == (0, test.how.row.size):
        return ()
    causes = {of.cause.name: of.cause for of in every if of.cause and (of.drift or of.cause is best.family.cause)}
    wander = {name: _wander_evidence(cause, test) for name, cause in causes.items()}
    least = {name: best.evidence - AS_LIKELY * (name != best.family.cause.name) for name in wander}
    return tuple(f"a gradual change of {name}" for name, of in wander.items() if of > least[name])


def _wander_evidence(cause: Cause, test: ScoreTest) -> float:
    """Return the logarithm of the evidence of a random walk of an item, in WANDER_KNOTS steps of the most probable size."""
    rows, state = test.rows, test.state
    by = item_columns(cause, test.errors, rows)
    edges = np.linspace(0, test.how.row.size, WANDER_KNOTS + 1)[:-1].round().astype(np.intp)
    cuts = [*np.searchsorted(rows.row, edges), int(np.searchsorted(rows.row, test.how.row.size))]
    d, r = by.shape[1], rows.basis.shape[1] + rows.added.shape[1]
    sums = np.zeros((WANDER_KNOTS, d, d + r + 1))  # over the rows from each step on
    for i, (a, b) in enumerate(pairwise(cuts)):
        across = by[a:b].T
        sums[: i + 1] += np.concatenate(
            [across @ by[a:b], across @ rows.of(slice(a, b)), (across @ rows.residual[a:b])[:, None]], axis=1
        )
    later = np.maximum.outer(np.arange(WANDER_KNOTS), np.arange(WANDER_KNOTS))
    square = sums[later, :, :d].transpose(0, 2, 1, 3).reshape(WANDER_KNOTS * d, -1)
    by_basis = sums[:, :, d:-1].reshape(WANDER_KNOTS * d, r)
    values, vectors = np.linalg.eigh(square - by_basis @ by_basis.T)
    values, along = np.maximum(values, 0.0), vectors.T @ sums[:, :, -1].ravel()
    variance = 1.0 if state.explained else state.chi2 / state.freedom
    felt = np.square(WANDER_SIGMA)[:, None] / variance
    gain = (felt * along**2 / (1.0 + felt * values)).sum(axis=1)
    half = gain / 2.0
    if not state.explained:
        half = np.log(state.chi2 / np.maximum(state.chi2 - gain, 1e-9 * state.chi2)) * state.freedom / 2.0
    evidence = half - np.log1p(felt * values).sum(axis=1) / 2.0 - math.log(len(WANDER_SIGMA))
    return float(evidence.max())


def _in_fewer_rows(best: Best, test: ScoreTest) -> Best:
    """Return a step that is off before its row instead of from it on, if these are fewer rows and the data are the same.

    They are the same if the parameters follow the item's error in all rows: where the base or a tracker stood is
    unknown, only that it moved is known. The robot is then described as in most rows.
    """
    cause, n = best.family.cause, test.how.row.size
    if cause is None or best.family.drift or not 0 < best.first < n - best.first or best.last < n:
        return best
    by = item_columns(cause, test.errors, test.rows)
    followed = not unfollowed(by.T @ by, test.rows.along(by))[2].any()
    return best._replace(first=0, last=best.first, within=((0, 0), best.within[0])) if followed else best
