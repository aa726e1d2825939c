"""Wrong labels: rows that name one thing of the rig and were measured with another.

A wrong label is no noise: it moves a whole group of rows by about the distance between two points, centimetres where the noise
is a tenth of a millimetre, and the fit bends every parameter to meet it. Which columns of a kind can be confused its ``Kind``
declares (``labels``). A group is a part of a run of rows in which no name changes; where these change so often that runs are too
many, all rows of one label.

What the groups fit is asked of witnesses (``label_test``): the robot as described, once base, tool and rig are placed; the robot
as fitted; the fits without one run, and without two of few runs, that leave least. Each proposes labellings. These, and names
that are exchanged everywhere, are fitted in turn, and a better fit is asked of every row, since wrong labels need not begin where
a group does. A labelling counts if it brings the RMS down by TENFOLD, beyond chance (``label_test.log_chance``). Beyond
MAX_GROUPS the search is not made, and the result says so.

Corners of an equilateral triangle relabelled everywhere leave no residuals if base or tool may be anywhere: in space each such
change is a rotation of the fixture, by a third of a turn or turned over. So a labelling counts too if it fits as well and base and
tool then stand where they were described (within NEAR tolerances of a hand), where as labelled they would not (beyond FAR).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations, islice, pairwise, product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.errors import ProblemError
from truearm.estimate.label_test import CLEARLY, Labels, labellings, log_chance, permuted
from truearm.estimate.problem import Rigs
from truearm.estimate.trial_fit import Trial, misfit, placed, tried
from truearm.kinds.linearised import Indices
from truearm.kinds.registry import GROUPS, identifiers, kinds, rig_names
from truearm.model.chain import Chain
from truearm.types import Floats, ObservationTable, Relabelling, Rig

TENFOLD = 0.1  # of the RMS
LEVEL = 1e-3  # chance that right labels are called wrong
FAR, NEAR = 10.0, 3.0  # tolerances of a hand: 100 mm or 0.5 rad, 30 mm or 0.16 rad
AS_WELL = 2.0  # of χ²
MOST_ROWS = 270  # that are fitted, and LEAST_OF_A_GROUP of each group
LEAST_OF_A_GROUP = 5
SHARE = 0.05  # of the rows: about a part
ROUNDS = 3
BEYOND_NOISE = 100.0  # times the median square: 7 σ of a normal distribution
MAX_GROUPS = 40
MAX_RUNS_IN_PAIRS = 9
MAX_CANDIDATES = 60  # labels of a group
FITTED_PROPOSALS = 4  # of each witness
MAX_EXCHANGES = 60
ENOUGH = 6  # labellings that explain the rows as well
PLACE = GROUPS[0]


class _Scope(NamedTuple):
    """Rows of one rig, kind and place, within which names mean the same, and the labels that they could have."""

    rig: str
    kind: str
    place: str
    could: tuple[Labels, ...]


class Search(NamedTuple):
    """What was found, and whether it was looked for: "not needed", "done" or "too many groups"."""

    found: tuple[Relabelling, ...]
    status: str
    before: Trial | None = None  # fits of some rows as labelled
    after: Trial | None = None  # and with all labels put right
    log_chance: float = 0.0  # that right labels seem so wrong


class _Searched(NamedTuple):
    """Rows, the scope and the group of each, and their labels as they are: numbers of what their scope could have."""

    chain: Chain
    rigs: Mapping[str, Rig]
    table: ObservationTable
    free: NDArray[np.bool_]
    scopes: Sequence[_Scope]
    scope: Indices  # (n,)
    run: Indices  # (n,) in which no name changes, or all rows of one label
    group: Indices  # (n,) a part of it
    was: Indices  # (n,)
    thin: Indices  # rows that are fitted

    def fitted(self, labels: Indices, without: Sequence[int] = ()) -> Trial | None:
        """The fit under labels (n,), to all rows but those of some runs."""
        rows = self.thin[~np.isin(self.run[self.thin], without)]
        return tried(self.chain, self.rigs, self.labelled(labels).select(rows), self.free)

    def labelled(self, labels: Indices) -> ObservationTable:
        """The table with labels (n,)."""
        columns: dict[str, NDArray[Any]] = {}
        for number, scope in enumerate(self.scopes):
            mine = self.scope == number
            names = np.array(scope.could, dtype=object).reshape(len(scope.could), -1)[labels[mine]]
            for column, name in zip(label_columns(scope.kind), names.T, strict=True):
                columns.setdefault(column, self.table.column(column).astype(object))[mine] = name
        own: dict[str, Any] = {}
        more: dict[str, NDArray[Any]] = {**self.table.more}
        for title, values in columns.items():
            (own if title in self.table.fields() else more)[title] = values.astype(str)
        return replace(self.table, **own, more=more)

    def squares(self, known: Mapping[str, float]) -> Floats:
        """(n, k) of every row under each label that it could have, by a robot's parameters; inf for none."""
        most = max(len(scope.could) for scope in self.scopes)
        size = np.array([len(scope.could) for scope in self.scopes])[self.scope]
        out = np.full((len(self.table), most), np.inf)
        for k in range(most):
            of_row = misfit(self.chain, self.rigs, self.labelled(np.minimum(k, size - 1)), known)
            out[:, k] = np.where(k < size, of_row, np.inf)
        return out


