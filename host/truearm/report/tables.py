"""A table of texts, for the screen, a page, and Python."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from truearm.units import SUFFIXES, UNITS, title


class Table(NamedTuple):
    """Rows of cells below titles.

    The first column names the row; the others are numbers, or text if the title ends in a space.

    ``label`` names it for screen readers, ``marks`` are style classes of its rows. ``total``: of all rows, if these are
    only the first.
    """

    titles: Sequence[str]
    rows: Iterable[Sequence[object]]
    label: str = ""
    marks: Sequence[str] = ()
    total: int = 0

    def __str__(self) -> str:
        lines = [[title.strip() for title in self.titles], *([str(cell) for cell in row] for row in self.rows)]
        wide = [max(map(len, column)) for column in zip(*lines, strict=True)]
        texts = [k == 0 or title.endswith(" ") for k, title in enumerate(self.titles)]
        aligned = (
            (cell.ljust(width) if is_text else cell.rjust(width) for cell, width, is_text in zip(line, wide, texts))
            for line in lines
        )
        return "\n".join("  ".join(line).rstrip() for line in aligned)


ErrorRow = tuple[str, Sequence[float | None], int]  # words, errors in the unit of the table, number of rows


def error_table(suffix: str, titles: Sequence[str], rows: Iterable[ErrorRow]) -> Table:
    """Return errors in the unit of ``suffix``, with a column for each of ``titles``; "-" for what is not known."""
    unit = UNITS[SUFFIXES[suffix].si]
    cells = [
        (words, *("-" if error is None else f"{error:.{unit.decimals}f}" for error in errors), n)
        for words, errors, n in rows
    ]
    return Table((title("error", unit.si), *titles, "rows"), cells, "errors")
