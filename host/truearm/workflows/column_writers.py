"""Write tables of columns to disk in batches: CSV, NumPy's .npz, Parquet. Numbers are stored bit for bit.

All are written as Parquet first, and converted when the table ends. Memory holds one batch.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Columns = Mapping[str, NDArray[Any]]  # titles and columns of equal length


class ArrowTable:
    """A table that is being written to a file named .parquet, .csv or .npz; ``rows`` is the number of rows so far.

    The first batch defines titles and types, and is not written yet. CSV: UTF-8 with a header; floats in the fewest
    digits that give the same number again; an empty cell for NaN. .npz: one array per title, readable by ``numpy.load``
    without pickling. Raises OSError if the disk refuses a write.
    """

    def __init__(self, path: Path, columns: Columns) -> None:
        from pyarrow import parquet

        self.rows = 0
        self._path, self._parquet = path, path.with_suffix(".parquet")
        self._schema = _arrow(columns).schema
        # Measured numbers hardly repeat: looking for repetitions makes files larger and takes a third of the time.
        texts = [title for title, column in columns.items() if column.dtype.kind == "U"]
        self._writer = parquet.ParquetWriter(self._parquet, self._schema, compression="zstd", use_dictionary=texts)

    def write(self, columns: Columns) -> None:
        """Append a batch with the titles and types of the first."""
        table = _arrow(columns).cast(self._schema)
        self._writer.write_table(table)
        self.rows += int(table.num_rows)

    def close(self) -> None:
        """Complete the file."""
        self._writer.close()
        if self._path != self._parquet:
            (_write_csv if self._path.suffix == ".csv" else _write_npz)(self._parquet, self._path)
            self._parquet.unlink()


def _arrow(columns: Columns) -> Any:
    import pyarrow

    def array(column: NDArray[Any]) -> Any:
        if column.dtype.kind == "U":
            return pyarrow.array(column.tolist(), pyarrow.string())
        return pyarrow.array(np.ascontiguousarray(column))

    return pyarrow.table({title: array(column) for title, column in columns.items()})


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
    import pyarrow
    from pyarrow import compute, parquet, types

    with zipfile.ZipFile(path, "w") as archive, parquet.ParquetFile(source) as file:
        for field in file.schema_arrow:
            if types.is_string(field.type):
                lengths = (compute.max(compute.utf8_length(piece)).as_py() or 0 for piece in _pieces(file, field.name))
                dtype = np.dtype(f"U{max([1, *lengths])}")
            else:
                dtype = pyarrow.array([], field.type).to_numpy(zero_copy_only=False).dtype
            header = {"descr": dtype.str, "fortran_order": False, "shape": (file.metadata.num_rows,)}
            with archive.open(f"{field.name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array_header_1_0(member, header)
                for piece in _pieces(file, field.name):
                    member.write(piece.to_numpy(zero_copy_only=False).astype(dtype).tobytes())


def _pieces(file: Any, title: str) -> Iterator[Any]:
    """Yield a column of a Parquet file batch by batch."""
    return (batch.column(0) for batch in file.iter_batches(columns=[title]))
