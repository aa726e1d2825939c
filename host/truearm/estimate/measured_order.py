"""The order in which rows were measured, and which rows belong together: one session, one mounting, one pose."""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import NDArray

from truearm.estimate.systematic_effects import Circumstances
from truearm.estimate.systematic_score import Measured
from truearm.kinds.linearised import Indices
from truearm.kinds.registry import kinds
from truearm.types import ObservationTable

SAME_POSE = 1e-3  # rad or m: joint readings that differ by less belong to one pose


def measured_order(table: ObservationTable, rows: NDArray[np.bool_]) -> Measured:
    """Return how the ``rows`` (n,) of a table were measured; rows of a table are in the order of measurement."""
    some = table.select(rows)
    return Measured(np.flatnonzero(rows), Circumstances.of(table), sessions(some), mountings(some), poses(some))


def poses(table: ObservationTable) -> Indices:
    """Return numbers (n,) of the rows' poses (rows of equal joint readings), in order of first appearance."""
    rounded = np.round(table.q / SAME_POSE)
    _, first, pose = np.unique(rounded, axis=0, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[pose.ravel()]


def sessions(table: ObservationTable) -> Indices:
    """Return numbers (n,) of the files that rows came from, in order: consecutive rows with one file name and rig."""
    # Examples of sources: "poses.csv row 17", "monday.mcap dwell 3", "monday.mcap pass 2.7".
    names = [re.sub(r"\s*\w+ [\d.]+$", "", str(source)) for source in table.source]
    return _runs(np.array(names, dtype=np.str_), table.rig)


def mountings(table: ObservationTable) -> Indices:
    """Return numbers (n,) of the runs of rows with one item mounted, as each kind groups its rows."""
    columns = dict.fromkeys(column for kind in kinds().values() for column in kind.grouped_by)
    return _runs(table.kind, table.rig, table.shell, *(table.column(column) for column in columns))


def _runs(*columns: NDArray[np.str_]) -> Indices:
    """Return how often (n,) any of the columns has changed before each row."""
    changed = np.zeros(max(len(columns[0]) - 1, 0), dtype=bool)
    for column in columns:
        changed |= column[1:] != column[:-1]
    return np.concatenate([[0], np.cumsum(changed)])[: len(columns[0])]
