"""Write tables of columns to disk in batches: CSV, NumPy's .npz, Parquet, MCAP messages. Numbers are stored bit for
bit.

All but MCAP are written as Parquet first, and converted when the table ends. Memory holds one batch, or one column.
"""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from truearm.errors import Argument, InputError
from truearm.files.column_tables import Columns, ColumnTable, Placement, Tables


class TableFiles:
    """One file per table, of the format that the suffix names."""

    def __init__(self, suffix: str, folder: Path, placement: Placement) -> None:
        self._suffix, self._folder = suffix, folder

    def begin(self, name: str, columns: Columns) -> tuple[str, ColumnTable]:
        """See ``Tables``."""
        file = f"{name}.{self._suffix}"
        return file, ArrowTable(self._folder / file, columns)

    def close(self) -> None:
        """See ``Tables``."""


class ArrowTable(ColumnTable):
    """A table in a file named .parquet, .csv or .npz.

    CSV: UTF-8 with a header; floats in the fewest digits that give the same number again; an empty cell for NaN.
    .npz: one array per title, readable by ``numpy.load`` without pickling.
    """

    def __init__(self, path: Path, columns: Columns) -> None:
        from pyarrow import parquet

        super().__init__()
        self._path, self._parquet = path, path.with_suffix(".parquet")
        self._schema = _arrow(columns).schema
        # Measured numbers hardly repeat: looking for repetitions makes files larger and takes a third of the time.
        texts = [title for title, column in columns.items() if column.dtype.kind == "U"]
        self._writer = parquet.ParquetWriter(self._parquet, self._schema, compression="zstd", use_dictionary=texts)

    def _write(self, columns: Columns) -> int:
        table = _arrow(columns).cast(self._schema)
        self._writer.write_table(table)
        return int(table.num_rows)

    def close(self) -> None:
        self._writer.close()
        if self._path != self._parquet:
            (_write_csv if self._path.suffix == ".csv" else _write_npz)(self._parquet, self._path)
            self._parquet.unlink()


def _arrow(columns: Columns) -> Any:
    import pyarrow

    arrays = (
        column.tolist() if column.dtype.kind == "U" else np.ascontiguousarray(column) for column in columns.values()
    )
    return pyarrow.table(dict(zip(columns, map(pyarrow.array, arrays), strict=True)))


def _write_csv(source: Path, path: Path) -> None:
    import pyarrow
    from pyarrow import csv, parquet

    with parquet.ParquetFile(source) as file, csv.CSVWriter(path, file.schema_arrow) as writer:
        for batch in file.iter_batches():
            arrays = [
                pyarrow.array(column.to_numpy(zero_copy_only=False), from_pandas=True) for column in batch.columns
            ]
            writer.write_batch(pyarrow.record_batch(arrays, names=batch.schema.names))  # NaN as an empty cell


def _write_npz(source: Path, path: Path) -> None:
    from pyarrow import parquet

    with zipfile.ZipFile(path, "w") as archive, parquet.ParquetFile(source) as file:
        for title in file.schema_arrow.names:
            column = file.read([title])[title].to_numpy()
            column = column.astype(np.str_) if column.dtype.kind == "O" else column
            with archive.open(f"{title}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, column, allow_pickle=False)


def _mcap(folder: Path, placement: Placement) -> Tables:
    from truearm.files.mcap_tables import McapTables

    return McapTables(folder, placement)


FORMATS: dict[str, Callable[[Path, Placement], Tables]] = {
    "csv": partial(TableFiles, "csv"),
    "npz": partial(TableFiles, "npz"),
    "parquet": partial(TableFiles, "parquet"),
    "mcap": _mcap,
}


def check_format(name: str) -> None:
    """Raise InputError for an unknown format."""
    if name not in FORMATS:
        raise InputError("wrong-value", place=Argument("format"), value=name[:40], names=list(FORMATS))
