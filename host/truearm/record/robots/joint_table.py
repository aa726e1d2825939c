"""Read joint readings in columns, live or in a table (CSV); column titles in the header end in the unit.

``t_s`` (or _ms, _us, _ns) is the controller's time, ``q1_rad`` (_deg, _m, _mm) … are the measured joints. Optional
columns are ``q1_cmd_rad`` … commanded joints, ``qd1_rad_s`` … velocities, ``seq`` a count of the readings, and
``inputs`` digital inputs as a number. ``note`` and ``x_…`` are skipped.

A table is written by the robot or its logger, and read row by row: a day at 500 Hz is 43 million rows.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from io import TextIOWrapper
from itertools import chain, cycle
from pathlib import Path
from types import NoneType
from typing import IO, Any

from truearm.disk import open_input, reading
from truearm.errors import Argument, InputError, TableError
from truearm.kinds.csv_cells import MAX_COLUMNS, NUMBER, Column, Row, read_header, rows_of
from truearm.record.intake import MAX_LINE
from truearm.record.robots.sources import AddedReading, FileOptions
from truearm.schema import quoted
from truearm.session.joint_format import MAX_JOINTS, are_joints, format_reading, parse_line
from truearm.units import SUFFIXES

# to divide by: 1e-9 is not exact in binary
PER_SECOND = {unit: round(SUFFIXES[unit].factor) for unit in ("s", "ms", "us", "ns")}
EXAMPLE = "t_s,seq,q1_rad,q2_rad,... (units: rad, deg, m, mm; commanded joints are q1_cmd_rad, ...)"
UNITS_OF_JOINTS = ("rad", "deg", "m", "mm")
# the quantity and the unit of each column that is read; quantities of joints are numbered
TITLES = {
    **{f"t_{unit}": ("t", unit) for unit in PER_SECOND},
    **{name: (name, "") for name in ("seq", "inputs")},
    **{
        title.format(number, unit): (f"{quantity}{number}", unit)
        for quantity, title in (("q", "q{}_{}"), ("q_cmd", "q{}_cmd_{}"), ("qd", "qd{}_{}_s"))
        for number in range(1, MAX_JOINTS + 1)
        for unit in UNITS_OF_JOINTS
    },
}
_NUMBER = re.compile(rf"([+-]?\d{{1,18}})|(?:{NUMBER.pattern})", re.ASCII)

QUANTITIES = ("t", "seq", "q", "q_cmd", "qd", "current", "effort", "inputs")
CONVERTED = ("q", "q_cmd", "qd")  # of joints, with units
MAX_CELL = 40  # characters of a number
MAX_TIME = 2**63  # in any unit: nanoseconds since 1970 are 2⁶¹

Name = str | tuple[str, ...]


@dataclass(frozen=True)
class Names:
    """The names and units in a robot's rows.

    ``keys``: the key of a quantity, or the keys of its joints. ``scale``: factors of a quantity to SI, one for all joints or
    one each. Time is divided by ``t_per_second``.
    """

    keys: Mapping[str, Name] = field(default_factory=dict)
    scale: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    t_per_second: int = 1

    def line(self, row: Mapping[str, Any], **entries: object) -> bytes | None:
        """Return a row as a line of a session, with ``entries`` added; None if it is not a reading."""
        values = {quantity: self._value(row, quantity) for quantity in QUANTITIES}
        t, seq, q = (values.pop(name) for name in ("t", "seq", "q"))
        if type(t) not in (int, float) or not abs(t) < MAX_TIME or type(seq) not in (int, NoneType) or q is None:
            return None
        return format_reading(t / self.t_per_second, seq, q, **values, **entries)

    def _value(self, row: Mapping[str, Any], quantity: str) -> Any:
        """Return a value of a row, joints in SI; None if it is invalid, or the number of joints is not that of the units."""
        key = self.keys.get(quantity, quantity)
        value = row.get(key) if isinstance(key, str) else [row.get(name) for name in key]
        if value is None or quantity in ("t", "seq"):
            return value
        if quantity == "inputs":
            return value if type(value) is int else None
        scale = self.scale.get(quantity, (1.0,))
        if not are_joints(value) or len(scale) not in (1, len(value)):
            return None
        return [factor * number for factor, number in zip(cycle(scale), value, strict=False)]


@dataclass(frozen=True)
class Columns:
    """The columns of a table with ``width`` cells per row: those that are read by their titles, to which ``names`` refers."""

    width: int
    read: Sequence[Column]
    names: Names

    def line(self, cells: Sequence[str], **entries: object) -> bytes | None:
        """Return a row as a line of a session, with ``entries`` added; None if it is not a reading."""
        if len(cells) != self.width:
            return None
        row = {column.title: _number(cells[column.position]) for column in self.read}
        if None in row.values() or any(type(row[column.title]) is float for column in self.read if not column.unit):
            return None
        return self.names.line(row, **entries)


def _number(cell: str) -> int | float | None:
    """Return a decimal number, whole if it is written so; None for any other text.

    float() would accept "1_000", "nan" and digits of other scripts.
    """
    match = _NUMBER.fullmatch(cell)
    if match is None or len(cell) > MAX_CELL:
        return None
    return int(cell) if match[1] else float(cell)


NUMBERED = "{}"  # stands for the number of a joint
SEPARATORS = ",;\t"


def separator_of(header: str) -> str:
    """Return the delimiter of a table with this header: the most frequent one of comma, semicolon and tab, else a space."""
    separator = max(SEPARATORS, key=header.count)
    return separator if separator in header or " " not in header.strip() else " "


def with_point(cell: str) -> str:
    """Replace the decimal comma of a number with a point and leave other cells unchanged.

    For tables that are not separated by commas.
    """
    return cell.replace(",", ".") if cell.count(",") == 1 and "." not in cell else cell


def parse_renames(text: str) -> tuple[tuple[str, str], ...]:
    """Parse OURS=THEIRS,… into pairs (ours, theirs); {} in both stands for a joint's number. Raises InputError."""
    entries = text.split(",")
    pairs = tuple((ours.strip(), theirs.strip()) for ours, _, theirs in (entry.partition("=") for entry in entries))
    for entry, (ours, theirs) in zip(entries, pairs, strict=True):
        if not theirs or not ours or (NUMBERED in ours) != (NUMBERED in theirs) or theirs.count(NUMBERED) > 1:
            raise InputError(
                f"{quoted(entry)}: write OURS=THEIRS, such as t_s=timestamp or q{NUMBERED}_rad=actual_q_{NUMBERED}, "
                f"with {NUMBERED} for a joint's number on both sides or none"
            )
    return pairs


