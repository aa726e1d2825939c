"""Short displays of public objects: one line in a terminal, a small table in a notebook, a pandas.DataFrame."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from truearm.errors import InputError
from truearm.text import counted

ROWS = 8  # shown of a table
COLUMNS = 10


class Displayed:
    """A base class of objects that have a headline and, if they are a table, columns (n,) or (n, k) by title, in SI units.

    Columns without any value are not shown. A column (n, k) becomes k columns, numbered from 1.
    """

    def _headline(self) -> str:
        raise NotImplementedError

    def _columns(self) -> Mapping[str, Any]:
        return {}

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {self._headline()}>"

    def _repr_html_(self) -> str:
        columns = self._flat()
        shown = dict(list(columns.items())[:COLUMNS])
        n = max(map(len, columns.values()), default=0)
        rows = ["".join(f"<td>{_cell(column[i])}</td>" for column in shown.values()) for i in range(min(n, ROWS))]
        head = "".join(f"<th>{escape(title)}</th>" for title in shown)
        table = "".join(f"<tr>{row}</tr>" for row in (head, *rows))
        counts = f"<p>{counted(n, 'row')}, {counted(len(columns), 'column')}</p>"
        shown_table = f"<table>{table}</table>{counts}" if columns else ""
        return f"<p><b>{type(self).__name__}</b>: {escape(self._headline())}</p>{shown_table}"

    def to_pandas(self) -> Any:
        """Return the columns as a pandas.DataFrame, in SI units. Raises InputError if pandas is not installed."""
        try:
            from pandas import DataFrame
        except ImportError:
            raise InputError("missing-package", place="to_pandas", package="pandas", install="pandas") from None
        return DataFrame(self._flat())

    def _flat(self) -> dict[str, NDArray[Any]]:
        """Return the columns (n,) that have a value."""
        flat: dict[str, NDArray[Any]] = {}
        for title, values in self._columns().items():
            column = np.asarray(values)
            flat |= {title: column} if column.ndim == 1 else {f"{title}{i}": c for i, c in enumerate(column.T, start=1)}
        return {title: column for title, column in flat.items() if not _is_blank(column).all()}


def _is_blank(column: NDArray[Any]) -> NDArray[np.bool_]:
    return np.isnan(column) if column.dtype.kind == "f" else np.asarray(column == "")


def _cell(value: Any) -> str:
    """Return a value as HTML; "" for NaN."""
    return "" if value != value else f"{value:.6g}" if isinstance(value, float) else escape(str(value))