def label_columns(kind: str) -> tuple[str, ...]:
    """The columns of a kind whose names can be confused."""
    return kinds()[kind].labels


def relabellings(
    chain: Chain,
    rig: Rigs,
    table: ObservationTable,
    rows: NDArray[np.bool_],
    free: NDArray[np.bool_],
    witnesses: Sequence[Trial] = (),
) -> Search:
    """Labels to put right among the ``rows`` (n,) of a table, whose fit of the robot's ``free`` (p,) parameters is absurd.

    ``witnesses`` are fits of some rows, which are asked first.
    """
    can = np.isin(table.kind, [name for name in kinds() if label_columns(name)])
    chosen = np.flatnonzero(rows & can)
    if chosen.size == 0:
        return Search((), "not needed")
    search = _searched(chain, {"": rig} if isinstance(rig, Rig) else rig, table.select(chosen), free)
    if all(len(scope.could) < 2 for scope in search.scopes):
        return Search((), "not needed")
    if search.group.max() >= MAX_GROUPS:
        return Search((), "too many groups")
    before = search.fitted(search.was)
    if before is None:
        return Search((), "done")
    found: list[tuple[Trial, Indices]] = []
    least, count = before.reduced, 0
    for labels in _proposals(search, before, witnesses):
        after = search.fitted(labels)
        count += 1
        if after is None or not (after.reduced < least or _counts(before, after, count)):
            continue
        after, labels = _row_by_row(search, after, labels)
        least = min(least, after.reduced)
        if _counts(before, after, count) and not np.array_equal(labels, search.was):
            found.append((after, labels))
            # Of labels that only turn a fixture about those count by which base and tool stand where they were described.
            if after.moved < NEAR or len(found) == ENOUGH:
                break
    if not found:
        return Search((), "done")
    after, labels = min(found, key=lambda one: (one[0].reduced > AS_WELL * least, one[0].moved))
    changes = tuple(_changes(search, labels, chosen, before, after))
    return Search(changes, "done", before, after, _log_chance(before, after, count))


def _changes(search: _Searched, labels: Indices, chosen: Indices, before: Trial, after: Trial) -> Iterator[Relabelling]:
    """Each change of labels, with its rows of the whole table."""
    rms = before.rms.get("m", math.nan), after.rms.get("m", math.nan)
    keys = np.stack([search.scope, search.was, labels], axis=1)[labels != search.was]
    for number, was, now in dict.fromkeys(map(tuple, keys.tolist())):
        mine = (search.scope == number) & (search.was == was) & (labels == now)
        scope = search.scopes[number]
        rows = tuple(chosen[mine].tolist())
        yield Relabelling(rows, label_columns(scope.kind), scope.could[was], scope.could[now], *rms)


