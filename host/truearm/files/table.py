"""Tables of observations: CSV with the units in the column names, one row an observation (docs/table-format.md).

A table is checked in three layers: the text is CSV of equal rows (``_cells``), its header names known quantities with
units (``read_header``), its cells are what their column and the row's kind demand (``parse_table``). Every complaint names
the file, the row (as an editor or a spreadsheet counts, the header being row 1) and the column.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Sequence
from dataclasses import fields
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from truearm.errors import TableError
from truearm.files.columns import IDS, Column, base_unit, joint_columns, read_header, shown
from truearm.files.disk import read_text, write_atomic
from truearm.types import Floats, ObservationTable, Rig

MAX_BYTES = 16 * 2**20
MAX_ROWS = 200_000  # 250 times the paper's grid of 800 poses
MAX_COLUMNS = 200
MAX_CELL = 200

SCALE = {"rad": 1.0, "deg": math.pi / 180.0, "m": 1.0, "mm": 1e-3}
# What a kind must have and must leave empty; place and shell are groups that any row may carry.
NEEDS = {"ball_bar": ("bar", "chuck", "sphere"), "seat": ("place", "socket")}
LEAVES = {"ball_bar": ("socket",), "seat": ("bar", "chuck", "length")}
# Beyond these a column is in another unit than its name says: ten turns of a joint, a room, a decimetre of noise.
LARGEST = {"rad": 20.0 * math.pi, "m": 100.0}
LARGEST_SIGMA = 0.1

# No dots: the names of parameters, socket.<place>.<socket>.x, are made of identifiers.
_ID = re.compile(r"[\w-]{1,64}")
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)


class _Row(NamedTuple):
    """A row that is not blank, and where an editor shows it; the header is row 1."""

    number: int
    cells: list[str]


def read_table(path: Path, joint_units: Sequence[str] | None = None) -> ObservationTable:
    """Read a CSV table of observations.

    ``joint_units``: "rad" or "m" for each joint of the robot; given, the joint columns must match it.
    Raises TableError with file, row and column.
    """
    return parse_table(read_text(path, MAX_BYTES, TableError), str(path), joint_units)


def parse_table(text: str, name: str, joint_units: Sequence[str] | None = None) -> ObservationTable:
    """Parse the text of a table; ``name`` stands for the file in messages and in ``source``. See ``read_table``."""
    header, rows = _cells(text, name)
    columns = read_header(header, name)
    joints = joint_columns(columns, joint_units, name)
    if not rows:
        raise TableError(f"{name}: has a header but no rows of observations")
    kind = _kinds(rows, columns["kind"], name)
    ids = {id_: _identifiers(rows, columns.get(id_), name) for id_ in IDS}
    value = _numbers(rows, columns.get("length"), name, LARGEST["m"], positive=True)
    sigma = _numbers(rows, columns.get("sigma"), name, LARGEST_SIGMA, positive=True)
    _check_kinds(rows, kind, {**ids, "length": ~np.isnan(value)}, name)
    q = [_numbers(rows, joint, name, LARGEST[base_unit(joint.unit)], required=True) for joint in joints]
    source = np.array([f"{name} row {row.number}" for row in rows])
    return ObservationTable(np.stack(q, axis=1), kind, value, sigma, source=source, **ids)


def _cells(text: str, name: str) -> tuple[list[str], list[_Row]]:
    """Header and rows as stripped text, all of one width; blank lines are passed over."""
    reader = csv.reader(io.StringIO(text, newline=None), strict=True)
    filled = (_Row(reader.line_num, [cell.strip() for cell in cells]) for cells in reader if cells)
    try:
        rows = list(islice(filled, MAX_ROWS + 2))
    except csv.Error as exc:
        raise TableError(f"{name} row {reader.line_num}: is not CSV: {exc}") from exc
    if not rows:
        raise TableError(f"{name}: is empty; a table begins with a header row such as kind,q1_rad,...,length_mm")
    header = rows[0].cells
    if len(header) == 1 and re.search(r"[;\t]", header[0]):
        raise TableError(f"{name}: columns are separated by ';' or tabs; separate them by commas")
    if len(header) > MAX_COLUMNS:
        raise TableError(f"{name}: has {len(header)} columns; the most is {MAX_COLUMNS}")
    if len(rows) > MAX_ROWS + 1:
        raise TableError(f"{name}: has more than {MAX_ROWS} rows; split it or thin it out")
    for row in rows[1:]:
        if len(row.cells) != len(header):
            raise TableError(f"{name} row {row.number}: has {len(row.cells)} cells, the header has {len(header)}")
    return header, rows[1:]


def _kinds(rows: list[_Row], column: Column, name: str) -> np.ndarray:
    for row in rows:
        if row.cells[column.position] not in NEEDS:
            raise TableError(
                f"{name} row {row.number} column kind: {shown(row.cells[column.position])} is no kind of observation; "
                f"use {' or '.join(NEEDS)}"
            )
    return np.array([row.cells[column.position] for row in rows])


def _identifiers(rows: list[_Row], column: Column | None, name: str) -> np.ndarray:
    if column is None:
        return np.full(len(rows), "", dtype="U1")
    for row in rows:
        cell = row.cells[column.position]
        if cell and not _ID.fullmatch(cell):
            raise TableError(
                f"{name} row {row.number} column {column.name}: {shown(cell)} is no identifier; "
                "use up to 64 letters, digits, '-' and '_'"
            )
    return np.array([row.cells[column.position] for row in rows])


def _numbers(
    rows: list[_Row],
    column: Column | None,
    name: str,
    largest: float,
    *,
    positive: bool = False,
    required: bool = False,
) -> Floats:
    """A column of numbers in SI units; NaN where the column or, unless ``required``, a cell is empty."""
    if column is None:
        return np.full(len(rows), np.nan)
    scale = SCALE[column.unit]
    numbers = np.empty(len(rows))
    for i, row in enumerate(rows):
        cell = row.cells[column.position]
        where = f"{name} row {row.number} column {column.name}"
        numbers[i] = np.nan if not cell and not required else scale * _number(cell, where)
        if abs(numbers[i]) > largest:
            raise TableError(f"{where}: {shown(cell)} is too large for {column.unit}; is the column in another unit?")
        if positive and numbers[i] <= 0.0:
            raise TableError(f"{where}: {shown(cell)} must be greater than 0")
    return numbers


def _number(cell: str, where: str) -> float:
    if not cell:
        raise TableError(f"{where}: is empty; every row needs a number here")
    if cell.lower().lstrip("+-") in ("nan", "inf", "infinity"):
        raise TableError(f"{where}: {cell} is not a finite number; leave out rows without a reading")
    # float() would take "1_000" and digits of other scripts; a table with them was not written as numbers.
    if len(cell) > MAX_CELL or not _NUMBER.fullmatch(cell):
        raise TableError(f"{where}: {shown(cell)} is not a number")
    return float(cell)


def _check_kinds(rows: list[_Row], kind: np.ndarray, cells: dict[str, np.ndarray], name: str) -> None:
    """Each row has the cells its kind needs and leaves empty those that would say something else."""
    for i, row in enumerate(rows):
        where = f"{name} row {row.number}"
        needs = (*NEEDS[kind[i]], "length") if kind[i] == "ball_bar" else NEEDS[kind[i]]
        for quantity in needs:
            if not cells[quantity][i]:
                raise TableError(f"{where}: a {kind[i]} row needs {_titled(quantity)}, which is empty or missing")
        for quantity in LEAVES[kind[i]]:
            if cells[quantity][i]:
                raise TableError(f"{where}: a {kind[i]} row has no {_titled(quantity)}; leave that cell empty")


def _titled(quantity: str) -> str:
    return "length_mm or length_m" if quantity == "length" else f"a {quantity}"


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
    """Raise TableError for the first row that names a bar, chuck or sphere which the rig does not have.

    Likewise for a socket distance of the rig that no place of a table with seats has: it would silently do nothing.
    """
    for column, known in (("bar", rig.bars), ("chuck", rig.chucks), ("sphere", rig.spheres)):
        for identifier, source in zip(getattr(table, column), table.source, strict=True):
            if identifier and identifier not in known:
                names = ", ".join(sorted(known)) or "none; give it with --rig"
                raise TableError(
                    f"{source} column {column}: {shown(str(identifier))} is not in the rig (it has {names})"
                )
    seats = table.kind == "seat"
    nameless = np.flatnonzero(seats & (table.sphere == ""))
    if nameless.size and len(rig.spheres) > 1:
        names = ", ".join(sorted(rig.spheres))
        raise TableError(f"{table.source[nameless[0]]} column sphere: is empty; name one of the rig's ({names})")
    used = set(zip(table.place[seats].tolist(), table.socket[seats].tolist(), strict=True))
    for distance in rig.socket_distances if used else ():
        if not any({(place, socket) for socket in distance.sockets} <= used for place, _ in used):
            sockets = ", ".join(sorted({socket for _, socket in used})[:12])
            raise TableError(
                f"the rig's socket distance {' to '.join(distance.sockets)} is of no use: "
                f"the seats are in sockets {sockets}, and no place has both"
            )


def format_table(table: ObservationTable, joint_units: Sequence[str]) -> str:
    """The text of a table, in rad and m so that every number comes back bit for bit; ``source`` is not written."""
    ids = [name for name in IDS if np.any(getattr(table, name) != "")]
    measured = [
        name for name, values in (("value", table.value), ("sigma", table.sigma)) if not np.all(np.isnan(values))
    ]
    titles = {"value": "length_m", "sigma": "sigma_m"}
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    joints = [f"q{i}_{unit}" for i, unit in enumerate(joint_units, start=1)]
    writer.writerow(["kind", *joints, *(titles[name] for name in measured), *ids])
    for i in range(len(table)):
        numbers = [_written(getattr(table, name)[i]) for name in measured]
        writer.writerow(
            [table.kind[i], *map(_written, table.q[i]), *numbers, *(getattr(table, name)[i] for name in ids)]
        )
    return text.getvalue()


def _written(number: float) -> str:
    return "" if math.isnan(number) else repr(float(number))


def looks_like_table(head: bytes) -> bool:
    """Whether a file that begins so is a table of observations, or empty."""
    return not head.strip() or b"kind" in head.split(b"\n", 1)[0]


def write_table(path: Path, table: ObservationTable, joint_units: Sequence[str]) -> None:
    """Write a table that ``read_table`` reads back exactly (but for ``source``). Raises InputError."""
    write_atomic(path, format_table(table, joint_units))
