"""Explanations for an absurd fit: alternative interpretations of the inputs that are tried and ranked.

If a robot's residuals after identification are larger than the tolerances of a drawing (1 mm, 5 mrad), or its fit does
not converge, the cause is rarely the robot. (If a trial fit, which runs longer, ends within the tolerances, only the
iteration was stopped early.) The usual mistakes in a lab are tried:

- units: joints in degrees labelled as radians or the reverse; a measured column or the rig's points in millimetres
  labelled as metres or the reverse;
- joints: two exchanged, their order reversed or shifted, wrong signs of any of them;
- robot: the other built-in robots with the same number of joints;
- labels: names exchanged, renamed in a cycle, or wrong in some groups of rows (``label_search``);
- stuck joint: the reading of one joint is identical to the last digit in a run of rows while others move;
- set-up: the first or the last rows belong to another one;
- held parameters: too few were free, and those that are free by default explain the rest, even if only by less. Then
  the inputs are correct and the fit is as requested.

Each interpretation is fitted to the same few rows under the same wide prior (``trial_fit``). It explains the
observations if it reduces χ² by HUNDREDFOLD (the RMS tenfold), leaves residuals within the tolerances of a drawing and
the robot within LARGEST_SHIFT tolerances of manual mounting, and if this is beyond chance. If all interpretations were as
wrong as the given one, their mean squares would differ as F(ν, ν) does, so a reduction by r has the probability P(F <
r), times the number of interpretations tried (Bonferroni). That is at most LEVEL for each type of interpretation; at
LEVEL/5 per type, false alarms have the probability LEVEL in total. If the given interpretation is correct, another
would have to be a hundred times better than the truth.

The most probable explanation is listed first. With unknown variances, the logarithm of the evidence is −½ Σ log σ² over
the residuals; rows that an interpretation leaves out count with the variance of the given one.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations, product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.errors import ProblemError
from truearm.estimate.label_search import AS_WELL, FAR, NEAR, Search, relabellings
from truearm.estimate.label_test import log_chance
from truearm.estimate.problem import Rigs
from truearm.estimate.solvers import SOLVERS
from truearm.estimate.trial_fit import Trial, misfit, placed, tried
from truearm.estimate.uncertainty import LEAST_FREEDOM
from truearm.kinds.quantities import LARGEST_NOISE, Quantity
from truearm.kinds.registry import kinds, points
from truearm.model.chain import Chain
from truearm.text import counted
from truearm.types import (
    Estimate,
    Explanation,
    Figures,
    Floats,
    ObservationTable,
    Relabelling,
    Rig,
    Unusable,
    WrongInput,
)
from truearm.units import DEG, MM, UNITS

HUNDREDFOLD = 0.01  # of χ²
FAMILY = 1e-3  # false alarms of all types of wrong input together
LEVEL = FAMILY / len(WrongInput)
MOST_ROWS = 200
FEW_ROWS = 60  # enough to rank arrangements of joints
LEAST_ROWS = 5  # of another set-up
MOST_NAMED = 3
MOST_HELD = 6  # names of parameters
LARGEST_SHIFT = 5.0  # tolerances of manual mounting: the paper's PUMA differs by 1.3
MOST_FITTED = 4  # of the orders and signs of joints, those with the smallest residuals before the robot is fitted
AS_LIKELY = 4.0  # χ² of explanations that are reported with the best

Mask = NDArray[np.bool_]


class Candidate(NamedTuple):
    """Another robot that the observations may belong to: its chain and the parameters to free (p,)."""

    chain: Chain
    free: Mask


class _Reading(NamedTuple):
    """Another interpretation of the inputs, and the message if it explains the observations."""

    text: str
    chain: Chain
    rig: Rigs
    table: ObservationTable
    free: Mask


class _Found(NamedTuple):
    explanation: Explanation
    fit: Trial
    score: float  # twice the negative logarithm of the evidence


def diagnosed(
    estimate: Estimate,
    chain: Chain,
    rig: Rigs,
    table: ObservationTable,
    free: Mask,
    robots: Mapping[str, Candidate] | None = None,
    usual: Mask | None = None,
) -> Estimate:
    """Return the estimate with explanations if it is doubtful, and with the reason if it is not usable.

    ``free`` (p,) are the parameters requested for identification, before any were fixed by default; ``usual`` (p,)
    those that the robot has free by default; ``robots`` are others to try.
    """
    explanations: tuple[Explanation, ...] = ()
    labels = Search((), "not needed")
    finished = _finished(chain, rig, table, estimate.fitted, free) if _unconverged(estimate) else None
    if absurd(estimate) and finished is None:
        explanations, labels = explanations_of(chain, rig, table, estimate.fitted, free, robots or {}, usual)
    elif elsewhere(estimate) or (finished is not None and max(finished.moved, finished.shifted) > FAR):
        explanations, labels = _as_described(chain, rig, table, estimate.fitted, free, robots or {})
    estimate = replace(estimate, relabellings=labels.found, relabelling_search=labels.status, explanations=explanations)
    if any(one.what is not WrongInput.HELD for one in explanations):
        # To first order about a fit that wrong inputs distort, other rows and items would seem to be off.
        estimate = replace(estimate, systematic=None)
    return replace(estimate, unusable=_unusable(estimate))


def explanations_of(
    chain: Chain,
    rig: Rigs,
    table: ObservationTable,
    rows: Mask,
    free: Mask,
    robots: Mapping[str, Candidate],
    usual: Mask | None = None,
) -> tuple[tuple[Explanation, ...], Search]:
    """Return explanations of the ``rows`` (n,) of a table better than the given inputs, the most probable first; and labels."""
    n = int(rows.sum())
    labels = Search((), "not needed")
    given = table.select(np.flatnonzero(rows)[_thin(n)])
    before = tried(chain, rig, given, free)
    if before is None or before.freedom < 1.0:
        return (), labels
    found: list[_Found] = []
    if usual is not None and (usual & ~free).any():
        # A few parameters do not show which interpretation is correct: all are judged with the robot's default free
        # set.
        held, free = usual & ~free, usual | free
        freed = _Reading(_held(chain, held), chain, rig, given, free)
        found += _explaining(WrongInput.HELD, [freed], before, 1.0)
        before = tried(chain, rig, given, free)
        if found or before is None or before.freedom < 1.0:
            return _ranked(found), labels
    sorts: tuple[tuple[WrongInput, Callable[[], Iterator[_Reading]]], ...] = (
        (WrongInput.UNITS, lambda: _units(chain, rig, given, free)),
        (WrongInput.ROBOT, lambda: _robots(chain, rig, given, robots)),
        (WrongInput.JOINTS, lambda: _joints(chain, rig, given, free)),
    )
    for what, readings in sorts:
        if not found:
            found += _explaining(what, list(readings()), before)
    if not found:
        found += _stuck(chain, rig, table, np.flatnonzero(rows), free, before)
    if not found:
        found += _set_up(chain, rig, table, np.flatnonzero(rows), free, before)
        labels = relabellings(chain, rig, table, rows, free, [of.fit for of in found])
        found += _by_labels(labels, table, n)
    return _ranked(found), labels


def _finished(chain: Chain, rig: Rigs, table: ObservationTable, rows: Mask, free: Mask) -> Trial | None:
    """Return the fit of some ``rows`` (n,) if it is as good as with correct inputs: then the iteration ended too early."""
    fit = tried(chain, rig, table.select(np.flatnonzero(rows)[_thin(int(rows.sum()))]), free)
    within = fit is not None and all(rms <= UNITS[unit].weak_sigma for unit, rms in fit.rms.items())
    return fit if within else None


def _as_described(
    chain: Chain, rig: Rigs, table: ObservationTable, rows: Mask, free: Mask, robots: Mapping[str, Candidate]
) -> tuple[tuple[Explanation, ...], Search]:
    """Return labels that place base and tool where they were described, and robots whose links are as described.

    The fit has no other sign of error: another robot of the same arrangement of axes fits as well, with other links.
    """
    given = table.select(np.flatnonzero(rows)[_thin(int(rows.sum()))])
    before = tried(chain, rig, given, free)
    found: list[_Found] = []
    if before is not None and before.shifted > FAR:
        for one in _robots(chain, rig, given, robots):
            after = tried(one.chain, one.rig, one.table, one.free)
            if after is not None and after.shifted < NEAR and after.reduced <= AS_WELL * before.reduced:
                found.append(_found(WrongInput.ROBOT, one.text, len(given), before, after, 1))
    labels = relabellings(chain, rig, table, rows, free)
    return _ranked([*found, *_by_labels(labels, table, int(rows.sum()))]), labels


def absurd(estimate: Estimate) -> bool:
    """Return whether correct inputs hardly give such a fit: not converged, or residuals beyond a drawing's tolerances."""
    return _unconverged(estimate) or _beyond(estimate, "weak_sigma")


