"""Rows that were measured with another part than their label says, or with a set-up that the other rows do not share.

After a robust fit, each possible label has a robust log-likelihood in each row, −1.5 log(1 + r²/2s²), with s the median
residual. "none of them" has that of a residual of APART s. The run of rows in which another label gains most, less
PRICE a row, is relabelled. The next is sought, until chance may give as much. The fit is repeated with the new labels
as long as they change. One wrong mount can pull a fit along with it, and a moved set-up half of the rows. The fits
without each mount, and without each half, compete with that of all rows.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import islice, pairwise, product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.checks.trial import LEVEL, Alternative, idle_options, misfit, trial_problem
from truearm.errors import ProblemError
from truearm.estimate.circumstances import mountings
from truearm.estimate.fit import fit
from truearm.estimate.solvers import Loss
from truearm.kinds.registry import kinds, rig_names
from truearm.kinds.table import ObservationTable
from truearm.types import Floats, Indices, Rigs, rigs_by_name, thinned

PRICE = 0.3  # nats a row, for being relabelled at all
APART = 5.0  # usual residuals
LEAST_APART = 5  # rows
MOST_RUNS = 12
MOST_LABELS = 60  # of more, only those that rows have
MOST_MOUNTS = 40  # each of which is left out in turn
MOST_ROWS = 150  # of a robust fit
STEPS = 5
ROUNDS = 3
IMPOSSIBLE = -1e3  # log-likelihood of a label that the rig does not have
FLOOR = 0.05  # of a drawing's tolerance: residuals are not taken for more exact

Labels = Mapping[str, str]  # by column


class WrongLabels(NamedTuple):
    """Rows [first, last) of those passed that fit another ``label`` (its number in ``scores``) by ``gain`` nats."""

    first: int
    last: int
    label: int
    gain: float


def relabelled(inputs: Alternative) -> tuple[Alternative, Sequence[WrongLabels]]:
    """Return the given rows with labels as they fit best, without rows that fit none; and the runs that change.

    There are none if the given labels fit, or if more than half of the rows would change.
    """
    table = inputs.table.select(inputs.rows)
    possible = possible_labels(inputs.rig, table)
    labels = np.zeros(len(table), dtype=np.intp)
    for attempt in range(ROUNDS):
        score = scores(inputs, table, labels, possible, every_subset=attempt == 0)
        if score is None:
            return inputs, ()
        earlier, (labels, runs) = labels, best_labels(score)
        differs, fits = labels > 0, labels < len(possible) - 1
        if differs.mean() > 0.5 or not runs:
            return inputs, ()
        if (labels == earlier).all():
            break
    restored = with_labels(inputs.rig, inputs.table, inputs.rows, possible, labels)
    values = {
        "runs": [_named(table, run, possible[run.label]) for run in runs],
        "leave_out": [f"{inputs.rows[run.first] + 1}:{inputs.rows[run.last - 1] + 1}" for run in runs],
        "bar": bool((restored.bar != inputs.table.bar).any()),
        "n": int(differs.sum()),
        "others": int((~differs).sum()),
    }
    code = "wrong-labels" if (differs & fits).any() else "rows-apart"
    price = len(runs) * math.log(len(table) * len(possible))
    return replace(inputs, code=code, values=values, table=restored, rows=inputs.rows[fits], price=price), runs


def _named(table: ObservationTable, run: WrongLabels, labels: Labels) -> str:
    """Return the rows of a run, and the labels that they fit instead of their own."""
    rows = slice(run.first, run.last)
    first, last = (row_name(table, row) for row in (run.first, run.last - 1))
    span = first if first == last else f"{first} to {last}"
    if not labels:
        return f"{span}: none of the rig"
    changes = [
        f"{column} {name}, not {' or '.join(sorted(set(table[column][rows]) - {name}))}"
        for column, name in labels.items()
        if (~np.isin(table[column][rows], ["", name])).any()
    ]
    return f"{span}: {' and '.join(changes)}"


def row_name(table: ObservationTable, row: int) -> str:
    """Return where a row comes from, without the folder, which would reveal somebody's paths."""
    return re.split(r"[\\/]", str(table.source[row]))[-1]


