"""Tables of observations: CSV with the units in the column names, one row an observation (docs/table-format.md).

A table is checked in three layers: the text is CSV of equal rows (``_cells``), its header names known quantities with
units (``_header``), its cells are what their column and the row's kind demand (``parse_table``). Every complaint names
the file, the row (as an editor or a spreadsheet counts, the header being row 1) and the column.
"""

from __future__ import annotations

import csv
import difflib
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
from truearm.files.disk import read_text, write_atomic
from truearm.types import Floats, ObservationTable, Rig

MAX_BYTES = 16 * 2**20
MAX_ROWS = 200_000  # 250 times the paper's grid of 800 poses
MAX_COLUMNS = 200
MAX_CELL = 200

SCALE = {"rad": 1.0, "deg": math.pi / 180.0, "m": 1.0, "mm": 1e-3}
UNITS = {"q": ("rad", "deg", "m", "mm"), "length": ("m", "mm"), "sigma": ("m", "mm")}
IDS = ("bar", "chuck", "sphere", "socket", "place", "shell")
# What a kind must have and must leave empty; place and shell are groups that any row may carry.
NEEDS = {"ball_bar": ("bar", "chuck", "sphere"), "seat": ("place", "socket")}
LEAVES = {"ball_bar": ("socket",), "seat": ("bar", "chuck", "length")}
# Beyond these a column is in another unit than its name says: ten turns of a joint, a room, a decimetre of noise.
LARGEST = {"rad": 20.0 * math.pi, "m": 100.0}
LARGEST_SIGMA = 0.1

_QUANTITY = re.compile(r"(q[1-9][0-9]{0,2}|length|sigma)(?:_(\w*))?")
# No dots: the names of parameters, socket.<place>.<socket>.x, are made of identifiers.
_ID = re.compile(r"[\w-]{1,64}")
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)


class _Column(NamedTuple):
    name: str
    position: int
    unit: str  # "" for identifiers


class _Row(NamedTuple):
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
    columns = _header(header, name)
    joints = _joint_columns(columns, joint_units, name)
    if not rows:
        raise TableError(f"{name}: has a header but no rows of observations")
    kind = _kinds(rows, columns["kind"], name)
    ids = {id_: _identifiers(rows, columns.get(id_), name) for id_ in IDS}
    value = _numbers(rows, columns.get("length"), name, LARGEST["m"], positive=True)
    sigma = _numbers(rows, columns.get("sigma"), name, LARGEST_SIGMA, positive=True)
    _check_kinds(rows, kind, {**ids, "length": ~np.isnan(value)}, name)
    q = [_numbers(rows, joint, name, LARGEST[_base_unit(joint.unit)], required=True) for joint in joints]
    source = np.array([f"{name} row {row.number}" for row in rows])
    return ObservationTable(np.stack(q, axis=1), kind, value, sigma, source=source, **ids)


def _cells(text: str, name: str) -> tuple[list[str], list[_Row]]:
    """Header and rows as stripped text, all of one width; blank lines are passed over."""
    reader = csv.reader(io.StringIO(text, newline=None), strict=True)
    try:
        rows = [
            _Row(reader.line_num, [cell.strip() for cell in cells]) for cells in islice(reader, MAX_ROWS + 2) if cells
        ]
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


def _header(header: list[str], name: str) -> dict[str, _Column]:
    """Columns by quantity (``kind``, ``q1``, ``length``, ``bar`` …); columns x_… and note are passed over."""
    columns: dict[str, _Column] = {}
    seen: set[str] = set()
    for position, title in enumerate(header):
        where = f"{name} column {position + 1} ({_shown(title)})"
        if title in seen:
            raise TableError(f"{where}: stands twice in the header; keep one")
        seen.add(title)
        if title == "note" or title.startswith("x_"):
            continue
        quantity, unit = _quantity(title, where)
        if quantity in columns:
            raise TableError(f"{where}: {quantity} is given twice, as {columns[quantity].name} too; keep one")
        columns[quantity] = _Column(title, position, unit)
    if "kind" not in columns:
        raise TableError(f"{name}: has no column 'kind' (ball_bar or seat); is the first row a header?")
    return columns