def elsewhere(estimate: Estimate) -> bool:
    """Return whether a parameter moved far from its described value: wrong labels may rotate a fixture."""
    p = estimate.n_robot_parameters
    wide = np.array([UNITS[unit].wide_sigma for unit in estimate.units[:p]])
    return bool((np.abs(estimate.value - estimate.nominal)[:p] > FAR * wide).any())


def _unusable(estimate: Estimate) -> Unusable | None:
    if _unconverged(estimate):
        return Unusable.NOT_CONVERGED
    if not estimate.chi2_freedom >= LEAST_FREEDOM:
        return Unusable.NO_FREEDOM
    if any(one.what is WrongInput.HELD for one in estimate.explanations):
        return None
    if estimate.explanations:
        return Unusable.WRONG_INPUTS
    return Unusable.RESIDUALS if _beyond(estimate, "wide_sigma") else None


def _unconverged(estimate: Estimate) -> bool:
    return estimate.status != "converged" and not SOLVERS[estimate.solver].ends_by_recipe


def _beyond(estimate: Estimate, tolerance: str) -> bool:
    """Return whether the rows used have an RMS beyond a tolerance that the declared noise does not explain."""
    if estimate.chi2_reduced <= estimate.chi2_band[1]:
        return False
    figures = Figures.by_unit(estimate.residual, estimate.used)
    return any(of.rms > getattr(UNITS[unit], tolerance) for unit, of in figures.items())