def renamed(titles: Sequence[str], renames: Sequence[tuple[str, str]], name: str = "the header") -> list[str]:
    """Return a table's titles with our names. Joints count from the lowest number present.

    Columns without a rename keep the titles that we know, unless a renamed column takes their place; others are
    skipped. ``name`` is that of the file. Raises TableError for a column that is not there.
    """
    out: dict[int, str] = {}
    for ours, theirs in renames:
        pattern = re.compile(r"(\d{1,2})".join(map(re.escape, theirs.split(NUMBERED))))
        places = [(k, match) for k, title in enumerate(titles) if (match := pattern.fullmatch(title))]
        if not places:
            listed = ", ".join(map(quoted, titles[:8]))
            raise TableError(f"{name}: no column {quoted(theirs)}; the table begins with {listed}")
        first = min(int(match[1]) for _, match in places) if NUMBERED in theirs else 0
        for k, match in places:
            number = int(match[1]) - first + 1 if NUMBERED in theirs else ""
            out[k] = ours.replace(NUMBERED, str(number))
    taken = {_quantity(title) for title in out.values()} | {""}
    return [out.get(k, f"x_{k}" if _quantity(title) in taken else title) for k, title in enumerate(titles)]


def _quantity(title: str) -> str:
    return TITLES.get(title, ("", ""))[0]


