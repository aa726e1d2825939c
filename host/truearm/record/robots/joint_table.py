"""Read a table (CSV) of joint readings, written by the robot or its logger, as lines of a session.

The header is parsed as in ``columns``. The table is read row by row: a day at 500 Hz is 43 million rows.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from io import TextIOWrapper
from itertools import chain
from pathlib import Path
from typing import IO

from truearm.errors import Argument, InputError, TableError
from truearm.file_names import open_input, reading
from truearm.files.csv_cells import Row, rows_of
from truearm.record.joint_lines import MAX_LINE
from truearm.record.robots.joint_columns import read_columns, renamed, separator_of, with_point
from truearm.record.robots.sources import AddedReading, FileOptions
from truearm.session.joint_format import parse_reading

NO_ARRIVAL = {"arrival": False}  # in every such line: its arrival was not observed


def readings(path: Path, options: FileOptions) -> Iterator[AddedReading]:
    """Yield the readings of a table in order of time. Raises TableError with file and row, InputError if joints are
    named.
    """
    if options.joints:
        raise InputError(
            *(
                Argument("joints"),
                " and ",
                Argument("model"),
                " order the joints of a bag; a table's columns are already in order",
            )
        )
    return _readings(path, options.columns)


def _readings(path: Path, renames: Sequence[tuple[str, str]]) -> Iterator[AddedReading]:
    try:
        with open_input(path) as file, reading(path):
            yield from _rows(path, TextIOWrapper(file, encoding="utf-8-sig", newline=""), renames)
    except UnicodeDecodeError as exc:
        raise TableError("not-text", place=path) from exc


def _rows(path: Path, file: IO[str], renames: Sequence[tuple[str, str]]) -> Iterator[AddedReading]:
    lines = _lines(path, file)
    header = next(lines, "")
    separator = separator_of(header)
    given = chain([header], lines)
    rows = rows_of(map(_one_space, given) if separator == " " else given, str(path), separator=separator)
    try:
        titles = next(rows, Row(1, [])).cells
        columns = read_columns(renamed(titles, renames) if renames else titles)
        last = -1.0
        for number, cells in rows:
            line = columns.line(cells if separator == "," else [with_point(cell) for cell in cells], **NO_ARRIVAL)
            reading = None if line is None else parse_reading(line)
            if line is None or reading is None:
                raise TableError(
                    f"{path} row {number}: is not a reading: it needs {columns.width} numbers, with t not negative"
                )
            if reading.t < last:
                raise TableError(
                    f"{path} row {number}: time goes back from {last:g} s to {reading.t:g} s; sort the rows, or "
                    "make two tables if the controller was restarted"
                )
            last = reading.t
            yield AddedReading(reading.t, line)
    except TableError:
        raise
    except InputError as exc:
        raise TableError(*exc.args, **exc.values).within(path) from exc


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