def _thin(n: int, most: int = MOST_ROWS) -> NDArray[np.intp]:
    """Return an evenly spaced selection of n rows."""
    return np.unique(np.linspace(0, n - 1, min(n, most)).astype(np.intp))


def _explaining(
    what: WrongInput, readings: Sequence[_Reading], before: Trial, ratio: float = HUNDREDFOLD
) -> Iterator[_Found]:
    """Return the interpretations that explain the observations and reduce χ² below ``ratio`` of its value."""
    for one in readings:
        after = tried(one.chain, one.rig, one.table, one.free)
        if after is not None and _explains(before, after, len(readings), ratio):
            yield _found(what, one.text, len(one.table), before, after, len(readings))


def _explains(before: Trial, after: Trial, count: int, least: float = HUNDREDFOLD) -> bool:
    """Return whether a fit is far better, beyond chance, no longer absurd, and close to the described robot.

    An interpretation that shrinks everything explains nothing, and neither does one that requires the robot to shrink.
    """
    ratio = after.reduced / before.reduced
    fits = all(rms <= UNITS[unit].weak_sigma for unit, rms in after.rms.items())
    return (
        fits
        and after.shifted < LARGEST_SHIFT
        and ratio < least
        and log_chance(ratio, after.freedom) + math.log(count) < math.log(LEVEL)
    )


def _found(
    what: WrongInput, text: str, n: int, before: Trial, after: Trial, count: int, apply: str = "", of: int = 0
) -> _Found:
    """Return an explanation of ``n`` of ``of`` rows, by default all; ``count`` interpretations were tried."""
    ratio = after.reduced / before.reduced
    chance = math.exp(min(log_chance(ratio, after.freedom) + math.log(count), 0.0))
    score = (n / of if of else 1.0) * math.log(max(ratio, 1e-300))
    return _Found(Explanation(what, text, apply, n, before.rms, after.rms, chance), after, score)


def _ranked(found: Sequence[_Found]) -> tuple[Explanation, ...]:
    """Return the best explanation, and those that explain as much nearly as well."""
    if not found:
        return ()
    best = min(found, key=lambda of: of.score)
    beside = [of for of in found if of.fit.reduced <= AS_LIKELY * best.fit.reduced]
    if best.explanation.what is not WrongInput.SET_UP:
        beside = [of for of in beside if of.explanation.what is not WrongInput.SET_UP]
    ranked = sorted({id(of): of for of in (best, *beside)}.values(), key=lambda of: of.score)
    return tuple(of.explanation for of in ranked[:MOST_NAMED])


def _held(chain: Chain, held: Mask) -> str:
    """Return a mask (p,) of the fixed parameters."""
    names = [name for name, one in zip(chain.parameter_names, held, strict=True) if one]
    more = f" and {len(names) - MOST_HELD} more" if len(names) > MOST_HELD else ""
    are = "is" if len(names) == 1 else "are"
    return f"{counted(len(names), 'parameter')} that the robot has free by default {are} held: {', '.join(names[:MOST_HELD])}{more}"


