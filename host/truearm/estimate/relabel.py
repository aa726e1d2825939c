"""Swapped labels: rows that name one chuck or sphere and were measured with another.

A wrong label is no noise: it moves a whole group of rows by about the distance between the two points, centimetres
where the noise is a tenth of a millimetre, and the fit bends every parameter to meet it. So it is looked for where the
fit's RMS is above 1 % of the least distance between two chucks or two spheres, and nowhere else.

A group is a run of rows of one pairing, shell and bar, or where these change from row to row, all rows of one. The fit is repeated without each group, and each two of them; the
robot that fits the rest best by far is the witness, and every group is asked which pairing it fits with that robot. If a
group fits another, its label is put right and the whole is fitted again: only what brings the RMS down by TENFOLD counts.
Two chucks (or spheres) exchanged everywhere make no group stand out; these exchanges are tried one by one.

What cannot be found: corners of an equilateral triangle relabelled everywhere. In space each such change is a rotation of
the fixture, by a third of a turn or turned over, and link 1 or the last link may absorb it without a trace in the residuals.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from itertools import combinations, pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.estimate.fit import fit
from truearm.estimate.information import observe
from truearm.estimate.lm import DAMPING_START
from truearm.estimate.problem import Rigs, build_problem
from truearm.estimate.solution import Options
from truearm.model.chain import Chain
from truearm.types import Floats, ObservationTable, Point, Relabelling, Rig

SUSPICIOUS = 0.01  # of the least distance between two labelled points
TENFOLD = 0.1
ROWS_A_GROUP = 30  # enough to tell centimetres
MAX_GROUPS = 18
MAX_GROUPS_IN_PAIRS = 9
SEARCH_ITERATIONS = 10

Pairing = tuple[str, str]  # chuck, sphere


class Group(NamedTuple):
    """Rows of the thinned table that were measured together."""

    was: Pairing
    rows: NDArray[np.intp]


def relabellings(
    chain: Chain,
    rig: Rigs,
    table: ObservationTable,
    rows: NDArray[np.bool_],
    free: NDArray[np.bool_],
    prior_sigma: Mapping[str, float] | Floats | None,
    rms: float,
) -> tuple[Relabelling, ...]:
    """Labels to put right among the ball-bar rows of ``rows`` (n,); ``rms`` [m] is that of the fit with them as they are."""
    chosen = np.flatnonzero(rows & (table.kind == "ball_bar"))
    if not isinstance(rig, Rig) or chosen.size == 0 or not rms > SUSPICIOUS * _least_distance(rig):
        return ()
    groups, thin, numbers = _groups(table.select(chosen))
    if len(groups) > MAX_GROUPS:
        return ()
    few = table.select(chosen[thin])

    def fitted(these: ObservationTable) -> tuple[float, Floats]:
        problem = build_problem(chain, rig, these, prior_sigma)
        columns = np.concatenate([free, np.ones(len(problem.names) - free.size, dtype=bool)])
        found = fit(problem, columns, problem.start, Options(SEARCH_ITERATIONS), DAMPING_START)
        return _rms(found.information.residual), found.x[: free.size]

    before, _ = fitted(few)
    best: tuple[float, list[Pairing]] = (TENFOLD * before, [])
    for pairings in _hypotheses(chain, rig, few, groups, fitted):
        after, _ = fitted(_relabelled(few, groups, pairings))
        if after < best[0]:
            best = (after, pairings)
        if after < SUSPICIOUS * _least_distance(rig):
            break
    after, pairings = best
    return tuple(
        Relabelling(tuple(chosen[numbers == i].tolist()), g.was, now, before, after)
        for i, (g, now) in enumerate(zip(groups, pairings, strict=False))
        if now != g.was
    )


def _hypotheses(
    chain: Chain,
    rig: Rig,
    table: ObservationTable,
    groups: list[Group],
    fitted: Callable[[ObservationTable], tuple[float, Floats]],
) -> Iterator[list[Pairing]]:
    """Pairings for the groups: exchanges everywhere, then what witnesses without one and without two groups say."""
    as_they_are = [g.was for g in groups]
    for which, names in enumerate((rig.chucks, rig.spheres)):
        for a, b in combinations(names, 2):
            swap = {a: b, b: a}
            yield [_replaced(pair, which, swap.get(pair[which], pair[which])) for pair in as_they_are]
    for size in (1, 2) if len(groups) <= MAX_GROUPS_IN_PAIRS else (1,):
        witnesses = []
        for out in combinations(range(len(groups)), size):
            rest = [g.rows for i, g in enumerate(groups) if i not in out]
            if rest:
                witnesses.append(fitted(table.select(np.concatenate(rest))))
        if witnesses:
            _, params = min(witnesses, key=lambda w: w[0])
            yield _best_pairings(chain, rig, table, groups, params)


def _best_pairings(
    chain: Chain, rig: Rig, table: ObservationTable, groups: list[Group], params: Floats
) -> list[Pairing]:
    """For each group the pairing with the least median residual for a robot's params (p,)."""
    every = [(c, s) for c in rig.chucks for s in rig.spheres]
    misfit = np.array([[_misfit(chain, rig, table.select(g.rows), pair, params) for pair in every] for g in groups])
    return [every[i] for i in np.argmin(misfit, axis=1)]


