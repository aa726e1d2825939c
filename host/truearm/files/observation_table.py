"""Tables of observations: CSV with the units in the column names, one row an observation (docs/table-format.md).

A table is checked in three layers: the text is CSV of equal rows (``read_cells``), its header names known quantities with
units (``read_header``), its cells are what their column and the row's kind demand (``parse_table``). Every complaint names
the file, the row (as an editor or a spreadsheet counts, the header being row 1) and the column.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from truearm.errors import TableError
from truearm.files.csv_cells import Row, identifiers, numbers, read_cells, together
from truearm.files.disk import read_text, write_atomic
from truearm.files.observation_columns import IDS, Column, base_unit, joint_columns, rate_columns, read_header, shown
from truearm.types import Floats, ObservationTable, Rig

MAX_BYTES = 16 * 2**20
# What a kind must have and what else it may have; ANY is what every row may carry. The rest it must leave empty.
NEEDS = {
    "ball_bar": ("bar", "chuck", "sphere", "length"),
    "seat": ("place", "socket"),
    "line": ("line", "point"),
    "position": ("tracker", "point"),
    "pose": ("tracker", "point", "turn"),
    "plane": ("plane",),
}
MAY = {
    "ball_bar": (),
    "seat": ("sphere",),
    "line": ("target", "spread"),
    "position": ("target", "spread"),
    "pose": ("target", "spread"),
    "plane": ("target", "length"),
}
ANY = ("place", "shell", "rig")
TITLES = {
    "length": "length_mm or length_m",
    "point": "x_mm, y_mm, z_mm (or _m)",
    "turn": "rx_rad, ry_rad, rz_rad (or _deg)",
    "spread": "sx_mm, sy_mm, sz_mm (or _m)",
}
POINT, SPREAD, TURN = ("x", "y", "z"), ("sx", "sy", "sz"), ("rx", "ry", "rz")
# Beyond these a column is in another unit than its name says: ten turns of a joint, a room, a decimetre of noise.
LARGEST = {"rad": 20.0 * math.pi, "m": 100.0}
LARGEST_SIGMA = 0.1
LARGEST_TURN = 2.0 * math.pi  # a rotation vector's length need not pass π


def read_table(path: Path, joint_units: Sequence[str] | None = None) -> ObservationTable:
    """Read a CSV table of observations.

    ``joint_units``: "rad" or "m" for each joint of the robot; given, the joint columns must match it.
    Raises TableError with file, row and column.
    """
    return parse_table(read_text(path, MAX_BYTES, TableError), str(path), joint_units)


def parse_table(text: str, name: str, joint_units: Sequence[str] | None = None) -> ObservationTable:
    """Parse the text of a table; ``name`` stands for the file in messages and in ``source``. See ``read_table``."""
    header, rows = read_cells(text, name)
    columns = read_header(header, name)
    joints = joint_columns(columns, joint_units, name)
    if not rows:
        raise TableError(f"{name}: has a header but no rows of observations")
    kind = _kinds(rows, columns["kind"], name)
    ids = {id_: identifiers(rows, columns.get(id_), name) for id_ in IDS}
    value = numbers(rows, columns.get("length"), name, LARGEST["m"])
    sigma = numbers(rows, columns.get("sigma"), name, LARGEST_SIGMA, positive=True)
    xyz = together([numbers(rows, columns.get(k), name, LARGEST["m"]) for k in POINT], rows, "x, y and z", name)
    spread = [numbers(rows, columns.get(k), name, LARGEST_SIGMA, positive=True) for k in SPREAD]
    xyz_sigma = together(spread, rows, "sx, sy and sz", name)
    turn = together([numbers(rows, columns.get(k), name, LARGEST_TURN) for k in TURN], rows, "rx, ry and rz", name)
    measured = {"length": ~np.isnan(value), "point": ~np.isnan(xyz[:, 0]), "turn": ~np.isnan(turn[:, 0])}
    measured["spread"] = ~np.isnan(xyz_sigma[:, 0])
    _check_kinds(rows, kind, {**ids, **measured}, name)
    _check_lengths(rows, (kind == "ball_bar") & (value <= 0.0), columns.get("length"), name)
    q = np.stack(
        [numbers(rows, joint, name, LARGEST[base_unit(joint.unit)], required=True) for joint in joints], axis=1
    )
    rates = [numbers(rows, rate, name, LARGEST[base_unit(rate.unit)]) for rate in rate_columns(columns, joints, name)]
    q_rate = together(rates, rows, "the velocities of all joints", name) if rates else np.full_like(q, np.nan)
    source = np.array([f"{name} row {row.number}" for row in rows])
    table = ObservationTable(q, kind, value, sigma, source=source, xyz=xyz, rotation=turn, q_rate=q_rate, **ids)
    return replace(table, xyz_sigma=xyz_sigma)


def _kinds(rows: list[Row], column: Column, name: str) -> np.ndarray:
    for row in rows:
        if row.cells[column.position] not in NEEDS:
            raise TableError(
                f"{name} row {row.number} column kind: {shown(row.cells[column.position])} is no kind of observation; "
                f"use {' or '.join(NEEDS)}"
            )
    return np.array([row.cells[column.position] for row in rows])


def _check_kinds(rows: list[Row], kind: np.ndarray, cells: dict[str, np.ndarray], name: str) -> None:
    """Each row has the cells its kind needs and leaves empty those that would say something else."""
    leaves = {k: [q for q in cells if q not in (*NEEDS[k], *MAY[k], *ANY)] for k in NEEDS}
    for i, row in enumerate(rows):
        where = f"{name} row {row.number}"
        for quantity in NEEDS[kind[i]]:
            if not cells[quantity][i]:
                raise TableError(f"{where}: a {kind[i]} row needs {_titled(quantity)}, which is empty or missing")
        for quantity in leaves[kind[i]]:
            if cells[quantity][i]:
                raise TableError(f"{where}: a {kind[i]} row has no {_titled(quantity)}; leave that cell empty")


def _check_lengths(rows: list[Row], bad: np.ndarray, column: Column | None, name: str) -> None:
    """A bar has a length; the distance from a plane may be on either side of it."""
    if column is None:
        return
    for i in np.flatnonzero(bad):
        cell = shown(rows[i].cells[column.position])
        raise TableError(f"{name} row {rows[i].number} column {column.name}: {cell} must be greater than 0")


def _titled(quantity: str) -> str:
    return TITLES.get(quantity, f"a {quantity}")


def concatenate(tables: Sequence[ObservationTable]) -> ObservationTable:
    """The rows of several tables one after the other. Raises TableError when their joints differ in number."""
    for table in tables[1:]:
        if table.q.shape[1] != tables[0].q.shape[1]:
            raise TableError(
                f"{table.source[0]}: has {table.q.shape[1]} joints, {tables[0].source[0]} has {tables[0].q.shape[1]}"
            )
    names = [field.name for field in fields(ObservationTable)]
    return ObservationTable(**{name: np.concatenate([getattr(t, name) for t in tables]) for name in names})


def check_against_rig(table: ObservationTable, rig: Rig) -> None:
    """Raise TableError for the first row that names a bar, chuck, sphere, … which the rig does not have.

    Likewise for a socket, or a distance of sockets, that no row of a table with seats has: it would silently do nothing.
    """
    known_things: dict[str, Mapping[str, object]] = {
        **{"bar": rig.bars, "chuck": rig.chucks, "sphere": rig.spheres, "target": rig.targets},
        **{"tracker": rig.trackers, "plane": rig.planes},
        # A rig that lists no lines takes them as they come.
        **({"line": rig.lines} if rig.lines else {}),
    }
    for column, known in known_things.items():
        for identifier, source in zip(getattr(table, column), table.source, strict=True):
            if identifier and identifier not in known:
                names = ", ".join(sorted(known)) or "none; give it with --rig"
                raise TableError(
                    f"{source} column {column}: {shown(str(identifier))} is not in the rig (it has {names})"
                )
    seats = table.kind == "seat"
    touching = np.isin(table.kind, ("line", "position", "pose", "plane"))
    for column, of_kind, points in (("sphere", seats, rig.spheres), ("target", touching, rig.targets)):
        nameless = np.flatnonzero(of_kind & (getattr(table, column) == ""))
        if nameless.size and len(points) > 1:
            names = ", ".join(sorted(points))
            raise TableError(f"{table.source[nameless[0]]} column {column}: is empty; name one of the rig's ({names})")
    used = set(zip(table.place[seats].tolist(), table.socket[seats].tolist(), strict=True))
    for place, socket in rig.sockets if used else ():
        if (place, socket) not in used:
            raise TableError(f"the rig's socket {socket} at place {place!r} is of no use: no row is seated in it")
    for distance in rig.socket_distances if used else ():
        if not any({(place, socket) for socket in distance.sockets} <= used for place, _ in used):
            sockets = ", ".join(sorted({socket for _, socket in used})[:12])
            raise TableError(
                f"the rig's socket distance {' to '.join(distance.sockets)} is of no use: "
                f"the seats are in sockets {sockets}, and no place has both"
            )


def format_table(table: ObservationTable, joint_units: Sequence[str]) -> str:
    """The text of a table, in rad and m so that every number comes back bit for bit; ``source`` is not written."""
    columns = table_columns(table, joint_units)
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    cells = [map(_written, c.tolist()) if c.dtype.kind == "f" else c.tolist() for c in columns.values()]
    writer.writerows(zip(*cells, strict=True))
    return text.getvalue()


def table_columns(table: ObservationTable, joint_units: Sequence[str]) -> dict[str, Any]:
    """Titles and values of the columns that ``format_table`` writes; ``source`` is not among them."""
    ids = {name: getattr(table, name) for name in IDS if np.any(getattr(table, name) != "")}
    return {"kind": table.kind, **_number_columns(table, joint_units), **ids}


def _number_columns(table: ObservationTable, joint_units: Sequence[str]) -> dict[str, Floats]:
    """Titles and values of all columns of numbers; but for the joints only those that have any."""
    joints = {f"q{i}_{unit}": table.q[:, i - 1] for i, unit in enumerate(joint_units, start=1)}
    others = {"length_m": table.value, "sigma_m": table.sigma}
    others |= {f"{k}_m": table.xyz[:, i] for i, k in enumerate(POINT)}
    others |= {f"{k}_m": table.xyz_sigma[:, i] for i, k in enumerate(SPREAD)}
    others |= {f"{k}_rad": table.rotation[:, i] for i, k in enumerate(TURN)}
    others |= {f"qd{i}_{unit}_s": table.q_rate[:, i - 1] for i, unit in enumerate(joint_units, start=1)}
    return joints | {title: column for title, column in others.items() if not np.isnan(column).all()}


def _written(number: float) -> str:
    return "" if math.isnan(number) else repr(float(number))


def looks_like_table(head: bytes) -> bool:
    """Whether a file that begins so is a table of observations, or empty."""
    return not head.strip() or b"kind" in head.split(b"\n", 1)[0]


def write_table(path: Path, table: ObservationTable, joint_units: Sequence[str]) -> None:
    """Write a table that ``read_table`` reads back exactly (but for ``source``). Raises InputError."""
    write_atomic(path, format_table(table, joint_units))
