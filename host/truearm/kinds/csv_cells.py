"""CSV files: rows of equal width as text, and columns by quantity, as identifiers or numbers in SI units.

Every error message names the file, the row (as an editor counts, with the header as row 1) and the column.
"""

from __future__ import annotations

import csv
import difflib
import io
import math
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from truearm.errors import TableError
from truearm.kinds.columns import is_label
from truearm.model.chain_structure import units_of
from truearm.schema import NAME, quoted
from truearm.text import counted
from truearm.units import SUFFIXES, UNITS, named

if TYPE_CHECKING:
    from truearm.types import Floats

MAX_ROWS = 200_000  # 250 times the paper's grid of 800 poses
MAX_COLUMNS = 200
MAX_CELL = 200
LIKE = 0.65  # similarity of a title and a known one, from 0 to 1, for which the known one was probably meant

_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
NUMBER = re.compile(_NUMBER, re.ASCII)
_NUMBERS = re.compile(rf"(?:{_NUMBER}\n)*+", re.ASCII)


class Row(NamedTuple):
    """A row that is not blank, and its number as an editor shows it; the header is row 1."""

    number: int
    cells: list[str]


def rows_of(lines: Iterable[str], name: str, separator: str = ",") -> Iterator[Row]:
    """Yield the rows of CSV lines as they arrive, including the header; rows whose cells are all blank are skipped.

    Raises TableError.
    """
    reader = csv.reader(lines, delimiter=separator, strict=True)
    try:
        for cells in reader:
            stripped = [cell.strip() for cell in cells]
            if any(stripped):
                yield Row(reader.line_num, stripped)
    except csv.Error as exc:
        raise TableError(f"{name} row {reader.line_num}: is not CSV: {exc}") from exc


def read_cells(text: str, name: str) -> tuple[list[str], list[Row]]:
    """Return the header and the rows of a table, all of one width. Raises TableError.

    Last columns without a title and without a value, as spreadsheets leave them behind, are left out.
    """
    first = re.split(r"[\r\n]", text.lstrip(), maxsplit=1)[0]
    if not {",", "="} & set(first) and re.search(r'[\w"][;\t]\s*[\w"]', first):
        raise TableError(
            f"{name}: columns are separated by ';' or tabs; separate them by commas, and write numbers with a decimal point"
        )
    rows = list(islice(rows_of(io.StringIO(text, newline=None), name), MAX_ROWS + 2))
    if not rows:
        raise TableError("no-rows", place=name)
    header = rows[0].cells
    if len(header) > MAX_COLUMNS:
        raise TableError(f"{name}: has {len(header)} columns; the maximum is {MAX_COLUMNS}")
    if len(rows) > MAX_ROWS + 1:
        raise TableError(f"{name}: has more than {MAX_ROWS} rows; split it or thin it out")
    for row in rows[1:]:
        if len(row.cells) != len(header):
            raise TableError(
                f"{name} row {row.number}: has {counted(len(row.cells), 'cell')}, the header has {len(header)}; give every column a cell, an empty one if it has no value"
            )
    width = len(header)
    while not any(row.cells[width - 1] for row in rows):  # the header is not blank
        width -= 1
    if "" in header[:width]:
        raise TableError(
            f"{name} column {header.index('') + 1}: has no title in the header; give it one, or remove the column"
        )
    return header[:width], [Row(row.number, row.cells[:width]) for row in rows[1:]]


class Column(NamedTuple):
    """A column of a file: its title, its position, and the suffix of its unit, "" for text."""

    title: str
    position: int
    unit: str


Titles = Mapping[str, tuple[str, str]]  # the quantity and the suffix of the unit that a title stands for


def joint_titles(letter: str, suffixes: Iterable[str], joints: int) -> dict[str, tuple[str, str]]:
    """Return the titles of a quantity with a column for each joint: "q1_rad", "q1_deg", …"""
    numbered = [f"{letter}{i}" for i in range(1, joints + 1)]
    return {named(quantity, suffix): (quantity, suffix) for suffix in suffixes for quantity in numbered}


