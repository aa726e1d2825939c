"""Rows that were measured with another part than their label says.

After a robust fit, each possible pair of labels has a robust log-likelihood in each row, −1.5 log(1 + r²/2s²), with s the
median residual. The run of rows in which another pair gains most over the given one, less PRICE a row, is relabelled, and
the next is sought, until none gains SURE. The fit is repeated with the new labels as long as they change. One wrong mount
can pull a fit along with it: the fits without each mount compete with that of all rows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.errors import ProblemError
from truearm.estimate.fit import fit
from truearm.estimate.measured_order import mountings
from truearm.estimate.solution import Options
from truearm.estimate.solvers import Loss
from truearm.estimate.trial_fit import misfit, trial_problem
from truearm.kinds.registry import kinds
from truearm.kinds.table import ObservationTable
from truearm.model.chain import Chain
from truearm.types import Floats, Indices, Rigs

SURE = 12.0  # nats that a run must gain
PRICE = 0.3  # nats a row, for being relabelled at all
MOST_RUNS = 12
MOST_MOUNTS = 40  # each of which is left out in turn
ROUNDS = 3
FLOOR = 0.05  # of a drawing's tolerance: residuals are not taken for more exact


class WrongLabels(NamedTuple):
    """Rows [first, last) of the table that fit other labels, by column, by ``gain`` nats; other labels nearly as good."""

    first: int
    last: int
    labels: Mapping[str, str]
    gain: float
    rivals: tuple[Mapping[str, str], ...]


class Relabelled(NamedTuple):
    """A table with its labels corrected, and what was corrected."""

    table: ObservationTable
    runs: tuple[WrongLabels, ...]


def relabelled(chain: Chain, rig: Rigs, table: ObservationTable, free: NDArray[np.bool_]) -> Relabelled:
    """Return the table with its labels as the rows fit best; ``free`` (p,) are the robot's parameters to fit.

    The runs are empty if the given labels fit, or if more than half of the rows would change.
    """
    possible = labels_of(table)
    original, current = own_labels(table, possible), table
    score = np.zeros((len(possible), len(table)))
    labels = original
    for _ in range(ROUNDS):
        score = scores(chain, rig, current, free, possible)
        changed, _ = best_labels(score, original)
        if (changed == labels).all():
            break
        labels, current = changed, with_labels(table, [possible[i] for i in changed])
    labels, runs = best_labels(score, original)
    if not runs or (labels != original).mean() > 0.5:
        return Relabelled(table, ())
    out = []
    for first, last, label, gain in runs:
        totals = score[:, first:last].sum(axis=1)
        rivals = [i for i in np.flatnonzero(totals > totals[label] - np.log(100.0)).tolist() if i != label]
        out.append(WrongLabels(first, last, possible[label], gain, tuple(possible[i] for i in rivals)))
    return Relabelled(current, tuple(out))


def labels_of(table: ObservationTable) -> list[Mapping[str, str]]:
    """Return all combinations of labels that rows of the table have, by column."""
    columns = [column for name in np.unique(table.kind) for column in kinds()[str(name)].labels]
    names_used = {column: [str(name) for name in np.unique(table[column]) if name] for column in columns}
    names_used = {column: names for column, names in names_used.items() if names}
    return [dict(zip(names_used, names, strict=True)) for names in product(*names_used.values())]


def own_labels(table: ObservationTable, possible: Sequence[Mapping[str, str]]) -> Indices:
    """Return which (n,) of the possible labels each row has; the first for rows without any."""
    out = np.zeros(len(table), dtype=np.intp)
    for number, labels in enumerate(possible):
        out[np.all([table[column] == name for column, name in labels.items()], axis=0)] = number
    return out


def with_labels(table: ObservationTable, labels: Sequence[Mapping[str, str]]) -> ObservationTable:
    """Return the table with labels (n), in rows that have some."""
    names_by_column = {column: np.array([row[column] for row in labels]) for column in labels[0]}
    return table.replace(
        **{column: np.where(table[column] == "", "", names) for column, names in names_by_column.items()}
    )


def scores(
    chain: Chain,
    rig: Rigs,
    table: ObservationTable,
    free: NDArray[np.bool_],
    possible: Sequence[Mapping[str, str]],
) -> Floats:
    """Return the robust log-likelihood (l, n) of each row with each of the labels, by the best of the robust fits."""
    mount = mountings(table)
    numbers = np.unique(mount)
    without = [np.ones(len(table), dtype=bool)]
    if 3 < numbers.size <= MOST_MOUNTS:
        without += [mount != number for number in numbers]
    best, total = np.zeros(0), -np.inf
    parameters: Mapping[str, float] = {}
    for rows in without:
        try:
            problem, columns, _ = trial_problem(chain, rig, table.select(rows), free)
        except ProblemError:
            continue
        x = fit(problem, columns, problem.start, Options(max_iterations=8, loss=Loss.CAUCHY)).x
        trial = dict(zip(problem.names, x.tolist(), strict=True))
        square = misfit(chain, rig, table, trial)
        if (value := float(likelihood(square, scale_of(square)).sum())) > total:
            best, total, parameters = square, value, trial
    scale = scale_of(best)
    squares = [misfit(chain, rig, with_labels(table, [labels] * len(table)), parameters) for labels in possible]
    return np.stack([likelihood(square, scale) for square in squares])


def scale_of(square: Floats) -> float:
    """Return the size of usual residuals from their squares (n,), in tolerances of a drawing."""
    return max(1.4826 * float(np.sqrt(np.nanmedian(square))), FLOOR)


def likelihood(square: Floats, scale: float) -> Floats:
    """Return the robust log-likelihood (n,) of rows by the squares of their residuals."""
    return np.asarray(-1.5 * np.log1p(square / (2.0 * scale**2)))


def best_labels(score: Floats, original: Indices) -> tuple[Indices, list[tuple[int, int, int, float]]]:
    """Return labels (n,) and the runs in which they are not the ``original`` ones: first row, after last, label, gain."""
    labels, runs = original.copy(), list[tuple[int, int, int, float]]()
    each = np.arange(original.size)
    while len(runs) < MOST_RUNS:
        candidates = [(*best_run(gains - score[labels, each] - PRICE), number) for number, gains in enumerate(score)]
        gain, first, last, label = max(candidates)
        if gain < SURE:
            break
        labels[first:last] = label
        runs.append((first, last, label, gain))
    return labels, sorted(runs)


def best_run(gain: Floats) -> tuple[float, int, int]:
    """Return the greatest sum of consecutive rows' gains (n,), the first of them and the one after the last."""
    upto = np.concatenate([[0.0], np.cumsum(gain)])
    least = np.minimum.accumulate(upto)
    last = int(np.argmax(upto - least))
    first = int(np.argmin(upto[: last + 1]))
    return float(upto[last] - upto[first]), first, last