def _counts(before: Trial, after: Trial, count: int) -> bool:
    """Whether a fit is better tenfold, or as good without base or tool being far from where they are described; beyond chance."""
    turned = before.moved > FAR and after.moved < NEAR and after.reduced < AS_WELL * before.reduced
    better = after.reduced < TENFOLD**2 * before.reduced
    return (turned or better) and _log_chance(before, after, count) < math.log(LEVEL)


def _log_chance(before: Trial, after: Trial, count: int) -> float:
    """Of so good a fit, or of base and tool being where they are, whichever is less."""
    by_fit = log_chance(after.reduced / before.reduced, after.freedom)
    by_place = (after.moved**2 - before.moved**2) / 2.0
    return min(min(by_fit, by_place) + math.log(max(count, 1)), 0.0)


def _row_by_row(search: _Searched, after: Trial, of_group: Indices) -> tuple[Trial, Indices]:
    """The fit asked for each row, since a group may hold rows of two mountings, as long as the fit becomes better for it.

    A row keeps the label of its group unless that is clearly wrong; then it has its own, or else the one that it fits.
    """
    labels = of_group
    for _ in range(ROUNDS):
        squares = search.squares(after.known)
        least = squares.argmin(axis=1)
        by_group, as_named, best = (
            np.take_along_axis(squares, of[:, None], axis=1)[:, 0] for of in (of_group, search.was, least)
        )
        noise = BEYOND_NOISE * float(np.median(by_group))
        other = np.where(as_named <= np.maximum(CLEARLY * best, noise), search.was, least)
        sure = np.minimum(as_named, best) <= noise  # some label or other may fit a bad row better
        labels = np.where(sure & (by_group > np.maximum(CLEARLY * best, noise)), other, of_group)
        again = search.fitted(labels)
        if again is None:
            break
        before, after = after, again
        if after.reduced > 0.99 * before.reduced:
            break
    return after, labels


def _proposals(search: _Searched, before: Trial, asked: Sequence[Trial]) -> Iterator[Indices]:
    """Other labels: by the robot as described and as fitted, exchanges everywhere, by fits without some runs."""
    try:
        as_described = [placed(search.chain, search.rigs, search.table.select(search.thin))]
    except ProblemError:
        as_described = []
    for witness in (*asked, *as_described, before):
        yield from islice(_by_witness(search, witness.known), FITTED_PROPOSALS)
    groups, could, named = _grouped(search)
    exchanged = permuted(could, named, [int(search.scope[rows[0]]) for rows in groups])
    yield from (_spread(search, groups, labels) for labels in islice(dict.fromkeys(exchanged), MAX_EXCHANGES))
    n = int(search.run.max()) + 1
    for size in (1, 2) if n <= MAX_RUNS_IN_PAIRS else (1,):
        fits = [search.fitted(search.was, out) for out in combinations(range(n), size)] if n > size else []
        best = min((fit for fit in fits if fit is not None), key=lambda fit: fit.reduced, default=None)
        if best is not None:
            yield from islice(_by_witness(search, best.known), FITTED_PROPOSALS)


def _by_witness(search: _Searched, known: Mapping[str, float]) -> Iterator[Indices]:
    """Labellings that fit better by a robot's parameters, the best first."""
    try:
        of_row = search.squares(known)
    except ProblemError:
        return
    groups, could, named = _grouped(search)
    squares = [
        dict(zip(labels, (np.median(of_row[rows], axis=0) * rows.size).tolist(), strict=False))
        for rows, labels in zip(groups, could, strict=True)
    ]
    scope = [int(search.scope[rows[0]]) for rows in groups]
    yield from (_spread(search, groups, one.labels) for one in labellings(squares, named, scope))


def _grouped(search: _Searched) -> tuple[list[Indices], list[tuple[Labels, ...]], list[Labels]]:
    """The rows of each group, the labels that it could have, and its own."""
    groups = [np.flatnonzero(search.group == i) for i in range(int(search.group.max()) + 1)]
    could = [search.scopes[search.scope[rows[0]]].could for rows in groups]
    return groups, could, [of[search.was[rows[0]]] for rows, of in zip(groups, could, strict=True)]