def _units(chain: Chain, rig: Rigs, table: ObservationTable, free: Mask) -> Iterator[_Reading]:
    """Return columns and points in the other unit."""
    used = [kinds()[str(kind)] for kind in np.unique(table.kind)]
    # If nothing is measured except that the end returns, less motion gives smaller residuals, whatever the unit.
    if all(any(isinstance(column, Quantity) for column in kind.needs) for kind in used):
        for unit, scale, names in (
            ("rad", DEG.scale, ("degrees", "radians")),
            ("m", MM.scale, ("millimetres", "metres")),
        ):
            which = np.array([of == unit for of in chain.joint_units])
            if which.any():
                for factor, (are, called) in ((scale, names), (1.0 / scale, names[::-1])):
                    q = np.where(which, factor * table.q, table.q)
                    rate = np.where(which, factor * table.q_rate, table.q_rate)
                    text = f"the joint readings are in {are}, not in {called}"
                    yield _Reading(text, chain, rig, replace(table, q=q, q_rate=rate), free)
    for quantity in dict.fromkeys(quantity for kind in used for quantity in kind.quantities):
        if quantity.most <= LARGEST_NOISE or quantity.unit not in ("m", "rad"):
            continue
        scale = MM.scale if quantity.unit == "m" else DEG.scale
        names = ("millimetres", "metres") if quantity.unit == "m" else ("degrees", "radians")
        for factor, (are, called) in ((scale, names), (1.0 / scale, names[::-1])):
            text = f"the readings of {quantity.words} are in {are}, not in {called}"
            yield _Reading(text, chain, rig, _with_column(table, quantity.field, factor), free)
    for column, entry in points().items():
        for factor, (are, called) in (
            (MM.scale, ("millimetres", "metres")),
            (1.0 / MM.scale, ("metres", "millimetres")),
        ):
            scaled = _with_points(rig, entry, factor)
            if scaled is not None:
                text = f"the rig's coordinates of each {column} are in {are}, not in {called}"
                yield _Reading(text, chain, scaled, table, free)


def _with_column(table: ObservationTable, field: str, factor: float) -> ObservationTable:
    column = factor * table.column(field, np.nan)
    if field in table.fields():
        own: dict[str, Any] = {field: column}
        return replace(table, **own)
    return replace(table, more={**table.more, field: column})


def _with_points(rig: Rigs, entry: str, factor: float) -> Rigs | None:
    """Return the rig, or rigs, with some points' coordinates multiplied; None if there are none, or they are too far."""
    if not isinstance(rig, Rig):
        scaled = {name: _with_points(one, entry, factor) for name, one in rig.items()}
        every = {name: one for name, one in scaled.items() if isinstance(one, Rig)}
        return {**rig, **every} if every else None
    known = rig.named(entry)
    farthest = max((abs(v) for point in known.values() for v in point.xyz), default=0.0)
    if not 0.0 < factor * farthest <= UNITS["m"].largest:
        return None
    moved: dict[str, Any] = {
        entry: {name: replace(p, xyz=tuple(factor * v for v in p.xyz)) for name, p in known.items()}
    }
    return replace(rig, **moved)


def _robots(chain: Chain, rig: Rigs, table: ObservationTable, robots: Mapping[str, Candidate]) -> Iterator[_Reading]:
    for name, other in robots.items():
        if name != chain.name and other.chain.joint_units == chain.joint_units:
            text = f"the observations are of robot {name}, not of {chain.name}"
            yield _Reading(text, other.chain, rig, table, other.free)


def _joints(chain: Chain, rig: Rigs, table: ObservationTable, free: Mask) -> Iterator[_Reading]:
    """Return the orders and signs of joints with the smallest residuals before the robot is fitted."""
    names = [joint.name for joint in chain.joints]
    few = table.select(_thin(len(table), FEW_ROWS))
    scored = []
    for order, signs in _arrangements(len(names)):
        if any(chain.joint_units[i] != unit for i, unit in zip(order, chain.joint_units, strict=True)):
            continue
        try:
            with np.errstate(all="ignore"):
                least = placed(chain, rig, _with_joints(few, order, signs)).reduced
        except (ProblemError, np.linalg.LinAlgError):
            continue
        if np.isfinite(least):
            scored.append((least, _arranged(names, order, signs), order, signs))
    scored.sort(key=lambda one: one[0])
    for _, text, order, signs in scored[:MOST_FITTED]:
        yield _Reading(text, chain, rig, _with_joints(table, order, signs), free)


