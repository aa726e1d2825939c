"""The cells of a CSV file: rows of equal width as text, and columns of them as identifiers or numbers in SI units.

Every error message names the file, the row (as an editor counts, with the header as row 1) and the column.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Iterable, Iterator
from itertools import islice
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from truearm.errors import InputError, TableError
from truearm.schema import NAME, quoted
from truearm.text import counted
from truearm.units import SUFFIXES

if TYPE_CHECKING:
    from truearm.files.observation_columns import Column
    from truearm.types import Floats

MAX_ROWS = 200_000  # 250 times the paper's grid of 800 poses
MAX_COLUMNS = 200
MAX_CELL = 200

_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
NUMBER = re.compile(_NUMBER, re.ASCII)
_NUMBERS = re.compile(rf"(?:{_NUMBER}\n)*+", re.ASCII)


class Row(NamedTuple):
    """A row that is not blank, and its number as an editor shows it; the header is row 1."""

    number: int
    cells: list[str]


def rows_of(
    lines: Iterable[str], name: str, error: type[InputError] = TableError, separator: str = ","
) -> Iterator[Row]:
    """Yield the rows of CSV lines as they arrive, including the header; rows whose cells are all blank are skipped.

    Raises ``error``.
    """
    reader = csv.reader(lines, delimiter=separator, strict=True)
    try:
        for cells in reader:
            stripped = [cell.strip() for cell in cells]
            if any(stripped):
                yield Row(reader.line_num, stripped)
    except csv.Error as exc:
        raise error(f"{name} row {reader.line_num}: is not CSV: {exc}") from exc


def read_rows(text: str, name: str, error: type[InputError] = TableError) -> list[Row]:
    """Return the rows of a text, including the header. Raises ``error``."""
    return list(islice(rows_of(io.StringIO(text, newline=None), name, error), MAX_ROWS + 2))


def check_width(row: Row, width: int, name: str, error: type[InputError] = TableError) -> None:
    """Raise ``error`` if a row does not have as many cells as the header."""
    if len(row.cells) != width:
        raise error(
            f"{name} row {row.number}: has {counted(len(row.cells), 'cell')}, the header has {width}; give every column a cell, an empty one if it has no value"
        )


def read_cells(text: str, name: str) -> tuple[list[str], list[Row]]:
    """Return the header and the rows of a table, all of one width. Raises TableError.

    Last columns without a title and without a value, as spreadsheets leave them behind, are left out.
    """
    first = re.split(r"[\r\n]", text.lstrip(), maxsplit=1)[0]
    if not {",", "="} & set(first) and re.search(r'[\w"][;\t]\s*[\w"]', first):
        raise TableError(
            f"{name}: columns are separated by ';' or tabs; separate them by commas, and write numbers with a decimal point"
        )
    rows = read_rows(text, name)
    if not rows:
        raise TableError("no-rows", place=name)
    header = rows[0].cells
    if len(header) > MAX_COLUMNS:
        raise TableError(f"{name}: has {len(header)} columns; the maximum is {MAX_COLUMNS}")
    if len(rows) > MAX_ROWS + 1:
        raise TableError(f"{name}: has more than {MAX_ROWS} rows; split it or thin it out")
    for row in rows[1:]:
        check_width(row, len(header), name)
    width = len(header)
    while not any(row.cells[width - 1] for row in rows):  # the header is not blank
        width -= 1
    if "" in header[:width]:
        raise TableError(
            f"{name} column {header.index('') + 1}: has no title in the header; give it one, or remove the column"
        )
    return header[:width], [Row(row.number, row.cells[:width]) for row in rows[1:]]


def identifiers(rows: list[Row], column: Column | None, name: str) -> np.ndarray:
    """Return a column of names; "" where the column or a cell is empty."""
    if column is None:
        return np.full(len(rows), "", dtype="U1")
    for row in rows:
        cell = row.cells[column.position]
        if cell and not NAME.fullmatch(cell):
            raise TableError(
                f"{name} row {row.number} column {column.name}: {quoted(cell)} is not an identifier; "
                "use up to 64 letters, digits, '-', '_' and '.'"
            )
    return np.array([row.cells[column.position] for row in rows])


def numbers(
    rows: list[Row],
    column: Column | None,
    name: str,
    largest: float,
    least: Floats | float = -math.inf,
    *,
    required: bool = False,
) -> Floats:
    """Return a column of numbers in SI units; NaN where the column or, unless ``required``, a cell is empty.

    Magnitudes are at most ``largest``, and numbers at least ``least``, of each row (n,) or of all.
    """
    if column is None:
        return np.full(len(rows), np.nan)
    scale = SUFFIXES[column.unit].scale
    cells = [row.cells[column.position] for row in rows]
    plain = cells if _are_numbers(cells) else [cell if _is_number(cell) else "nan" for cell in cells]
    out = scale * np.array([*map(float, plain)])
    # Nearly all columns end here. The first wrong cell of the others is found one by one.
    for i in np.flatnonzero(~((np.abs(out) <= largest) & (out >= least))).tolist():
        cell, place = cells[i], f"{name} row {rows[i].number} column {column.name}"
        value = math.nan if not cell and not required else scale * number(cell, place)
        if abs(value) > largest:
            raise TableError(f"{place}: {quoted(cell)} is too large for {column.unit}; is the column in another unit?")
        if value < (lowest := np.broadcast_to(least, out.shape)[i]):
            wrong = "must be 0 or more" if lowest == 0.0 else "must be greater than 0"
            if value > 0.0:
                wrong = "is too small; is the column in another unit?"
            raise TableError(f"{place}: {quoted(cell)} {wrong}")
    return out


def together(columns: list[Floats], rows: list[Row], words: str, name: str) -> Floats:
    """Return columns side by side (n, c), where each row must have all of them or none."""
    out = np.stack(columns, axis=1)
    missing = np.isnan(out)
    bad = np.flatnonzero(missing.any(axis=1) & ~missing.all(axis=1))
    if bad.size:
        raise TableError(f"{name} row {rows[bad[0]].number}: has only some of {words}; give all of them or none")
    return out


def number(cell: str, place: str) -> float:
    """Return a finite decimal number."""
    if not cell:
        raise TableError(f"{place}: is empty; every row needs a number here")
    if cell.lower().lstrip("+-") in ("nan", "inf", "infinity"):
        raise TableError(f"{place}: {cell} is not a finite number; leave out rows without a reading")
    # float() would accept "1_000" and digits of other scripts; a table with these was not written as numbers.
    if not _is_number(cell):
        raise TableError(f"{place}: {quoted(cell)} is not a number; write digits with a decimal point, such as -12.5")
    return float(cell)


def _are_numbers(cells: list[str]) -> bool:
    """Return whether all cells are decimal numbers: a third of the time of asking each."""
    lines = "\n".join([*cells, ""])
    one_line_each = lines.count("\n") == len(cells)  # a quoted cell may have several
    return one_line_each and max(map(len, cells), default=0) <= MAX_CELL and _NUMBERS.fullmatch(lines) is not None


def _is_number(cell: str) -> bool:
    return len(cell) <= MAX_CELL and NUMBER.fullmatch(cell) is not None