def possible_labels(rigs: Rigs, table: ObservationTable) -> list[Labels]:
    """Return combinations of names by column that operators confuse: a row's own, all that it may have, and none."""
    columns = dict.fromkeys(column for kind in np.unique(table.kind) for column in kinds()[str(kind)].labels)
    used = {column: sorted(set(table[column].tolist()) - {""}) for column in columns}
    used = {column: names for column, names in used.items() if names}
    in_rigs = [rig_names(rig) for rig in rigs_by_name(rigs).values()]
    rig_labels = {
        column: sorted({*names, *(name for rig in in_rigs for name in rig.get(column, ()))})
        for column, names in used.items()
    }
    count = np.prod([len(names) for names in rig_labels.values()])
    combinations = product(*(rig_labels if count <= MOST_LABELS else used).values())
    return [{}, *(dict(zip(used, names, strict=True)) for names in combinations), {}]


def with_labels(
    rigs: Rigs, table: ObservationTable, rows: Indices, possible: Sequence[Labels], labels: Indices
) -> ObservationTable:
    """Return the table with the possible labels of these numbers in some rows."""
    number = np.zeros(len(table), dtype=np.intp)
    number[rows] = labels
    names = {column: np.array([label.get(column, "") for label in possible])[number] for column in possible[1]}
    return renamed(rigs, table, names)


def renamed(rigs: Rigs, table: ObservationTable, names: Mapping[str, NDArray[Any]]) -> ObservationTable:
    """Return the table with other names (n,) in some columns, where rows have one and get one.

    A length follows from its bar.
    """
    names = {column: np.where((table[column] == "") | (new == ""), table[column], new) for column, new in names.items()}
    if "bar" not in names or (names["bar"] == table.bar).all():
        return table.replace(**names)
    value = table.value.copy()
    for row in np.flatnonzero(names["bar"] != table.bar).tolist():
        bars = rigs_by_name(rigs)[str(table.rig[row])].bars
        labelled, bar = bars[str(table.bar[row])], bars[str(names["bar"][row])]
        value[row] = bar.zero + bar.gain * (value[row] - labelled.zero) / labelled.gain
    return table.replace(**names, value=value)


def scores(
    inputs: Alternative,
    table: ObservationTable,
    labels: Indices,
    possible: Sequence[Labels],
    every_subset: bool,
) -> Floats | None:
    """Return the robust log-likelihood (l, n) of each row under each possible label, the last of which is none.

    It is that of the best robust fit of rows with ``labels``. None without any fit.
    """
    all_rows = np.arange(len(table))
    current, used = with_labels(inputs.rig, table, all_rows, possible, labels), labels < len(possible) - 1
    best, scale = -np.inf, 1.0
    parameters: Mapping[str, float] | None = None
    start: Mapping[str, float] = {}
    for rows in islice(subsets(current, np.flatnonzero(used)), None if every_subset else 1):
        try:
            problem, columns, _ = trial_problem(inputs.chain, inputs.rig, current.select(rows), inputs.free)
            x = fit(problem, columns, problem.at(start), idle_options(STEPS)._replace(loss=Loss.CAUCHY)).x
            fitted = dict(zip(problem.names, x.tolist(), strict=True))
            start = start or fitted
            square = misfit(inputs.chain, inputs.rig, current.select(used), fitted)
        except (ProblemError, np.linalg.LinAlgError):
            continue
        size, value = split(square)
        if value > best:
            best, scale, parameters = value, size, fitted
    if parameters is None:
        return None
    out = np.full((len(possible), len(table)), IMPOSSIBLE)
    for number, names in enumerate(possible[:-1]):
        valid = _valid(inputs.rig, table, names)
        renamed_rows = with_labels(inputs.rig, table, all_rows, possible, np.full(all_rows.size, number)).select(valid)
        out[number, valid] = robust_likelihood(misfit(inputs.chain, inputs.rig, renamed_rows, parameters), scale)
    out[-1] = robust_likelihood(np.array(APART**2), 1.0)
    return out


