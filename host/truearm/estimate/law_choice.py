"""Which joint laws are kept: those that the evidence supports, and that regions left out do not contradict.

A law that raises the log evidence by less than GATE nats is dropped. One below EARNEST is dropped if the evidence, with
the noise learned again without it, is no lower than that. All sags stand or fall together, for gravity acts on all
joints or on none.

Evidence is of the rows that were measured. A law that describes the arm also helps where it was not fitted, so regions
of poses are left out in turn, at fixed variances and noise. The fit to all other regions
(docs/explanation/estimation.md) needs one triangle per region for any selection of laws. A law is dropped if without it
the errors fall by more nats, ½ Σ |y_r − G_r u|², than the evidence for it.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from truearm.estimate.evidence import prior_root
from truearm.estimate.law_fit import LawProblem, Learned, learn
from truearm.estimate.pose_noise import PoseNoise, pose_information, pose_rows
from truearm.estimate.problem import without_knowledge
from truearm.estimate.whitened_rows import only
from truearm.kinds.table import ObservationTable
from truearm.types import CurveKnots, Floats, Indices, Law

GATE = 6.0  # nats
EARNEST = 25.0  # nats
ABSENT = 0.05  # nats: without such a law, variances and noise are those that were learned with it
HALVINGS = 3  # of the joint space: 8 regions
LEAST_OF_REGION = 4  # poses
PRIVATE = 1e-9  # of its information, all that other regions have of an unknown

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
    sure: frozenset[Unit] = frozenset()
    if isinstance(start, LawChoice):
        problem, dropped, sure = make(start.kept), dict(start.dropped), start.sure
        learned = start.learned._replace(x=problem.start)  # beside other faults, the problem has other unknowns
    else:
        problem = make(laws)
        learned = learn(problem, start, rounds=1)
        absent = [unit for unit in _units(laws) if all(learned.nats[law] < ABSENT for law in unit)]
        dropped = {law: learned.nats[law] for unit in absent for law in unit}
        problem, learned = make(_but(laws, dropped)), _without(problem, learned, dropped)
    learned = learn(problem, learned)
    while problem.laws:
        units = _units(problem.laws)
        gain = [sum(learned.nats[law] for law in unit) for unit in units]
        weak = sorted((i for i, nats in enumerate(gain) if nats < GATE), key=gain.__getitem__)
        # Two laws of one error leave little evidence for each, so the strongest is judged without the others.
        gone = [law for i in (weak[:-1] or weak) for law in units[i]]
        doubtful = [i for i, unit in enumerate(units) if gain[i] < EARNEST and unit not in sure and not gone]
        if doubtful:
            gone = list(units[min(doubtful, key=gain.__getitem__)])
        elif not gone:
            gone = list(_harmful(problem, learned, region, units))
        if not gone:
            break
        fewer, without = make(_but(problem.laws, gone)), _without(problem, learned, gone)
        if any(learned.nats[law] >= ABSENT for law in gone):
            without = learn(fewer, without)
        if doubtful and learned.evidence - without.evidence >= GATE:
            sure |= {tuple(gone)}
            continue
        dropped |= {law: learned.nats[law] for law in gone}
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
        for part in np.unique(region):
            mine = np.flatnonzero(region == part)
            if mine.size >= 2 * LEAST_OF_REGION:
                joint = int(np.argmax(np.std(q[mine], axis=0)))
                order = mine[np.argsort(q[mine, joint], kind="stable")]
                region[order[order.size // 2 :]] = region.max() + 1
    return region[number.ravel()]


def left_out_square(roots: Sequence[Floats], always: NDArray[np.bool_]) -> float:
    """Return Σ |y_r − G_r u|² over the regions, from their rows [G_r | y_r]; ``always`` (s,): unknowns that are no law's."""
    grams = [root.T @ root for root in roots]
    total = np.sum(grams, axis=0)
    square = 0.0
    for root, gram in zip(roots, grams, strict=True):
        others = total - gram
        inner = others[:-1, :-1] + np.eye(len(total) - 1)
        u = scipy.linalg.cho_solve(scipy.linalg.cho_factor(inner, check_finite=False), others[:-1, -1])
        error = root[:, -1] - root[:, :-1] @ u
        private = always & (np.diag(others)[:-1] <= PRIVATE * np.diag(total)[:-1])
        basis = np.linalg.qr(root[:, :-1][:, private])[0]
        square += float(error @ error - ((basis.T @ error) ** 2).sum())
    return square


def _harmful(problem: LawProblem, learned: Learned, region: Indices, units: Sequence[Unit]) -> Unit:
    """Return the laws, a unit or all, that cost most in regions left out beyond the evidence for them; none if none does."""
    part, rows = problem.some(), []
    blocks = zip(part.laws, part.blocks, strict=True)
    priors = [prior_root(block, learned.variances[law]) for law, block in blocks]
    owner = np.repeat(np.arange(-1, len(priors)), [int((~part.is_law).sum()), *(prior.shape[1] for prior in priors)])
    order = np.argsort(part.is_law, kind="stable")
    change = scipy.linalg.block_diag(np.diag(part.sigma[~part.is_law]), *priors)
    for number in np.unique(region):
        some = without_knowledge(only(part.problem, region == number))
        of_region = pose_rows(some, learned.x, part.columns, part.pose)
        root, _ = pose_information(of_region, part.is_law.size + 1, learned.noise)
        root[:, -1] += root[:, :-1] @ (learned.x - part.reference)[part.columns]
        rows.append(np.column_stack([root[:, order] @ change, root[:, -1]]))
    nats = {}
    for unit in ((), *units, problem.laws):
        kept = ~np.isin(owner, [problem.laws.index(law) for law in unit])
        square = left_out_square([root[:, np.append(kept, True)] for root in rows], owner[kept] < 0)
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
    at = np.flatnonzero(problem.columns)[problem.is_law]
    blocks = zip(problem.laws, problem.blocks, strict=True)
    columns = [at[block.columns] for law, block in blocks if law in gone]
    kept = _but(problem.laws, gone)
    evidence = learned.evidence - sum(learned.nats[law] for law in gone)
    x = np.delete(learned.x, np.concatenate(columns)) if columns else learned.x
    return Learned(
        {k: learned.variances[k] for k in kept}, learned.noise, {k: learned.nats[k] for k in kept}, evidence, x
    )