def read_columns(titles: Sequence[str], name: str = "the header") -> Columns:
    """Return the columns named by a header; ``name`` is that of its file. Raises TableError."""
    if len(titles) > MAX_COLUMNS:
        raise TableError(f"{name}: {len(titles)} columns; the maximum is {MAX_COLUMNS}")
    columns = read_header(list(titles) or [""], TITLES, name, f"expected a header such as {EXAMPLE}", ignored="x_.*")
    keys: dict[str, Name] = {key: columns[key].title for key in ("t", "seq", "inputs") if key in columns}
    scale: dict[str, tuple[float, ...]] = {}
    n = sum(key.startswith("q") and key[1:].isdigit() for key in columns)
    for quantity in CONVERTED:
        joints = [key for key in columns if key.rstrip("0123456789") == quantity]
        numbered = [f"{quantity}{number}" for number in range(1, n + 1)]
        if n == 0 or (joints and {*joints} != {*numbered}):
            raise TableError(
                f"{name}: columns of {quantity} are needed for joints 1, 2, ... without a gap; expected {EXAMPLE}"
            )
        if joints:
            keys[quantity] = tuple(columns[key].title for key in numbered)
            scale[quantity] = tuple(SUFFIXES[columns[key].unit].scale for key in numbered)
    return Columns(len(titles), tuple(columns.values()), Names(keys, scale, PER_SECOND[columns["t"].unit]))


NO_ARRIVAL = {"arrival": False}  # in every such line: its arrival was not observed


def readings(path: Path, options: FileOptions) -> Iterator[AddedReading]:
    """Yield the readings of a table in order of time. Raises TableError with file and row, InputError if joints are
    named.
    """
    if options.joints:
        arguments = Argument("joints"), " and ", Argument("model")
        raise InputError(*arguments, " order the joints of a bag; a table's columns are already in order")
    try:
        with open_input(path) as file, reading(path):
            yield from _rows(path, TextIOWrapper(file, encoding="utf-8-sig", newline=""), options.columns)
    except UnicodeDecodeError as exc:
        raise TableError("not-text", place=path) from exc


def _rows(path: Path, file: IO[str], renames: Sequence[tuple[str, str]]) -> Iterator[AddedReading]:
    lines = _lines(path, file)
    header = next(lines, "")
    separator = separator_of(header)
    rows_of_text = chain([header], lines)
    rows = rows_of(map(_one_space, rows_of_text) if separator == " " else rows_of_text, str(path), separator=separator)
    titles = next(rows, Row(1, [])).cells
    columns = read_columns(renamed(titles, renames, str(path)) if renames else titles, str(path))
    last = -1.0
    for number, cells in rows:
        line = columns.line(cells if separator == "," else [with_point(cell) for cell in cells], **NO_ARRIVAL)
        reading = None if line is None else parse_line(line)
        if line is None or reading is None:
            raise TableError(
                f"{path} row {number}: is not a reading: it needs {len(titles)} numbers, with t not negative"
            )
        if reading.t < last:
            raise TableError(
                f"{path} row {number}: time goes back from {last:g} s to {reading.t:g} s; sort the rows, or "
                "make two tables if the controller was restarted"
            )
        last = reading.t
        yield AddedReading(reading.t, line)


def _one_space(line: str) -> str:
    """Return a line of columns that are aligned with spaces, with one space between them; a "#" before a header is left
    out.
    """
    return " ".join(line.removeprefix("#").split()) + "\n"


def _lines(path: Path, file: IO[str]) -> Iterator[str]:
    while line := file.readline(MAX_LINE + 1):
        if len(line) > MAX_LINE:
            raise TableError(
                f"{path}: has a line of more than {MAX_LINE} characters; is this a table of joint readings?"
            )
        yield line
