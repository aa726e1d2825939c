"""Write tables of columns to disk in batches: CSV, NumPy's .npz, Parquet, MCAP messages. Numbers are stored bit for
bit.

Memory holds one batch. An .npz stores whole columns one after the other, so each column waits in a temporary file until
the table ends. Its text columns are held in memory, so only small tables should have them.
"""

from __future__ import annotations

import csv
import math
import shutil
import tempfile
import zipfile
from collections.abc import Callable, Iterable
from functools import partial
from itertools import repeat
from pathlib import Path
from typing import IO, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from truearm.errors import Argument, InputError
from truearm.files.column_tables import Columns, ColumnTable, Placement, Tables

_encoder = msgspec.json.Encoder()


class TableFiles:
    """One file per table."""

    def __init__(
        self, kind: Callable[[Path, Columns], ColumnTable], suffix: str, folder: Path, placement: Placement
    ) -> None:
        self._kind, self._suffix, self._folder = kind, suffix, folder

    def begin(self, name: str, columns: Columns) -> tuple[str, ColumnTable]:
        """See ``Tables``."""
        file = f"{name}.{self._suffix}"
        return file, self._kind(self._folder / file, columns)

    def close(self) -> None:
        """See ``Tables``."""


class CsvTable(ColumnTable):
    """UTF-8 with a header; floats in the fewest digits that give the same number again; an empty cell for NaN."""

    def __init__(self, path: Path, columns: Columns) -> None:
        super().__init__()
        self._file = path.open("w", encoding="utf-8", newline="")
        self._writer = csv.writer(self._file, lineterminator="\n")
        self._writer.writerow(columns)

    def _write(self, columns: Columns) -> int:
        if all(_is_plain(column) for column in columns.values()):
            self._file.flush()  # its buffer is written before what bypasses it
            self._file.buffer.write(_rows(columns))
        else:
            self._writer.writerows(zip(*(_cells(column) for column in columns.values()), strict=True))
        return _length(columns)

    def close(self) -> None:
        self._file.close()


def _length(columns: Columns) -> int:
    return len(next(iter(columns.values())))


def _is_plain(column: NDArray[Any]) -> bool:
    """Return whether every cell is a number that JSON can represent, or NaN."""
    return column.dtype.kind in "iu" or (column.dtype.kind == "f" and not np.isinf(column).any())


def _rows(columns: Columns) -> bytes:
    """Return rows of numbers as text by a JSON encoder: 1 µs for 17 columns; the csv module takes 5 µs."""
    rows = zip(*map(_numbers, columns.values()), strict=True)  # no list: one tuple serves all rows
    text = _encoder.encode_lines(rows).translate(None, b"[]")
    missing = any(column.dtype.kind == "f" and np.isnan(column).any() for column in columns.values())
    return text.replace(b"null", b"") if missing else text


def _numbers(column: NDArray[Any]) -> Iterable[Any]:
    """Return the numbers for the JSON encoder; text that is ready where all are the same, as a segment's are."""
    if len(column) and (column == column[:1]).all() and (column[0] or _of_one_sign(column)):
        return repeat(msgspec.Raw(_encoder.encode(column[0].item())), len(column))
    values: list[Any] = column.tolist()
    return values


def _of_one_sign(zeros: NDArray[Any]) -> bool:
    """Return whether no zero among zeros has another sign: they compare equal."""
    return zeros.dtype.kind != "f" or bool((np.signbit(zeros) == np.signbit(zeros[0])).all())


def _cells(column: NDArray[Any]) -> list[Any]:
    values: list[Any] = column.tolist()
    if column.dtype.kind == "f" and np.isnan(column).any():
        return ["" if math.isnan(value) else value for value in values]
    return values


class NpzTable(ColumnTable):
    """One array per title, readable by ``numpy.load`` without pickling."""

    def __init__(self, path: Path, columns: Columns) -> None:
        super().__init__()
        self._path = path
        self._dtypes = {title: column.dtype for title, column in columns.items()}
        self._texts: dict[str, list[NDArray[Any]]] = {}
        self._files: dict[str, IO[bytes]] = {}
        for title, dtype in self._dtypes.items():
            if dtype.kind == "U":
                self._texts[title] = []
            else:
                self._files[title] = tempfile.TemporaryFile(dir=path.parent)

    def _write(self, columns: Columns) -> int:
        for title, column in columns.items():
            if title in self._texts:
                self._texts[title].append(column)
            else:
                self._files[title].write(np.ascontiguousarray(column, self._dtypes[title]).data)
        return _length(columns)

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


class ParquetTable(ColumnTable):
    """Parquet written by pyarrow, which is an optional dependency: ``pip install 'truearm[parquet]'``."""

    def __init__(self, path: Path, columns: Columns) -> None:
        import pyarrow
        from pyarrow import parquet

        super().__init__()
        self._pyarrow = pyarrow
        self._schema = self._batch(columns).schema
        # Measured numbers hardly repeat: looking for repetitions makes files larger and takes a third of the time.
        texts = [title for title, column in columns.items() if column.dtype.kind == "U"]
        self._writer = parquet.ParquetWriter(path, self._schema, compression="zstd", use_dictionary=texts)

    def _write(self, columns: Columns) -> int:
        self._writer.write_table(self._batch(columns).cast(self._schema))
        return _length(columns)

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


def _mcap(folder: Path, placement: Placement) -> Tables:
    from truearm.files.mcap_tables import McapTables

    return McapTables(folder, placement)


FORMATS: dict[str, Callable[[Path, Placement], Tables]] = {
    "csv": partial(TableFiles, CsvTable, "csv"),
    "npz": partial(TableFiles, NpzTable, "npz"),
    "parquet": partial(TableFiles, ParquetTable, "parquet"),
    "mcap": _mcap,
}


def check_format(name: str) -> None:
    """Raise InputError for an unknown format, or one whose library is missing."""
    if name not in FORMATS:
        raise InputError("wrong-value", place=Argument("format"), value=name[:40], names=list(FORMATS))
    if name == "parquet":
        try:
            import pyarrow.parquet  # noqa: F401
        except ImportError as exc:
            raise InputError("missing-package", place="parquet", package="pyarrow", install="truearm[parquet]") from exc