def _with_joints(table: ObservationTable, order: Sequence[int], signs: Floats) -> ObservationTable:
    return replace(table, q=table.q[:, order] * signs, q_rate=table.q_rate[:, order] * signs)


def _arrangements(n: int) -> Iterator[tuple[list[int], Floats]]:
    """Return orders and signs of n joints: exchanges of two, cycles, the reverse; all signs."""
    same, plus = list(range(n)), np.ones(n)
    for a, b in combinations(same, 2):
        order = list(same)
        order[a], order[b] = b, a
        yield order, plus
    for shift in range(1, n):
        yield same[shift:] + same[:shift], plus
    yield same[::-1], plus
    for signs in product((1.0, -1.0), repeat=n):
        if min(signs) < 0.0:
            yield same, np.array(signs)


def _arranged(names: Sequence[str], order: Sequence[int], signs: Floats) -> str:
    turned = [name for name, sign in zip(names, signs, strict=True) if sign < 0.0]
    if turned:
        return f"the {'sign' if len(turned) == 1 else 'signs'} of {', '.join(turned)} {'is' if len(turned) == 1 else 'are'} reversed"
    moved = [(names[i], names[k]) for k, i in enumerate(order) if i != k]
    if len(moved) == 2:
        return f"the columns of {moved[0][0]} and {moved[0][1]} are exchanged"
    return f"the joints' columns are in another order: {', '.join(names[order.index(i)] for i in range(len(names)))}"


def _stuck(
    chain: Chain, rig: Rigs, table: ObservationTable, rows: NDArray[np.intp], free: Mask, before: Trial
) -> Iterator[_Found]:
    """Return joints with a constant reading in a run of rows while others change, if all other rows fit."""
    n, runs = rows.size, _same_readings(table.q[rows])
    for joint, first, end in runs:
        others = rows[np.r_[:first, end:n]]
        after = tried(chain, rig, table.select(others[_thin(others.size)]), free) if others.size else None
        if after is None or not _explains(before, after, len(runs)):
            continue
        where = f"{_row(table, rows[first])} to {_row(table, rows[end - 1])}"
        text = f"the reading of {chain.joints[joint].name} is stuck: it is the same in {counted(end - first, 'row')} from {where}, while others move"
        apply = f"{rows[first] + 1}:{rows[end - 1] + 1}"
        yield _found(WrongInput.STUCK, text, others.size, before, after, len(runs), apply, n)


def _same_readings(q: Floats) -> list[tuple[int, int, int]]:
    """Return the longest run (first row, one after the last) of each joint in readings (n, j) in which it alone is constant."""
    found = []
    for joint in range(q.shape[1]):
        edges = np.r_[0, np.flatnonzero(np.diff(q[:, joint])) + 1, len(q)]
        longest = int(np.argmax(np.diff(edges)))
        first, end = int(edges[longest]), int(edges[longest + 1])
        moving = np.delete(np.ptp(q[first:end], axis=0), joint)
        if LEAST_ROWS <= end - first < len(q) and moving.any():
            found.append((joint, first, end))
    return found


