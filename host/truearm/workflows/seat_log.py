"""Joints of seats in sockets from the arm's own log: the arm rests in the sockets in the order of the rows."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from truearm.disk import read_text, write_atomic
from truearm.errors import Argument, InputError
from truearm.findings import Finding
from truearm.kinds.csv_cells import CsvTable, csv_text, read_cells, read_header
from truearm.kinds.table_file import MAX_BYTES, PAGE, table_titles
from truearm.progress import step
from truearm.record.robots.sources import FileOptions, readings_of_file
from truearm.session.joint_format import parse_lines
from truearm.text import counted
from truearm.types import Floats
from truearm.units import DEG, MM, SUFFIXES

PER_REST = 20  # readings that are looked at in the shortest rest


class Rest(NamedTuple):
    """A time in which no joint moves: begin and end [s] on the controller's clock, and joints (j,) [rad, m]."""

    begin: float
    end: float
    q: Floats


def rests(t: Floats, q: Floats, shortest: float, bounds: Floats) -> list[Rest]:
    """Return the times of at least ``shortest`` [s] in which every joint stays within a range of its bound (j,).

    ``t`` (n,) [s] ascends, ``q`` (n, j). Overlapping times are one rest.
    """
    first_rows = np.unique(np.floor(t * (PER_REST / shortest)), return_index=True)[1]
    t, q = t[first_rows], q[first_rows]
    end = np.searchsorted(t, t + shortest)  # of the window that begins at each reading, the last one in it
    begin = np.flatnonzero(end < len(t))
    windows = np.stack([begin, end[begin] + 1], axis=1).ravel()
    padded = np.concatenate([q, q[-1:]])
    span = (
        np.maximum.reduceat(padded, windows)[::2] - np.minimum.reduceat(padded, windows)[::2] if begin.size else q[:0]
    )
    still = begin[(span <= bounds).all(axis=1)]
    change = np.zeros(len(t), dtype=int)  # between a reading and the next: within a window or not
    np.add.at(change, still, 1)
    np.add.at(change, end[still], -1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], np.cumsum(change) > 0]).astype(int)))
    pairs = zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)
    return [Rest(float(t[i]), float(t[k]), np.median(q[i : k + 1], axis=0)) for i, k in pairs]


@step("reading the log")
def fill_seats(table: Path, source: Path, options: FileOptions, shortest: float, bound: float) -> Finding:
    """Write the joints of each rest in a log into the next row of a table of seats that has none.

    ``shortest`` [s], ``bound`` [rad]. Raises InputError if there are not as many rests as such rows; then nothing is
    written.
    """
    header, rows = read_cells(read_text(table, MAX_BYTES, InputError), str(table))
    joints = CsvTable(str(table), rows, read_header(header, table_titles(), str(table), PAGE)).numbered("q")
    if not joints:
        raise InputError("missing-column", place=str(table), column="q1_rad")
    empty = [row.cells for row in rows if not all(row.cells[joint.position] for joint in joints)]
    lines = [reading.line for reading in readings_of_file(source, options)]
    log = parse_lines(lines, range(len(lines)))
    if log.q.shape[1] != len(joints):
        raise InputError("other-robot", place=source, joints=log.q.shape[1], expected=len(joints))
    units = [SUFFIXES[joint.unit] for joint in joints]
    bounds = np.array([bound if unit.si == "rad" else MM.to_si(DEG.of(bound)) for unit in units])
    stops = rests(log.t, log.q, shortest, bounds)
    if len(stops) != len(empty) or not stops:
        times = [f"{stop.begin:.1f} to {stop.end:.1f} s" for stop in stops]
        counts = f"{counted(len(stops), 'rest')}, and {table} has {counted(len(empty), 'row')} without joints"
        advice = "rest in each socket once, and longer than elsewhere: choose "
        end = f", or delete rows that were not measured. Rests: {', '.join(times) or 'none'}"
        text = f"{source}: has {counts}; {advice}", Argument("rest_s"), " and ", Argument("rest_deg"), end
        raise InputError(*text, rests=times, rows=len(empty))
    for cells, stop in zip(empty, stops, strict=True):
        for joint, unit, value in zip(joints, units, stop.q.tolist(), strict=True):
            cells[joint.position] = f"{unit.of(value):.7g}"
    write_atomic(table, csv_text([header, *(row.cells for row in rows)]))
    durations = [stop.end - stop.begin for stop in stops]
    values = {"place": str(table), "n": len(stops), "shortest": {"s": min(durations)}, "longest": {"s": max(durations)}}
    return Finding("seats-filled", values)