def _spread(search: _Searched, groups: Sequence[Indices], labels: Sequence[Labels]) -> Indices:
    """(n,) labels of the rows by those of their groups."""
    out = search.was.copy()
    for rows, mine in zip(groups, labels, strict=True):
        out[rows] = search.scopes[search.scope[rows[0]]].could.index(mine)
    return out


def _searched(chain: Chain, rigs: Mapping[str, Rig], table: ObservationTable, free: NDArray[np.bool_]) -> _Searched:
    places = list(zip(table.rig.tolist(), table.kind.tolist(), table.column(PLACE).tolist(), strict=True))
    scopes = [_Scope(*place, _could(rigs, table, *place)) for place in dict.fromkeys(places)]
    at = {tuple(one[:3]): i for i, one in enumerate(scopes)}
    scope = np.array([at[place] for place in places])
    was = np.empty(len(table), dtype=np.intp)
    for i, one in enumerate(scopes):
        columns = [table.column(column)[scope == i].tolist() for column in label_columns(one.kind)]
        # An empty name is that of the only one there is.
        was[scope == i] = [
            one.could.index(tuple(name or one.could[0][k] for k, name in enumerate(names)))
            for names in zip(*columns, strict=True)
        ]
    run = _runs(table, scope, was)
    group = _parts(run)
    parts = [np.flatnonzero(group == i) for i in range(int(group.max()) + 1)]
    some = max(MOST_ROWS // len(parts), LEAST_OF_A_GROUP)
    thin = [rows[np.unique(np.linspace(0, rows.size - 1, min(rows.size, some)).astype(np.intp))] for rows in parts]
    return _Searched(chain, rigs, table, free, scopes, scope, run, group, was, np.sort(np.concatenate(thin)))


def _could(rigs: Mapping[str, Rig], table: ObservationTable, rig: str, kind: str, place: str) -> tuple[Labels, ...]:
    """The labels that rows of a scope could have: of the names of the rig, or else of those that its rows have."""
    mine = (table.rig == rig) & (table.kind == kind) & (table.column(PLACE) == place)
    in_rig, names = rig_names(rigs[rig]), []
    for column in label_columns(kind):
        have = dict.fromkeys(table.column(column)[mine].tolist())
        known = in_rig.get(column) or have
        names.append([name for name in known if name or len(known) == 1] if known is not have else list(have))
    every = tuple(product(*names))
    if len(every) <= MAX_CANDIDATES:
        return every
    columns = zip(*(table.column(column)[mine].tolist() for column in label_columns(kind)), strict=True)
    return tuple(dict.fromkeys(columns))[:1] if len(set(columns)) == 1 else tuple(dict.fromkeys(columns))


def _runs(table: ObservationTable, scope: Indices, was: Indices) -> Indices:
    """(n,) the run of every row: rows in which no name changes; too many of these: all rows of one label."""
    others = [table.column(name).tolist() for name in identifiers()]
    keys = list(zip(scope.tolist(), was.tolist(), *others, strict=True))
    runs = np.cumsum([0, *(a != b for a, b in pairwise(keys))])
    for length in (len(keys[0]), 2):
        if runs.max() < MAX_GROUPS:
            break
        order = {key: i for i, key in enumerate(dict.fromkeys(key[:length] for key in keys))}
        runs = np.array([order[key[:length]] for key in keys])
    return np.asarray(runs, dtype=np.intp)


def _parts(runs: Indices) -> Indices:
    """(n,) the group of every row: runs cut into parts of about SHARE of the rows, since a wrong label may have joined neighbours."""
    count = np.bincount(runs)
    parts = np.maximum(np.rint(count / max(SHARE * runs.size, LEAST_OF_A_GROUP)).astype(np.intp), 1)
    if parts.sum() > MAX_GROUPS:
        return runs
    out, first = np.empty_like(runs), np.concatenate([[0], np.cumsum(parts)])
    for i, k in enumerate(parts.tolist()):
        rows = np.flatnonzero(runs == i)
        out[rows] = first[i] + np.arange(rows.size) * k // rows.size
    return out