def read_header(header: list[str], titles: Titles, name: str, docs_page: str, ignored: str = "") -> dict[str, Column]:
    """Return the columns of a file by quantity, and the user's own by their title.

    Columns without a title, ``note``, and those that match ``ignored`` are skipped. The first of ``titles`` must be
    there. Raises TableError with the title that was probably meant; ``docs_page`` refers to the page on which all are
    described.
    """
    first, columns = next(iter(titles)), dict[str, Column]()
    if not difflib.get_close_matches(first, [title.lower() for title in header]):
        raise TableError("missing-column", place=name, column=first, header=quoted(header[0]))
    for position, title in enumerate(header):
        place = f"{name} column {position + 1} ({quoted(title)})"
        if title and title in header[:position]:
            raise TableError("given-twice", place=place, what="it")
        if title in ("", "note") or re.fullmatch(ignored, title):
            continue
        if title not in titles and not is_label(title):
            raise _unknown_title(title, titles, place, docs_page)
        quantity, unit = titles.get(title, (title, ""))
        if quantity in columns:
            raise TableError("given-twice", place=place, what=quantity)
        columns[quantity] = Column(title, position, unit)
    if titles[first][0] not in columns:
        raise TableError("missing-column", place=name, column=first)
    return columns


def _unknown_title(title: str, titles: Titles, place: str, docs_page: str) -> TableError:
    """Return the error for a title that is none: of a known quantity in another unit, or like known ones."""
    stem = title
    while stem:
        if names := [name for name, (_, unit) in titles.items() if unit and name == named(stem, unit)]:
            return TableError("wrong-value", place=place, names=names)
        stem = stem.rpartition("_")[0]
    close = difflib.get_close_matches(title[:40].lower(), titles, n=2, cutoff=LIKE)
    meant = f"did you mean {' or '.join(close)}? Otherwise " if close else f"for the columns, {docs_page}; "
    return TableError("unknown-column", place=place, remedy=f"{meant}begin its name with x_ if it is to be ignored")


