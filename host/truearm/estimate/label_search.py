"""Wrong labels: rows that name one item of the rig but were measured with another.

A wrong label is not noise. It moves a whole group of rows by about the distance between two points, which is
centimetres where the noise is a tenth of a millimetre, and the fit distorts every parameter to follow it. Each ``Kind``
declares which of its columns can be confused (``labels``). A group is part of a run of rows in which no name changes.
If the names change so often that there are too many runs, a group is all rows with one label.

Several reference robots suggest which labels a group fits (``label_test``): the nominal robot once base, tool and rig
are placed, the fitted robot, and the fits without one run, and without two if there are few runs, that leave the
smallest residuals. Each proposes labellings. These, and names exchanged everywhere, are fitted in turn, and the better
fit is then checked row by row, since wrong labels need not begin at a group boundary. A labelling counts if it reduces
the RMS by TENFOLD, beyond chance (``label_test.log_chance``). Above MAX_GROUPS the search is skipped, and the result
records this.

If the corners of an equilateral triangle are relabelled everywhere, there are no residuals as long as base or tool can
be anywhere: each such change is a rotation of the fixture in space, by a third of a turn or turned over. Therefore a
labelling also counts if it fits equally well and places base and tool where they were described (within NEAR tolerances
of manual mounting), while the given labels do not (beyond FAR).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations, islice, pairwise, product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.errors import ProblemError
from truearm.estimate.better_fit import fits
from truearm.estimate.label_test import CLEARLY, Labels, labellings, log_chance, permuted
from truearm.estimate.ties import first_within
from truearm.estimate.trial_fit import Trial, misfit, placed, tried
from truearm.kinds.registry import GROUPS, identifiers, kinds, rig_names
from truearm.kinds.table import ObservationTable
from truearm.model.chain import Chain
from truearm.results import Relabelling
from truearm.types import Floats, Indices, Rig, Rigs, rigs_by_name, thinned

TENFOLD = 0.1  # of the RMS
LEVEL = 1e-3  # probability that correct labels are reported as wrong
FAR, NEAR = 10.0, 3.0  # tolerances of manual mounting: 100 mm or 0.5 rad, 30 mm or 0.16 rad
AS_WELL = 2.0  # of χ²
MOST_ROWS = 270  # that are fitted, and at least LEAST_OF_A_GROUP of each group
LEAST_OF_A_GROUP = 5
SHARE = 0.05  # of the rows: approximate size of a part
ROUNDS = 3
BEYOND_NOISE = 100.0  # times the median square: 7 σ of a normal distribution
MAX_GROUPS = 40
MAX_RUNS_IN_PAIRS = 9
MAX_CANDIDATES = 60  # labels of a group
FITTED_PROPOSALS = 4  # of each reference robot
MAX_EXCHANGES = 60
ENOUGH = 6  # labellings that explain the rows equally well
PLACE = GROUPS[0]


class _Scope(NamedTuple):
    """Rows of one rig, kind and place, within which names have the same meaning, and the labels that they could have."""

    rig: str
    kind: str
    place: str
    could: tuple[Labels, ...]


class Search(NamedTuple):
    """The result of a search and whether it was made: "not needed", "done" or "too many groups"."""

    found: tuple[Relabelling, ...]
    status: str
    before: Trial | None = None  # fits of some rows with the given labels
    after: Trial | None = None  # and with all labels corrected
    log_chance: float = 0.0  # that correct labels appear this wrong


class _Searched(NamedTuple):
    """Rows, the scope and the group of each, and their given labels as indices of those possible in their scope."""

    chain: Chain
    rigs: Mapping[str, Rig]
    table: ObservationTable
    free: NDArray[np.bool_]
    scopes: Sequence[_Scope]
    scope: Indices  # (n,)
    run: Indices  # (n,) in which no name changes, or all rows with one label
    group: Indices  # (n,) part of a run
    was: Indices  # (n,)
    thin: Indices  # rows that are fitted

    def fitted(self, labels: Indices, without: Sequence[int] = (), goal: float = 0.0) -> Trial | None:
        """Return the fit with labels (n,) to all rows except those of some runs; it is of no use above a χ²/ν of ``goal``."""
        rows = self.thin[~np.isin(self.run[self.thin], without)]
        return tried(self.chain, self.rigs, self.labelled(labels).select(rows), self.free, goal=goal)

    def labelled(self, labels: Indices) -> ObservationTable:
        """Return the table with labels (n,)."""
        columns: dict[str, NDArray[Any]] = {}
        for number, scope in enumerate(self.scopes):
            mine = self.scope == number
            names = np.array(scope.could, dtype=object).reshape(len(scope.could), -1)[labels[mine]]
            for column, name in zip(label_columns(scope.kind), names.T, strict=True):
                columns.setdefault(column, self.table[column].astype(object))[mine] = name
        return self.table.replace(**{column: names.astype(str) for column, names in columns.items()})

    def squares(self, known: Mapping[str, float]) -> Floats:
        """Return the squares (n, k) of every row under each possible label, for given robot parameters; inf for none."""
        most = max(len(scope.could) for scope in self.scopes)
        size = np.array([len(scope.could) for scope in self.scopes])[self.scope]
        out = np.full((len(self.table), most), np.inf)
        for k in range(most):
            of_row = misfit(self.chain, self.rigs, self.labelled(np.minimum(k, size - 1)), known)
            out[:, k] = np.where(k < size, of_row, np.inf)
        return out


def label_columns(kind: str) -> tuple[str, ...]:
    """Return the columns of a kind whose names can be confused."""
    return kinds()[kind].labels


def relabellings(
    chain: Chain,
    rig: Rigs,
    table: ObservationTable,
    rows: NDArray[np.bool_],
    free: NDArray[np.bool_],
    witnesses: Sequence[Trial] = (),
) -> Search:
    """Return the labels to correct among the ``rows`` (n,) of a table whose fit of the ``free`` (p,) parameters is absurd.

    ``witnesses`` are fits of some rows, which are tried first.
    """
    can = np.isin(table.kind, [name for name in kinds() if label_columns(name)])
    chosen = np.flatnonzero(rows & can)
    if chosen.size == 0:
        return Search((), "not needed")
    search = _searched(chain, rigs_by_name(rig), table.select(chosen), free)
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
        after = search.fitted(labels, goal=max(least, AS_WELL * before.reduced if before.moved > FAR else 0.0))
        count += 1
        if after is None or not (after.reduced < least or _counts(before, after, count)):
            continue
        after, labels = _row_by_row(search, after, labels)
        least = min(least, after.reduced)
        if _counts(before, after, count) and not np.array_equal(labels, search.was):
            found.append((after, labels))
            # Labels that only rotate a fixture count if with them base and tool are where they were described.
            if after.moved < NEAR or len(found) == ENOUGH:
                break
    if not found:
        return Search((), "done")
    as_well = [one for one in found if one[0].reduced <= AS_WELL * least] or found
    after, labels = as_well[first_within([-trial.moved for trial, _ in as_well])]
    changes = tuple(_changes(search, labels, chosen, before, after))
    return Search(changes, "done", before, after, _log_chance(before, after, count))


def _changes(search: _Searched, labels: Indices, chosen: Indices, before: Trial, after: Trial) -> Iterator[Relabelling]:
    """Return each change of labels, with its rows of the complete table."""
    rms = before.rms.get("m", math.nan), after.rms.get("m", math.nan)
    keys = np.stack([search.scope, search.was, labels], axis=1)[labels != search.was]
    for number, was, now in dict.fromkeys(map(tuple, keys.tolist())):
        mine = (search.scope == number) & (search.was == was) & (labels == now)
        scope = search.scopes[number]
        rows = tuple(chosen[mine].tolist())
        yield Relabelling(rows, label_columns(scope.kind), scope.could[was], scope.could[now], *rms)


def _counts(before: Trial, after: Trial, count: int) -> bool:
    """Return whether a fit is better tenfold, or as good and not absurd with base and tool close to their described poses; beyond chance."""
    turned = before.moved > FAR and after.moved < NEAR and after.reduced < AS_WELL * before.reduced and fits(after)
    better = after.reduced < TENFOLD**2 * before.reduced
    return (turned or better) and _log_chance(before, after, count) < math.log(LEVEL)


def _log_chance(before: Trial, after: Trial, count: int) -> float:
    """Return the log probability of so good a fit, or of base and tool being where they are, whichever is smaller."""
    by_fit = log_chance(after.reduced / before.reduced, after.freedom)
    by_place = (after.moved**2 - before.moved**2) / 2.0
    return min(min(by_fit, by_place) + math.log(max(count, 1)), 0.0)


def _row_by_row(search: _Searched, after: Trial, of_group: Indices) -> tuple[Trial, Indices]:
    """Refine the fit row by row, since a group may hold rows of two mountings, as long as the fit improves.

    A row keeps the label of its group unless that is clearly wrong. Then it gets its own given label, or otherwise the
    one that it fits.
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
        sure = np.minimum(as_named, best) <= noise  # an outlier may fit some label better by chance
        labels = np.where(sure & (by_group > np.maximum(CLEARLY * best, noise)), other, of_group)
        again = search.fitted(labels)
        if again is None:
            break
        before, after = after, again
        if after.reduced > 0.99 * before.reduced:
            break
    return after, labels


