"""Circumstances of rows that an error may follow: time, the box's temperature, each joint's direction, the payload.

Also which rows belong together: one session, one mounting, one pose.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple, assert_never

import numpy as np
from numpy.typing import NDArray

from truearm.errors import ProblemError
from truearm.kinds.registry import kinds
from truearm.kinds.table import ObservationTable
from truearm.model.chain import Chain
from truearm.results import DriftWith
from truearm.types import Floats, Indices, Payload, Rigs, rigs_by_name

SAME_POSE = 1e-3  # rad or m: joint readings that differ by less belong to one pose
NOWHERE = np.zeros(0)  # motions of what is not a joint
LEAST_DIRECTED = 5  # rows that a joint must have reached in either direction
LARGEST = 2**31  # number of the values in a column; the product of two fits into 64 bits


class Circumstances(NamedTuple):
    """Circumstances in which n rows were measured: times [s] and temperatures [°C] (n,), NaN where unknown.

    For each joint by its name, ``direction`` (n,) is that in which it last moved, −1 or 1, and ``move`` (n,) [rad or m]
    how far it moved from the pose before; 0 where unknown. ``q`` (n, j) are the readings, ``session`` (n,) numbers.
    """

    time: Floats
    temperature: Floats
    direction: Mapping[str, Floats]
    move: Mapping[str, Floats]
    q: Floats
    session: Indices

    @classmethod
    def of(cls, table: ObservationTable, chain: Chain) -> Circumstances:
        """Return those of the rows of a robot's table."""
        joints, session = [joint.name for joint in chain.joints], sessions(table)
        direction, move = (dict(zip(joints, motion.T, strict=True)) for motion in last_motions(table, session))
        return cls(table.time, table.temperature, direction, move, table.q, session)

    def __len__(self) -> int:
        return int(self.time.size)

    def during(self, what: str, drift: DriftWith, first: int, last: int) -> Floats | None:
        """Return the variable that an error of ``what`` is linear in, for some rows; None if it is unknown or constant.

        If the times are unknown, the order of the rows is used. Directions are known if enough rows have either.
        """
        match drift:
            case DriftWith.TIME:
                along = self.time[first:last]
                if not np.isfinite(along).all():
                    along = np.arange(float(last - first))
            case DriftWith.TEMPERATURE:
                along = self.temperature[first:last]
            case DriftWith.DIRECTION | DriftWith.MOVE:
                if drift is DriftWith.MOVE:
                    along = self.move.get(what, NOWHERE)[first:last]
                else:  # the link lags a reading by backlash
                    along = -self.direction.get(what, NOWHERE)[first:last]
                if min((along < 0.0).sum(), (along > 0.0).sum()) < LEAST_DIRECTED:
                    return None
            case never:
                assert_never(never)
        return along if np.isfinite(along).all() and np.ptp(along) > 0.0 else None


def last_motions(table: ObservationTable, session: Indices) -> tuple[Floats, Floats]:
    """Return the direction (n, j) in which each joint last moved before each row, and how far (n, j) [rad or m].

    Directions are −1 or 1, 0 where unknown: the ``side`` of the rows if any is known. In other tables the joints are
    taken to have moved straight from the pose before, and a joint that did not move keeps its direction. Motions are
    those from the pose before in the same ``session`` (n,), 0 where unknown.
    """
    rows = np.arange(len(table))
    first = np.diff(session, prepend=-1) != 0
    began = np.flatnonzero(first)[session]
    move = np.zeros_like(table.q)  # from the row before
    np.subtract(table.q[1:], table.q[:-1], out=move[1:])
    move[first] = 0.0
    for of_joint in move.T:
        of_joint[np.abs(of_joint) <= SAME_POSE] = 0.0
    direction = table.side
    if np.isfinite(direction).any():
        direction = np.nan_to_num(direction, nan=0.0)
    else:
        direction = np.zeros(move.shape)
        for toward, of_joint in zip(direction.T, move.T, strict=True):
            last = np.maximum.accumulate(np.where(of_joint == 0.0, -1, rows))
            toward[:] = np.where(last > began, np.sign(of_joint[last]), 0.0)
    last = np.maximum.accumulate(np.where(move.any(axis=1), rows, -1))
    for of_joint in move.T:
        of_joint[:] = np.where(last > began, of_joint[last], 0.0)
    return direction, move


def sessions(table: ObservationTable) -> Indices:
    """Return numbers (n,) of the files that rows came from, in order: consecutive rows with one file name and rig."""
    # Examples of sources: "poses.csv row 17", "monday.mcap dwell 3", "monday.mcap pass 2.7", "table[16]".
    without_number = np.strings.rstrip(table.source, "0123456789.]")
    numbered = np.strings.endswith(without_number, " ") | np.strings.endswith(without_number, "[")
    names = np.where(numbered, without_number, table.source)
    number = runs(names)
    first = np.flatnonzero(np.diff(number, prepend=-1))
    files = np.array([re.sub(r"(\s*\w+ |\[)$", "", name) for name in names[first].tolist()], dtype=np.str_)
    return runs(files[number], table.rig)


def runs(*columns: NDArray[np.str_]) -> Indices:
    """Return how often (n,) any of the columns has changed before each row."""
    changed = np.zeros(max(len(columns[0]) - 1, 0), dtype=bool)
    for column in columns:
        changed |= column[1:] != column[:-1]
    return np.concatenate([[0], np.cumsum(changed)])[: len(columns[0])]


def payloads_of(rig: Rigs, table: ObservationTable) -> list[Payload]:
    """Return the payload of each row (n): the row's own, otherwise that of its rig.

    Raises ProblemError for a negative mass.
    """
    mass = table.payload
    bad = np.flatnonzero(mass < 0.0)
    if bad.size:
        raise ProblemError(f"{table.source[bad[0]]}: a payload of {mass[bad[0]]:g} kg; give 0 kg (no payload) or more")
    of_rig = {name: Payload(named.payload, named.payload_centre) for name, named in rigs_by_name(rig).items()}
    return [
        of_rig[str(name)] if np.isnan(m) else Payload(float(m), (x, y, z))
        for name, m, (x, y, z) in zip(table.rig, mass, np.nan_to_num(table.payload_centre).tolist(), strict=True)
    ]


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
    """Return how the ``rows`` (n,) of a robot's table were measured.

    Rows of a table are in the order of measurement.
    """
    selected, circumstances = table.select(rows), Circumstances.of(table, chain)
    place = np.unique(selected.place, return_inverse=True)[1] if (selected.place != "").all() else None
    return Measured(np.flatnonzero(rows), circumstances, circumstances.session[rows], mountings(selected), place)


def poses(table: ObservationTable) -> Indices:
    """Return numbers (n,) of the rows' poses (rows of equal joint readings), in order of first appearance."""
    with np.errstate(invalid="ignore"):  # a reading that is not a number is reported where the problem is built
        first, pose = first_alike(np.rint(table.q / SAME_POSE).astype(np.int64).T)
    order = np.empty_like(first)
    order[np.argsort(first)] = np.arange(first.size)
    return order[pose]


def first_alike(columns: Iterable[NDArray[Any]]) -> tuple[Indices, Indices]:
    """Return the first row of each combination of values in some columns (n,), and the number (n,) of each row's.

    Combinations are in sorted order; NaN equals NaN. Column by column this is faster than unique rows, much so where
    one column has the same value in all rows, or a different one in each. Numbers of several columns are joined before
    they are sorted.
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
    """Return numbers (n,) of the values in a column in sorted order, from 0 to below a count.

    They have gaps where the column has integers.
    """
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