def split(square: Floats) -> tuple[float, float]:
    """Return the size of the residuals of at least half of the rows, the smaller ones, and the likelihood of all.

    The others have a variance of their own, so that rows with wrong labels count alike however far off they are.
    """
    ordered = np.maximum(np.sort(square), FLOOR**2)
    k = np.arange(ordered.size // 2, ordered.size)
    total = np.cumsum(ordered)
    cost = k * np.log(total[k - 1] / k) + (ordered.size - k) * np.log((total[-1] - total[k - 1]) / (ordered.size - k))
    good = k[np.argmin(cost)]
    return 1.4826 * float(np.sqrt(np.median(ordered[:good]))), -0.5 * float(cost.min())


def _valid(rigs: Rigs, table: ObservationTable, labels: Labels) -> NDArray[np.bool_]:
    """Return the rows (n,) whose rig has these names."""
    out = np.ones(len(table), dtype=bool)
    for name, rig in rigs_by_name(rigs).items():
        names = rig_names(rig)
        if any(label not in names.get(column, (label,)) for column, label in labels.items()):
            out &= table.rig != name
    return out


def subsets(table: ObservationTable, rows: Indices) -> Iterator[Indices]:
    """Return some of the rows; then without each mount, and without each half."""
    mount = mountings(table)[rows]
    half = rows >= len(table) // 2
    masks = [np.ones(rows.size, dtype=bool), half, ~half]
    numbers = np.unique(mount)
    if 3 < numbers.size <= MOST_MOUNTS:
        masks += [mount != number for number in numbers]
    for mask in masks:
        yield rows[mask][thinned(int(mask.sum()), MOST_ROWS)]


def robust_likelihood(square: Floats, scale: float) -> Floats:
    """Return the robust log-likelihood (n,) of rows by the squares of their residuals."""
    return np.asarray(-1.5 * np.log1p(square / (2.0 * scale**2)))


def best_labels(score: Floats) -> tuple[Indices, list[WrongLabels]]:
    """Return labels (n,) by their ``score`` (l, n), and the runs in which they are not 0, the rows' own.

    The last label stands for none, which fewer than LEAST_APART rows do not get. A run begins at any of n rows and has
    any of l labels, so that one of them gains ``sure`` by chance with a probability of at most LEVEL.
    """
    sure, row = np.log(score.size / LEVEL), np.arange(score.shape[1])
    labels, allowed, none = np.zeros_like(row), list(range(len(score))), len(score) - 1
    for _ in range(MOST_RUNS):
        gain, first, last, label = max((*best_run(score[i] - score[labels, row] - PRICE), i) for i in allowed)
        if gain < sure:
            break
        if label != none:
            labels[first:last] = label
        elif last - first < LEAST_APART:
            allowed.remove(none)
        else:  # a few rows at an end of the table are no set-up of their own
            labels[0 if first < LEAST_APART else first : None if last > labels.size - LEAST_APART else last] = none
    gains = score[labels, row] - score[0] - PRICE
    edges = pairwise([0, *np.flatnonzero(np.diff(labels)) + 1, labels.size])
    return labels, [WrongLabels(a, b, int(labels[a]), float(gains[a:b].sum())) for a, b in edges if labels[a]]


def best_run(gain: Floats) -> tuple[float, int, int]:
    """Return the greatest sum of consecutive rows' gains (n,), the first of them and the one after the last."""
    upto = np.concatenate([[0.0], np.cumsum(gain)])
    lowest = np.minimum.accumulate(upto)
    last = int(np.argmax(upto - lowest))
    first = int(np.argmin(upto[: last + 1]))
    return float(upto[last] - upto[first]), first, last