def _quantity(title: str, where: str) -> tuple[str, str]:
    """Quantity and unit of a column's title, or TableError with the title that was probably meant."""
    if title == "kind" or title in IDS:
        return title, ""
    match = _QUANTITY.fullmatch(title)
    if match is None:
        raise TableError(f"{where}: is no known column; {_suggestion(title)}")
    quantity, unit = match.groups()
    known = UNITS[quantity.rstrip("0123456789")]
    if unit is None:
        raise TableError(f"{where}: has no unit; name it {' or '.join(f'{quantity}_{u}' for u in known)}")
    if unit not in known:
        raise TableError(f"{where}: unit {_shown(unit)} is not known; use one of {', '.join(known)}")
    return quantity, unit


def _suggestion(title: str) -> str:
    known = ["kind", *IDS, "length_mm", "length_m", "sigma_mm", "sigma_m", *(f"q{i}_rad" for i in range(1, 8))]
    close = difflib.get_close_matches(title[:MAX_CELL].lower(), known, n=1)
    return f"did you mean {close[0]}?" if close else "begin its name with x_ if it is to be ignored"


def _joint_columns(columns: dict[str, _Column], joint_units: Sequence[str] | None, name: str) -> list[_Column]:
    """The joint columns in joint order, checked against the robot."""
    numbers = sorted(int(quantity[1:]) for quantity in columns if _is_joint(quantity))
    if not numbers:
        raise TableError(f"{name}: has no joint columns; name them q1_rad, q2_rad, ... (or q1_deg, ...)")
    missing = set(range(1, numbers[-1] + 1)) - set(numbers)
    if missing:
        raise TableError(f"{name}: has columns up to q{numbers[-1]} but none for q{min(missing)}")
    joints = [columns[f"q{number}"] for number in numbers]
    if joint_units is None:
        return joints
    if len(joints) != len(joint_units):
        raise TableError(f"{name}: has {len(joints)} joint columns, the robot has {len(joint_units)} joints")
    for joint, unit in zip(joints, joint_units, strict=True):
        if _base_unit(joint.unit) != unit:
            allowed = "rad or deg (it turns)" if unit == "rad" else "m or mm (it slides)"
            raise TableError(f"{name} column {joint.name}: the robot's joint is measured in {allowed}")
    return joints


def _is_joint(quantity: str) -> bool:
    return quantity[0] == "q"


def _base_unit(unit: str) -> str:
    return "rad" if unit in ("rad", "deg") else "m"


def _kinds(rows: list[_Row], column: _Column, name: str) -> np.ndarray:
    for row in rows:
        if row.cells[column.position] not in NEEDS:
            raise TableError(
                f"{name} row {row.number} column kind: {_shown(row.cells[column.position])} is no kind of observation; "
                f"use {' or '.join(NEEDS)}"
            )
    return np.array([row.cells[column.position] for row in rows])


def _identifiers(rows: list[_Row], column: _Column | None, name: str) -> np.ndarray:
    if column is None:
        return np.full(len(rows), "", dtype="U1")
    for row in rows:
        cell = row.cells[column.position]
        if cell and not _ID.fullmatch(cell):
            raise TableError(
                f"{name} row {row.number} column {column.name}: {_shown(cell)} is no identifier; "
                "use up to 64 letters, digits, '-' and '_'"
            )
    return np.array([row.cells[column.position] for row in rows])


def _numbers(
    rows: list[_Row],
    column: _Column | None,
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
            raise TableError(f"{where}: {_shown(cell)} is too large for {column.unit}; is the column in another unit?")
        if positive and numbers[i] <= 0.0:
            raise TableError(f"{where}: {_shown(cell)} must be greater than 0")
    return numbers


def _number(cell: str, where: str) -> float:
    if not cell:
        raise TableError(f"{where}: is empty; every row needs a number here")
    if cell.lower().lstrip("+-") in ("nan", "inf", "infinity"):
        raise TableError(f"{where}: {cell} is not a finite number; leave out rows without a reading")
    # float() would take "1_000" and digits of other scripts; a table with them was not written as numbers.
    if len(cell) > MAX_CELL or not _NUMBER.fullmatch(cell):
        raise TableError(f"{where}: {_shown(cell)} is not a number")
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


def _shown(text: str) -> str:
    return repr(text if len(text) <= 40 else text[:37] + "...")


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
                    f"{source} column {column}: {_shown(str(identifier))} is not in the rig (it has {names})"
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


def write_table(path: Path, table: ObservationTable, joint_units: Sequence[str]) -> None:
    """Write a table that ``read_table`` reads back exactly (but for ``source``). Raises InputError."""
    write_atomic(path, format_table(table, joint_units))
