"""Swapped labels: rows that name one chuck or sphere and were measured with another.

A wrong label is no noise: it moves a whole group of rows by about the distance between the two points, centimetres
where the noise is a tenth of a millimetre, and the fit bends every parameter to meet it. So it is looked for where the
fit's RMS is above 1 % of the least distance between two chucks or two spheres, and nowhere else.

A group is a run of rows of one rig, pairing, shell and bar; where these change so often that runs are too many, all rows
of one; where these are still too many, all rows of one rig and pairing. The fit is repeated without each group, and each
two of them; the robot that fits the rest best by far is the witness, and every group is asked which pairing of its rig it
fits with that robot. If a group fits another, its label is put right and the whole is fitted again: only what brings the
RMS down by TENFOLD counts. Two chucks (or spheres) of a rig exchanged everywhere make no group stand out; these exchanges
are tried one by one. The cost grows with the square of the groups; beyond MAX_GROUPS the search is not made, and the
result says so.

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
from truearm.estimate.problem import Rigs, build_problem
from truearm.estimate.solution import Options
from truearm.model.chain import Chain
from truearm.types import Figures, Floats, ObservationTable, Point, Relabelling, Rig

SUSPICIOUS = 0.01  # of the least distance between two labelled points
TENFOLD = 0.1
ROWS_A_GROUP = 30  # enough to tell centimetres
MAX_GROUPS = 40  # 4 s at worst
MAX_GROUPS_IN_PAIRS = 9
SEARCH_ITERATIONS = 10

Pairing = tuple[str, str]  # chuck, sphere


class LabelGroup(NamedTuple):
    """Rows of the thinned table that were measured together."""

    rig: str
    was: Pairing
    rows: NDArray[np.intp]


class Search(NamedTuple):
    """What was found, and whether it was looked for: "not needed", "done" or "too many groups"."""

    found: tuple[Relabelling, ...]
    status: str


def relabellings(
    chain: Chain,
    rig: Rigs,
    table: ObservationTable,
    rows: NDArray[np.bool_],
    free: NDArray[np.bool_],
    prior_sigma: Mapping[str, float] | Floats | None,
    rms: float,
) -> Search:
    """Labels to put right among the ball-bar rows of ``rows`` (n,); ``rms`` [m] is that of the fit with them as they are."""
    chosen = np.flatnonzero(rows & (table.kind == "ball_bar"))
    rigs = {"": rig} if isinstance(rig, Rig) else rig
    suspicious = SUSPICIOUS * min(map(_least_distance, rigs.values()), default=np.inf)
    if chosen.size == 0 or not rms > suspicious:
        return Search((), "not needed")
    groups, thin, numbers = _groups(rigs, table.select(chosen))
    if len(groups) > MAX_GROUPS:
        return Search((), "too many groups")
    few = table.select(chosen[thin])

    def fitted(these: ObservationTable) -> tuple[float, Floats]:
        problem = build_problem(chain, rig, these, prior_sigma)
        columns = np.concatenate([free, np.ones(len(problem.names) - free.size, dtype=bool)])
        found = fit(problem, columns, problem.start, Options(SEARCH_ITERATIONS))
        return Figures.of(found.information.residual["m"]).rms, found.x[: free.size]

    before, _ = fitted(few)
    best: tuple[float, list[Pairing]] = (TENFOLD * before, [])
    for pairings in _hypotheses(chain, rigs, few, groups, fitted):
        after, _ = fitted(_relabelled(few, groups, pairings))
        if after < best[0]:
            best = (after, pairings)
        if after < suspicious:
            break
    after, pairings = best
    found = (
        Relabelling(tuple(chosen[numbers == i].tolist()), g.was, now, before, after)
        for i, (g, now) in enumerate(zip(groups, pairings, strict=False))
        if now != g.was
    )
    return Search(tuple(found), "done")


def _hypotheses(
    chain: Chain,
    rigs: Mapping[str, Rig],
    table: ObservationTable,
    groups: list[LabelGroup],
    fitted: Callable[[ObservationTable], tuple[float, Floats]],
) -> Iterator[list[Pairing]]:
    """Pairings for the groups: exchanges everywhere, then what witnesses without one and without two groups say."""
    for name, rig in rigs.items():
        for which, names in enumerate((rig.chucks, rig.spheres)):
            for a, b in combinations(names, 2):
                swap = {a: b, b: a} if any(g.rig == name and g.was[which] in (a, b) for g in groups) else {}
                if swap:
                    yield [_exchanged(g, which, swap) if g.rig == name else g.was for g in groups]
    for size in (1, 2) if len(groups) <= MAX_GROUPS_IN_PAIRS else (1,):
        witnesses = []
        for out in combinations(range(len(groups)), size):
            rest = [g.rows for i, g in enumerate(groups) if i not in out]
            if rest:
                witnesses.append(fitted(table.select(np.concatenate(rest))))
        if witnesses:
            _, params = min(witnesses, key=lambda w: w[0])
            yield [_best_pairing(chain, rigs, table.select(g.rows), g, params) for g in groups]


def _best_pairing(
    chain: Chain, rigs: Mapping[str, Rig], rows: ObservationTable, group: LabelGroup, params: Floats
) -> Pairing:
    """The pairing of a group's rig with the least median residual for a robot's params (p,)."""
    rig = rigs[group.rig]
    every = [(c, s) for c in rig.chucks for s in rig.spheres]
    return min(every, key=lambda pair: _misfit(chain, rigs, _labelled(rows, pair), params))


def _misfit(chain: Chain, rigs: Mapping[str, Rig], rows: ObservationTable, params: Floats) -> float:
    problem = build_problem(chain, rigs, rows)
    x = np.concatenate([params, problem.start[params.size :]])
    return float(np.median(np.abs(observe(problem, x, np.zeros(x.size, dtype=bool)).residual["m"])))


def _relabelled(table: ObservationTable, groups: list[LabelGroup], pairings: list[Pairing]) -> ObservationTable:
    chuck, sphere = table.chuck.astype(object), table.sphere.astype(object)
    for group, pair in zip(groups, pairings, strict=True):
        chuck[group.rows], sphere[group.rows] = pair
    return replace(table, chuck=chuck.astype(str), sphere=sphere.astype(str))


def _labelled(rows: ObservationTable, pair: Pairing) -> ObservationTable:
    return replace(rows, chuck=np.full(len(rows), pair[0]), sphere=np.full(len(rows), pair[1]))


def _exchanged(group: LabelGroup, which: int, swap: Mapping[str, str]) -> Pairing:
    chuck, sphere = group.was
    return (swap.get(chuck, chuck), sphere) if which == 0 else (chuck, swap.get(sphere, sphere))


def _keys(table: ObservationTable) -> list[tuple[str, ...]]:
    columns = (table.rig, table.chuck, table.sphere, table.shell, table.bar)
    return list(zip(*(column.tolist() for column in columns), strict=True))


def _numbered(keys: list[tuple[str, ...]]) -> NDArray[np.intp]:
    """(n,) the group of every row, by the finest of the three rules that makes no more than MAX_GROUPS; else the last."""
    numbers = np.cumsum([0, *(a != b for a, b in pairwise(keys))])
    for length in (5, 3):
        if numbers.max() < MAX_GROUPS:
            break
        order = {key: i for i, key in enumerate(dict.fromkeys(key[:length] for key in keys))}
        numbers = np.array([order[key[:length]] for key in keys])
    return numbers


def _groups(
    rigs: Mapping[str, Rig], table: ObservationTable
) -> tuple[list[LabelGroup], NDArray[np.intp], NDArray[np.intp]]:
    """The groups of a table, which rows the thinned table has of it, and the group of every row."""
    keys = _keys(table)
    numbers = _split(_numbered(keys))
    groups: list[LabelGroup] = []
    thin: list[int] = []
    for i in range(int(numbers.max()) + 1):
        rows = np.flatnonzero(numbers == i)
        some = rows[:: max(len(rows) // ROWS_A_GROUP, 1)][:ROWS_A_GROUP].tolist()
        rig, chuck, sphere, *_ = keys[rows[0]]
        was = _name(chuck, rigs[rig].chucks), _name(sphere, rigs[rig].spheres)
        groups.append(LabelGroup(rig, was, np.arange(len(thin), len(thin) + len(some))))
        thin += some
    return groups, np.array(thin, dtype=np.intp), numbers


def _name(name: str, known: Mapping[str, Point]) -> str:
    """An empty name is that of the only one there is."""
    return name or next(iter(known))


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
