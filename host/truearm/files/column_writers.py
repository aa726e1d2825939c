"""Tables of columns on disk, written batch by batch: CSV, NumPy's .npz, Parquet. Every number comes back bit for bit.

Memory holds one batch. An .npz has all columns one after the other, so each waits in a temporary file until the table ends; its columns of
text are held in memory, which is why only small tables should have such.
"""

from __future__ import annotations

import csv
import math
import shutil
import tempfile
import zipfile
from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from truearm.errors import Argument, InputError

_encoder = msgspec.json.Encoder()

Columns = Mapping[str, NDArray[Any]]  # titles and columns of equal length


class Table(ABC):
    """A table under way; ``rows`` were written so far. ``close`` completes it. OSError where the disk refuses.

    Made with the file's path and the first batch, which says titles and types and is not yet written.
    """

    def __init__(self, path: Path, columns: Columns) -> None:
        self.rows = 0

    def write(self, columns: Columns) -> None:
        """Append a batch; titles and types are those of the first."""
        self._write(columns)
        self.rows += len(next(iter(columns.values())))

    @abstractmethod
    def _write(self, columns: Columns) -> None: ...

    @abstractmethod
    def close(self) -> None:
        """Complete the file."""


class CsvTable(Table):
    """UTF-8, a header; floats in the fewest digits that give the same number again, an empty cell for NaN."""

    def __init__(self, path: Path, columns: Columns) -> None:
        super().__init__(path, columns)
        self._file = path.open("w", encoding="utf-8", newline="")
        self._writer = csv.writer(self._file, lineterminator="\n")
        self._writer.writerow(columns)

    def _write(self, columns: Columns) -> None:
        if all(_is_plain(column) for column in columns.values()):
            self._file.write(_rows(columns))
        else:
            self._writer.writerows(zip(*(_cells(column) for column in columns.values()), strict=True))

    def close(self) -> None:
        self._file.close()


def _is_plain(column: NDArray[Any]) -> bool:
    """Whether all cells are numbers that JSON has, or NaN."""
    return column.dtype.kind in "iu" or (column.dtype.kind == "f" and not np.isinf(column).any())


def _rows(columns: Columns) -> str:
    """Rows of numbers, by an encoder of JSON: 1.3 µs for 17 columns, where the csv module takes 5."""
    rows = list(zip(*(column.tolist() for column in columns.values()), strict=True))
    text = _encoder.encode_lines(rows).translate(None, b"[]").decode()
    missing = any(column.dtype.kind == "f" and np.isnan(column).any() for column in columns.values())
    return text.replace("null", "") if missing else text


def _cells(column: NDArray[Any]) -> list[Any]:
    values: list[Any] = column.tolist()
    if column.dtype.kind == "f" and np.isnan(column).any():
        return ["" if math.isnan(value) else value for value in values]
    return values


class NpzTable(Table):
    """An array a title, as ``numpy.load`` reads it without pickling."""

    def __init__(self, path: Path, columns: Columns) -> None:
        super().__init__(path, columns)
        self._path = path
        self._dtypes = {title: column.dtype for title, column in columns.items()}
        self._texts: dict[str, list[NDArray[Any]]] = {}
        self._files: dict[str, IO[bytes]] = {}
        for title, dtype in self._dtypes.items():
            if dtype.kind == "U":
                self._texts[title] = []
            else:
                self._files[title] = tempfile.TemporaryFile(dir=path.parent)

    def _write(self, columns: Columns) -> None:
        for title, column in columns.items():
            if title in self._texts:
                self._texts[title].append(column)
            else:
                self._files[title].write(np.ascontiguousarray(column, self._dtypes[title]).data)

    def close(self) -> None:
        with zipfile.ZipFile(self._path, "w") as archive:
            for title, dtype in self._dtypes.items():
                with archive.open(f"{title}.npy", "w", force_zip64=True) as member:
                    if title in self._texts:
                        np.lib.format.write_array(member, np.concatenate(self._texts[title]), allow_pickle=False)
                    else:
                        self._copy(title, dtype, member)

    def _copy(self, title: str, dtype: np.dtype[Any], member: IO[bytes]) -> None:
        description = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": (self.rows,)}
        np.lib.format.write_array_header_1_0(member, description)
        with self._files[title] as file:
            file.seek(0)
            shutil.copyfileobj(file, member, 1 << 20)


class ParquetTable(Table):
    """Parquet by pyarrow, which is an extra: ``pip install 'truearm[parquet]'``."""

    def __init__(self, path: Path, columns: Columns) -> None:
        import pyarrow
        from pyarrow import parquet

        super().__init__(path, columns)
        self._pyarrow = pyarrow
        self._schema = self._batch(columns).schema
        self._writer = parquet.ParquetWriter(path, self._schema, compression="zstd")

    def _write(self, columns: Columns) -> None:
        self._writer.write_table(self._batch(columns).cast(self._schema))

    def close(self) -> None:
        self._writer.close()

    def _batch(self, columns: Columns) -> Any:
        return self._pyarrow.table(
            {
                title: self._pyarrow.array(
                    column.tolist() if column.dtype.kind == "U" else np.ascontiguousarray(column)
                )
                for title, column in columns.items()
            }
        )


FORMATS: dict[str, type[Table]] = {"csv": CsvTable, "npz": NpzTable, "parquet": ParquetTable}


def check_format(name: str) -> None:
    """Raise InputError for a format that is none or lacks its library."""
    if name not in FORMATS:
        raise InputError(Argument("format"), f" {name[:40]!r} is none of {', '.join(FORMATS)}")
    if name == "parquet":
        try:
            import pyarrow.parquet  # noqa: F401
        except ImportError as exc:
            raise InputError(
                Argument("format"), " parquet needs pyarrow: pip install 'truearm[parquet]', or give csv or npz"
            ) from exc