@dataclass(frozen=True)
class CsvTable:
    """The n rows of a file, and its columns by quantity; ``name`` stands for the file in messages."""

    name: str
    rows: list[Row]
    columns: Mapping[str, Column]

    @property
    def sources(self) -> list[str]:
        """The name of each row, as an editor counts: "poses.csv row 2"."""
        return [f"{self.name} row {row.number}" for row in self.rows]

    def cells(self, quantity: str) -> list[str]:
        """Return the texts (n,) of a column; "" where it is missing."""
        column = self.columns.get(quantity)
        return [""] * len(self.rows) if column is None else [row.cells[column.position] for row in self.rows]

    def place(self, row: int, quantity: str) -> str:
        """Return the file, the row and the column of a cell, for a message."""
        return f"{self.name} row {self.rows[row].number} column {self.columns[quantity].title}"

    def identifiers(self, quantity: str) -> np.ndarray:
        """Return a column of names (n,); "" where it is missing or a cell is empty. Raises TableError."""
        if quantity not in self.columns:
            return np.full(len(self.rows), "", dtype="U1")
        cells = self.cells(quantity)
        for cell in dict.fromkeys(cells):
            if cell and not NAME.fullmatch(cell):
                raise TableError(
                    f"{self.place(cells.index(cell), quantity)}: {quoted(cell)} is not an identifier; "
                    "use up to 64 letters, digits, '-', '_' and '.'"
                )
        return np.array(cells)

    def numbers(
        self, quantity: str, largest: float | None = None, smallest: float = -math.inf, *, required: bool = False
    ) -> Floats:
        """Return a column of numbers (n,) in SI units; NaN where the column or, unless ``required``, a cell is missing.

        Magnitudes are at most ``largest``, by default the largest in their unit, and numbers at least ``smallest``.
        Raises TableError.
        """
        if quantity not in self.columns:
            return np.full(len(self.rows), np.nan)
        unit, cells = SUFFIXES[self.columns[quantity].unit], self.cells(quantity)
        largest = UNITS[unit.si].largest if largest is None else largest
        smallest = max(smallest, -largest)
        plain = cells if _are_numbers(cells) else [cell if _is_number(cell) else "nan" for cell in cells]
        out = unit.scale * np.array([*map(float, plain)])
        # Nearly all columns end here. The first wrong cell of the others is found one by one.
        for i in np.flatnonzero(~((out <= largest) & (out >= smallest) & np.isfinite(out))).tolist():
            cell, place = cells[i], self.place(i, quantity)
            if not cell and not required:
                continue
            number(cell, place)
            bounds = f"{unit.text(smallest)} and {unit.text(largest)}"
            raise TableError(f"{place}: {quoted(cell)} is not between {bounds}; is the column in another unit?")
        return out

    def vectors(
        self,
        quantities: Sequence[str],
        words: str,
        largest: float | None = None,
        *,
        required: bool = False,
    ) -> Floats:
        """Return columns side by side (n, c), of which each row must have all or none, as ``numbers`` does."""
        absent = [quantity for quantity in quantities if quantity not in self.columns]
        if len(absent) not in (0, len(quantities)):
            raise TableError("missing-column", place=self.name, column=absent[0])
        columns = [self.numbers(quantity, largest, required=required) for quantity in quantities]
        out = np.stack(columns, axis=1)
        missing = np.isnan(out)
        bad = np.flatnonzero(missing.any(axis=1) & ~missing.all(axis=1))
        if bad.size:
            raise TableError(f"{self.sources[bad[0]]}: has only some of {words}; give all of them or none")
        return out

    def numbered(self, letter: str) -> list[Column]:
        """Return the columns of a quantity with one column per joint, in joint order, without gaps.

        Raises TableError.
        """
        numbers = sorted(int(name[len(letter) :]) for name in self.columns if re.fullmatch(rf"{letter}\d+", name))
        missing = set(range(1, max(numbers, default=0) + 1)) - set(numbers)
        if missing:
            raise TableError(
                f"{self.name}: has columns up to {letter}{numbers[-1]} but none for {letter}{min(missing)}; number the joints from 1 without a gap"
            )
        return [self.columns[f"{letter}{i}"] for i in numbers]

    def joints(self, joint_units: Sequence[str] | None = None, mimics: Collection[int] = ()) -> Floats:
        """Return the joint readings (n, j), checked against the robot; a table may be without its mimic joints.

        Raises TableError.
        """
        columns = self.numbered("q")
        if not columns:
            raise TableError("missing-column", place=self.name, column="q1_rad")
        units = [] if joint_units is None else units_of(len(columns), joint_units, mimics)
        if joint_units is not None and len(columns) != len(units):
            raise TableError("other-robot", place=self.name, joints=len(columns), expected=len(units))
        for column, unit in zip(columns, units, strict=False):
            if SUFFIXES[column.unit].si != unit:
                allowed = "rad or deg (it turns)" if unit == "rad" else "m or mm (it slides)"
                raise TableError(f"{self.name} column {column.title}: the robot's joint is measured in {allowed}")
        return np.stack([self.numbers(f"q{i + 1}", required=True) for i in range(len(columns))], axis=1)


def read_csv(text: str, name: str, titles: Titles, docs_page: str, ignored: str = "") -> CsvTable:
    """Return the table in a text; see ``read_header``. Raises TableError, also for a table without rows."""
    header, rows = read_cells(text, name)
    table = CsvTable(name, rows, read_header(header, titles, name, docs_page, ignored))
    if not rows:
        raise TableError("no-rows", place=name)
    return table


def csv_text(rows: Iterable[Iterable[object]]) -> str:
    """Return rows of cells, the header first, as CSV."""
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


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