def _proposals(search: _Searched, before: Trial, asked: Sequence[Trial]) -> Iterator[Indices]:
    """Propose labels from the nominal and the fitted robot, from exchanges everywhere, and from fits without some runs."""
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
        best: Trial | None = None
        for out in combinations(range(n), size) if n > size else ():
            fit = search.fitted(search.was, out, 0.0 if best is None else best.reduced)
            if fit is not None and (best is None or fit.reduced < best.reduced):
                best = fit
        if best is not None:
            yield from islice(_by_witness(search, best.known), FITTED_PROPOSALS)


def _by_witness(search: _Searched, known: Mapping[str, float]) -> Iterator[Indices]:
    """Return labellings that fit better for a robot's parameters, the best first."""
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
    """Return the rows of each group, the labels that it could have, and its own."""
    groups = [np.flatnonzero(search.group == i) for i in range(int(search.group.max()) + 1)]
    could = [search.scopes[search.scope[rows[0]]].could for rows in groups]
    return groups, could, [of[search.was[rows[0]]] for rows, of in zip(groups, could, strict=True)]


def _spread(search: _Searched, groups: Sequence[Indices], labels: Sequence[Labels]) -> Indices:
    """Return labels (n,) of the rows from those of their groups."""
    out = search.was.copy()
    for rows, mine in zip(groups, labels, strict=True):
        out[rows] = search.scopes[search.scope[rows[0]]].could.index(mine)
    return out