def _misfit(chain: Chain, rig: Rig, rows: ObservationTable, pair: Pairing, params: Floats) -> float:
    problem = build_problem(chain, rig, _labelled(rows, pair))
    x = np.concatenate([params, problem.start[params.size :]])
    return float(np.median(np.abs(observe(problem, x, np.zeros(x.size, dtype=bool)).residual)))


def _relabelled(table: ObservationTable, groups: list[Group], pairings: list[Pairing]) -> ObservationTable:
    chuck, sphere = table.chuck.astype(object), table.sphere.astype(object)
    for group, pair in zip(groups, pairings, strict=True):
        chuck[group.rows], sphere[group.rows] = pair
    return replace(table, chuck=chuck.astype(str), sphere=sphere.astype(str))


def _labelled(rows: ObservationTable, pair: Pairing) -> ObservationTable:
    return replace(rows, chuck=np.full(len(rows), pair[0]), sphere=np.full(len(rows), pair[1]))


def _replaced(pair: Pairing, which: int, name: str) -> Pairing:
    return (name, pair[1]) if which == 0 else (pair[0], name)


def _keys(table: ObservationTable) -> list[tuple[str, str, str, str]]:
    columns = (table.chuck, table.sphere, table.shell, table.bar)
    return list(zip(*(column.tolist() for column in columns), strict=True))


def _groups(table: ObservationTable) -> tuple[list[Group], NDArray[np.intp], NDArray[np.intp]]:
    """The groups of a table, which rows the thinned table has of it, and the group of every row."""
    keys = _keys(table)
    numbers = np.cumsum([0, *(a != b for a, b in pairwise(keys))])
    if numbers[-1] >= MAX_GROUPS:
        order = {key: i for i, key in enumerate(dict.fromkeys(keys))}
        numbers = np.array([order[key] for key in keys])
    numbers = _split(numbers)
    groups: list[Group] = []
    thin: list[int] = []
    for i in range(int(numbers.max()) + 1):
        rows = np.flatnonzero(numbers == i)
        some = rows[:: max(len(rows) // ROWS_A_GROUP, 1)][:ROWS_A_GROUP].tolist()
        chuck, sphere, *_ = keys[rows[0]]
        groups.append(Group((chuck, sphere), np.arange(len(thin), len(thin) + len(some))))
        thin += some
    return groups, np.array(thin, dtype=np.intp), numbers


def _split(numbers: NDArray[np.intp]) -> NDArray[np.intp]:
    """Groups about twice as long as is usual, or more, cut in equal parts: a wrong label may have joined neighbours."""
    count = np.bincount(numbers)
    parts = np.maximum(np.rint(count / np.median(count)).astype(np.intp), 1)
    if parts.sum() > MAX_GROUPS:
        return numbers
    out, first = np.empty_like(numbers), np.concatenate([[0], np.cumsum(parts)])
    for i, k in enumerate(parts.tolist()):
        rows = np.flatnonzero(numbers == i)
        out[rows] = first[i] + np.arange(rows.size) * k // rows.size
    return out


def _least_distance(rig: Rig) -> float:
    """Between two chucks or two spheres [m]; inf where there is nothing to confuse."""
    known: list[Mapping[str, Point]] = [rig.chucks, rig.spheres]
    apart = [
        float(np.linalg.norm(np.subtract(a.xyz, b.xyz)))
        for points in known
        for a, b in combinations(points.values(), 2)
    ]
    return min(apart, default=float("inf"))


def _rms(residual: Floats) -> float:
    return float(np.sqrt(np.mean(residual**2)))
