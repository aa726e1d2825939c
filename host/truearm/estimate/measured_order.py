"""The order in which rows were measured, and which rows belong together: one session, one mounting, one pose."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.estimate.circumstances import SAME_POSE, Circumstances, runs, sessions
from truearm.kinds.registry import kinds
from truearm.kinds.table import ObservationTable
from truearm.model.chain import Chain
from truearm.types import Indices

LARGEST = 2**31  # number of the values in a column; the product of two fits into 64 bits


class Measured(NamedTuple):
    """The circumstances in which n rows were measured, in order."""

    row: Indices  # (n,) in the user's table
    table: Circumstances  # of all rows of that table
    session: Indices  # (n,) numbers; a drift extends over one session
    run: Indices  # (n,) numbers; the same items are mounted during a run
    place: Indices | None  # (n,) numbers; None if not every row has a place

    @property
    def total(self) -> int:
        """Return the number of rows of the user's table."""
        return len(self.table)

    def take(self, kept: Indices) -> Measured:
        """Return the circumstances of some of the rows."""
        place = None if self.place is None else self.place[kept]
        return Measured(self.row[kept], self.table, self.session[kept], self.run[kept], place)

    def in_table(self, first: int, last: int) -> tuple[int, int]:
        """Return the first row and the one after the last in the user's table, from those among these rows."""
        return (int(self.row[first]) if first else 0), (self.total if last == self.row.size else int(self.row[last]))


def measured_order(table: ObservationTable, chain: Chain, rows: NDArray[np.bool_]) -> Measured:
    """Return how the ``rows`` (n,) of a robot's table were measured; rows of a table are in the order of measurement."""
    selected = table.select(rows)
    place = np.unique(selected.place, return_inverse=True)[1] if (selected.place != "").all() else None
    session, run = sessions(selected), mountings(selected)
    return Measured(np.flatnonzero(rows), Circumstances.of(table, chain), session, run, place)


def poses(table: ObservationTable) -> Indices:
    """Return numbers (n,) of the rows' poses (rows of equal joint readings), in order of first appearance."""
    with np.errstate(invalid="ignore"):  # a reading that is not a number is reported where the problem is built
        first, pose = first_alike(np.rint(table.q / SAME_POSE).astype(np.int64).T)
    order = np.empty_like(first)
    order[np.argsort(first)] = np.arange(first.size)
    return order[pose]


def first_alike(columns: Iterable[NDArray[Any]]) -> tuple[Indices, Indices]:
    """Return the first row of each combination of values in some columns (n,), and the number (n,) of each row's.

    Combinations are in sorted order; NaN equals NaN. Column by column this is faster than unique rows, much so where one
    column has the same value in all rows, or a different one in each. Numbers of several columns are joined before they
    are sorted.
    """
    number, count = np.zeros(0, dtype=np.int64), 1
    for column in columns:
        number = number if number.size else np.zeros(column.size, dtype=np.int64)
        if not (column[1:] != column[:-1]).any():
            continue
        code, codes = _codes(column)
        if count * codes > LARGEST**2:
            number = np.unique(number, return_inverse=True)[1]
            count = int(number.max()) + 1
            if count == number.size:
                break
        number, count = number * codes + code, count * codes
    else:
        number = np.unique(number, return_inverse=True)[1]
    first = np.empty(int(number.max(initial=-1)) + 1, dtype=np.intp)
    first[number[::-1]] = np.arange(number.size)[::-1]  # of equal numbers, the last assignment holds
    return first, number


def _codes(column: NDArray[Any]) -> tuple[Indices, int]:
    """Return numbers (n,) of the values in a column in sorted order, from 0 to below a count; gaps where it has integers."""
    if column.dtype.kind == "i":
        low, high = int(column.min()), int(column.max())
        if high - low < LARGEST:
            return column - low, high - low + 1
    code = np.unique(column, return_inverse=True)[1]
    return code, int(code.max()) + 1


def mountings(table: ObservationTable) -> Indices:
    """Return numbers (n,) of the runs of rows with one item mounted, as each kind groups its rows."""
    columns = dict.fromkeys(column for kind in kinds().values() for column in kind.grouped_by)
    return runs(table.kind, table.rig, table.shell, *(table[column] for column in columns))