def _searched(chain: Chain, rigs: Mapping[str, Rig], table: ObservationTable, free: NDArray[np.bool_]) -> _Searched:
    places = list(zip(table.rig.tolist(), table.kind.tolist(), table[PLACE].tolist(), strict=True))
    scopes = [_Scope(*place, _could(rigs, table, *place)) for place in dict.fromkeys(places)]
    at = {tuple(one[:3]): i for i, one in enumerate(scopes)}
    scope = np.array([at[place] for place in places])
    was = np.empty(len(table), dtype=np.intp)
    for i, one in enumerate(scopes):
        columns = [table[column][scope == i].tolist() for column in label_columns(one.kind)]
        # An empty name stands for the only one there is.
        was[scope == i] = [
            one.could.index(tuple(name or one.could[0][k] for k, name in enumerate(names)))
            for names in zip(*columns, strict=True)
        ]
    run = _runs(table, scope, was)
    group = _parts(run)
    parts = [np.flatnonzero(group == i) for i in range(int(group.max()) + 1)]
    some = max(MOST_ROWS // len(parts), LEAST_OF_A_GROUP)
    thin = [rows[thinned(rows.size, some)] for rows in parts]
    return _Searched(chain, rigs, table, free, scopes, scope, run, group, was, np.sort(np.concatenate(thin)))


def _could(rigs: Mapping[str, Rig], table: ObservationTable, rig: str, kind: str, place: str) -> tuple[Labels, ...]:
    """Return the labels that rows of a scope could have, from the names in the rig, or otherwise in its rows."""
    mine = (table.rig == rig) & (table.kind == kind) & (table[PLACE] == place)
    in_rig, names = rig_names(rigs[rig]), []
    for column in label_columns(kind):
        have = dict.fromkeys(table[column][mine].tolist())
        known = in_rig.get(column) or have
        names.append([name for name in known if name or len(known) == 1] if known is not have else list(have))
    every = tuple(product(*names))
    if len(every) <= MAX_CANDIDATES:
        return every
    columns = zip(*(table[column][mine].tolist() for column in label_columns(kind)), strict=True)
    return tuple(dict.fromkeys(columns))[:1] if len(set(columns)) == 1 else tuple(dict.fromkeys(columns))


def _runs(table: ObservationTable, scope: Indices, was: Indices) -> Indices:
    """Return the run (n,) of every row: consecutive rows without a name change, or all rows of one label if too many."""
    others = [table[name].tolist() for name in identifiers()]
    keys = list(zip(scope.tolist(), was.tolist(), *others, strict=True))
    runs = np.cumsum([0, *(a != b for a, b in pairwise(keys))])
    for length in (len(keys[0]), 2):
        if runs.max() < MAX_GROUPS:
            break
        order = {key: i for i, key in enumerate(dict.fromkeys(key[:length] for key in keys))}
        runs = np.array([order[key[:length]] for key in keys])
    return np.asarray(runs, dtype=np.intp)


def _parts(runs: Indices) -> Indices:
    """Return the group (n,) of every row.

    Runs are cut into parts of about SHARE of the rows, since a wrong label may have joined neighbouring runs.
    """
    count = np.bincount(runs)
    parts = np.maximum(np.rint(count / max(SHARE * runs.size, LEAST_OF_A_GROUP)).astype(np.intp), 1)
    if parts.sum() > MAX_GROUPS:
        return runs
    out, first = np.empty_like(runs), np.concatenate([[0], np.cumsum(parts)])
    for i, k in enumerate(parts.tolist()):
        rows = np.flatnonzero(runs == i)
        out[rows] = first[i] + np.arange(rows.size) * k // rows.size
    return out
