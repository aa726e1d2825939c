"""Which joint laws are kept: those that the evidence supports, and that regions left out do not contradict.

None is kept if all together do not raise the evidence by GATE: fewer raise it less. Otherwise, from the one with the
least nats to one with EARNEST, each law is left out, and the noise learned again. It is kept if the evidence is then
lower by GATE. All sags stand or fall together, for gravity acts on all joints or on none.

Evidence is of the rows that were measured. A law that describes the arm also helps where it was not fitted, so regions
of poses are left out in turn, at fixed variances and noise. The fit to all other regions
(docs/explanation/estimation.md) needs the information of each region for any selection of laws. A law is dropped if
without it the errors fall by more nats, ½ Σ |y_r − G_r u|², than the evidence for it.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from truearm.estimate.law_fit import LawProblem, Learned, learn
from truearm.estimate.pose_noise import PoseNoise, pose_information
from truearm.estimate.problem import without_knowledge
from truearm.estimate.whitened_rows import only
from truearm.kinds.table import ObservationTable
from truearm.types import CurveKnots, Floats, Indices, Law

GATE = 6.0  # nats
HOPE = 3.0  # nats: with less after two rounds, all laws together do not reach GATE
EARNEST = 25.0  # nats
ABSENT = 0.05  # nats: without such a law, variances and noise are those that were learned with it
HALVINGS = 3  # of the joint space: 8 regions
LEAST_OF_REGION = 4  # poses
PRIVATE = 1e-9  # of its information, all that other regions have of an unknown
FAINT = 1e-6  # of a residual: an unknown with a prior that all rows see less is left out

Unit = tuple[Law, ...]  # stands or falls as a whole


class LawChoice(NamedTuple):
    """The laws that are kept, what was learned with them, and the nats at which each other one was dropped.

    ``sure``: units without which the evidence was lower, with the noise learned again.
    """

    kept: tuple[Law, ...]
    learned: Learned
    dropped: Mapping[Law, float]
    sure: frozenset[Unit]


def supported(
    make: Callable[[Sequence[Law]], LawProblem], laws: Sequence[Law], region: Indices, start: PoseNoise | LawChoice
) -> LawChoice:
    """Return the laws that the rows support.

    ``make`` builds the problem with some laws, ``region`` (n_rows,) are the numbers of the rows' regions, and ``start``
    is the noise where learning starts, or the choice of nearly the same rows, of which no further law is tried.
    """
    dropped: dict[Law, float] = {}
    sure: frozenset[Unit] = frozenset()
    if isinstance(start, LawChoice):
        problem, dropped, sure = make(start.kept), dict(start.dropped), start.sure
        learned = learn(problem, start.learned._replace(x=problem.start))  # beside other faults, x is longer
    else:
        problem, without = make(laws), learn(make(()), start)
        learned = learn(problem, start, least=without.evidence + HOPE)
        if learned.evidence - without.evidence < GATE:
            return LawChoice((), without, learned.nats, sure)
    while problem.laws:
        units = _units(problem.laws)
        gain = {unit: sum(learned.nats[law] for law in unit) for unit in units if unit not in sure}
        weakest: Unit = min(gain, key=gain.__getitem__, default=())
        is_doubtful = bool(weakest) and gain[weakest] < EARNEST
        unit = weakest if is_doubtful else _harmful(problem, learned, region, units)
        if not unit:
            break
        fewer, without = make(_but(problem.laws, unit)), _without(problem, learned, unit)
        if any(learned.nats[law] >= ABSENT for law in unit):
            without = learn(fewer, without)
        if is_doubtful and learned.evidence - without.evidence >= GATE:
            sure |= {unit}
            continue
        dropped |= {law: learned.nats[law] for law in unit}
        problem, learned = fewer, without
    return LawChoice(problem.laws, learned, dropped, sure)


def without_absent(problem: LawProblem, learned: Learned, choice: LawChoice) -> LawChoice:
    """Return the choice without laws of which nothing was learned: a joint may have no sag beside others."""
    absent = {law: learned.nats[law] for law in problem.laws if learned.nats[law] < ABSENT}
    kept, dropped = tuple(_but(problem.laws, absent)), {**choice.dropped, **absent}
    return LawChoice(kept, _without(problem, learned, absent), dropped, choice.sure)


def regions(table: ObservationTable, pose: Indices) -> Indices:
    """Return numbers (n,) of the rows' regions: their places, or else parts of the joint space with equally many poses.

    A part is halved at the median of the joint that varies most in it. ``pose`` (n,) are the numbers of the poses.
    """
    if (table.place != "").all() and np.unique(table.place).size > 1:
        return np.unique(table.place, return_inverse=True)[1].ravel()
    _, first, number = np.unique(pose, return_index=True, return_inverse=True)
    q, region = table.q[first], np.zeros(first.size, dtype=np.intp)
    for _ in range(HALVINGS):
        for cell in np.unique(region):
            members = np.flatnonzero(region == cell)
            if members.size >= 2 * LEAST_OF_REGION:
                joint = int(np.argmax(np.std(q[members], axis=0)))
                order = members[np.argsort(q[members, joint], kind="stable")]
                region[order[order.size // 2 :]] = region.max() + 1
    return region[number.ravel()]


def left_out_square(grams: Sequence[Floats], is_always: NDArray[np.bool_]) -> float:
    """Return Σ |y_r − G_r u|² over the regions, each with the u (s,) of all others, from their [G_r|y_r]ᵀ[G_r|y_r].

    ``is_always`` (s,): unknowns that are no law's.
    """
    total = np.sum(grams, axis=0)
    square = 0.0
    for gram in grams:
        others = total - gram
        inner = others[:-1, :-1] + np.eye(len(total) - 1)
        u = scipy.linalg.cho_solve(scipy.linalg.cho_factor(inner, check_finite=False), others[:-1, -1])
        error = gram @ np.append(-u, 1.0)  # [G_r|y_r]ᵀ times the errors
        square += float(error[-1] - u @ error[:-1])
        private = np.flatnonzero(is_always & (np.diag(others)[:-1] <= PRIVATE * np.diag(total)[:-1]))
        private_gram = gram[np.ix_(private, private)]
        square -= float(error[private] @ np.linalg.lstsq(private_gram, error[private], rcond=PRIVATE)[0])
    return square


def _harmful(problem: LawProblem, learned: Learned, region: Indices, units: Sequence[Unit]) -> Unit:
    """Return the laws, a unit or all, that cost most in regions left out beyond the evidence for them.

    Returns () if none does.
    """
    sample, _ = problem.some()
    sizes = np.sqrt(sample.sizes(learned.variances) @ sample.prior.spectra)
    law_of_unknown = np.concatenate([np.full(sample.sigma.size, -1), sample.law_of_mode])
    change = sample.by_modes(np.eye(sample.is_law.size + 1), learned.x) * np.concatenate(
        [np.ones(sample.sigma.size), sizes, [1.0]]
    )
    grams = []
    for number in np.unique(region):
        of_region = without_knowledge(only(sample.problem, region == number))
        rows = replace(sample, problem=of_region).rows(learned.x)
        grams.append(change.T @ pose_information(rows, len(change), learned.noise)[0] @ change)
    visible = (law_of_unknown < 0) | (np.diag(np.sum(grams, axis=0))[:-1] > FAINT)
    nats = {}
    for unit in ((), *units, problem.laws):
        kept = visible & ~np.isin(law_of_unknown, [problem.laws.index(law) for law in unit])
        of_kept = np.ix_(np.append(kept, True), np.append(kept, True))
        square = left_out_square([gram[of_kept] for gram in grams], law_of_unknown[kept] < 0)
        nats[unit] = 0.5 * square + sum(learned.nats[law] for law in unit)
    return min(nats, key=nats.__getitem__)


def _units(laws: Sequence[Law]) -> list[Unit]:
    """Return the laws that stand or fall together."""
    sags = tuple(law for law in laws if not isinstance(law, CurveKnots))
    return [*([sags] if sags else []), *((law,) for law in laws if isinstance(law, CurveKnots))]


def _but(laws: Sequence[Law], gone: Collection[Law]) -> list[Law]:
    return [law for law in laws if law not in gone]


def _without(problem: LawProblem, learned: Learned, gone: Collection[Law]) -> Learned:
    """Return what was learned about a problem, without some of its laws."""
    of_robot, kept = problem.problem.n_robot, _but(problem.laws, gone)
    is_gone = np.repeat([law in gone for law in problem.laws], [law.size for law in problem.laws]).astype(bool)
    x = np.delete(learned.x, of_robot - is_gone.size + np.flatnonzero(is_gone))
    evidence = learned.evidence - sum(learned.nats[law] for law in gone)
    variances = {law: learned.variances[law] for law in kept}
    return Learned(variances, learned.noise, {law: learned.nats[law] for law in kept}, evidence, x)