def _set_up(
    chain: Chain, rig: Rigs, table: ObservationTable, rows: NDArray[np.intp], free: Mask, before: Trial
) -> Iterator[_Found]:
    """Return first or last rows that do not fit the others, which fit."""
    n = rows.size
    if n < 4 * LEAST_ROWS:
        return
    for main in (np.arange(n // 2, n), np.arange(n // 2)):
        after, cut = None, 0
        for _ in range(2):  # from half of the rows, then from all on that side of the change
            some = rows[main[_thin(main.size)]]
            after = tried(chain, rig, table.select(some), free)
            if after is None:
                break
            of_row = misfit(chain, rig, table.select(rows), after.known)
            cut = _change(of_row)
            main = np.arange(cut, n) if main[-1] == n - 1 else np.arange(cut)
            if min(main.size, n - main.size) < LEAST_ROWS:
                after = None
                break
        count = 2 * (n - 2 * LEAST_ROWS)
        if after is None or main.size < n // 2 or not _explains(before, after, count):
            continue
        first, last = (1, cut) if main[0] else (cut + 1, n)
        where = f"{_row(table, rows[first - 1])} to {_row(table, rows[last - 1])}"
        text = f"{counted(last - first + 1, 'row')} from {where} were measured with another set-up than the other {main.size}"
        apply = f"{rows[first - 1] + 1}:{rows[last - 1] + 1}"
        yield _found(WrongInput.SET_UP, text, int(main.size), before, after, count, apply, n)
        return


def _change(square: Floats) -> int:
    """Return the row from which on the variance differs (maximum likelihood)."""
    n = square.size
    k = np.arange(LEAST_ROWS, n - LEAST_ROWS + 1)
    total = np.concatenate([[0.0], np.cumsum(square)])
    left, right = total[k] / k, (total[-1] - total[k]) / (n - k)
    tiny = 1e-12 * max(float(square.max()), 1e-300)
    cost = k * np.log(np.maximum(left, tiny)) + (n - k) * np.log(np.maximum(right, tiny))
    return int(k[np.argmin(cost)])


def _by_labels(labels: Search, table: ObservationTable, n: int) -> Iterator[_Found]:
    before, after = labels.before, labels.after
    if before is not None and after is not None:
        text = "; ".join(label_sentences(labels.found, table))
        if before.moved > FAR and after.moved < NEAR and after.reduced > HUNDREDFOLD * before.reduced:
            text += "; or base or tool is mounted rotated, which the robot file should then describe"
        chance = math.exp(labels.log_chance)
        explanation = Explanation(
            WrongInput.LABELS, text, _few_in_one_run(labels.found, n), n, before.rms, after.rms, chance
        )
        yield _Found(explanation, after, math.log(after.reduced / before.reduced))


def _few_in_one_run(found: Sequence[Relabelling], n: int) -> str:
    """Return the rows with a wrong label as rows to leave out, if they follow each other and are few of ``n``; otherwise ""."""
    rows = sorted(row for one in found for row in one.rows)
    together = rows[-1] - rows[0] == len(rows) - 1
    return f"{rows[0] + 1}:{rows[-1] + 1}" if together and len(rows) <= n // 2 else ""


def label_sentences(found: Sequence[Relabelling], table: ObservationTable) -> list[str]:
    """Return sentences about wrong labels: names exchanged throughout, otherwise the rows of each wrong label."""
    exchanged = _exchanged(found, table)
    if exchanged:
        return exchanged
    rows: dict[str, list[int]] = {}
    for one in found:
        pairs = [of for of in zip(one.columns, one.was, one.fits, strict=True) if of[1] != of[2]]
        change = "name {}, fit {}".format(*(" and ".join(f"{of[0]} {of[k]}" for of in pairs) for k in (1, 2)))
        rows.setdefault(change, []).extend(one.rows)
    sentences = []
    for change, mine in rows.items():
        first, last = (_row(table, mine[i]) for i in (0, -1))
        which = first if len(mine) == 1 else f"{len(mine)} rows from {first} to {last}"
        sentences.append(f"{which} {change}")
    return sentences


def _row(table: ObservationTable, row: int) -> str:
    """Return where a row comes from, without the folder, which would reveal somebody's paths."""
    return re.split(r"[\\/]", str(table.source[row]))[-1]


def _exchanged(found: Sequence[Relabelling], table: ObservationTable) -> list[str]:
    """Return the names of one column that are exchanged in all rows that have them; empty if there are none."""
    sentences = []
    for column in dict.fromkeys(column for one in found for column in one.columns):
        renamed: dict[str, set[str]] = {}
        count: dict[str, int] = {}
        for one in found:
            for of, was, fits in zip(one.columns, one.was, one.fits, strict=True):
                if of == column and was != fits:
                    renamed.setdefault(was, set()).add(fits)
                    count[was] = count.get(was, 0) + len(one.rows)
                elif of == column:
                    renamed.setdefault(was, set())
        changed = {was: next(iter(fits)) for was, fits in renamed.items() if len(fits) == 1}
        if any(len(fits) > 1 for fits in renamed.values()):
            return []
        if not changed:
            continue
        have = table.column(column)
        if set(changed) != set(changed.values()) or any(count[was] != int((have == was).sum()) for was in changed):
            return []
        if len(changed) == 2:
            a, b = changed
            sentences.append(f"the names of {column} {a} and {b} are exchanged in all rows")
        else:
            pairs = ", ".join(f"{was} is {fits}" for was, fits in changed.items())
            sentences.append(f"the names of the {column}s are permuted in all rows: {pairs}")
    return sentences
