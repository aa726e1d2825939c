"""A session's tables as JSON messages with schemas in one MCAP file, for plotting in Foxglove and PlotJuggler on one
axis.

Each table is a channel and each row a message. The log time is the time of the row on the host's clock, as UTC. A JSON
schema gives each property one type, and unknown numbers are omitted from their message.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import IO, Any

import msgspec
import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from truearm.files.column_tables import Columns, ColumnTable, Placement
from truearm.units import NS

FILE = "session.mcap"
# The time of a row on the host's clock is the first of these columns that a table has.
TIMES = ("host_time_ns", "host_start_ns", "arrival_ns", "time_s")
UNKNOWN = -1  # the time of a row that has none: it is placed at the start of the session
TYPES = {"i": "integer", "u": "integer", "f": "number", "U": "string"}
CHUNK_BYTES = 1 << 20

_encoder = msgspec.json.Encoder()


class McapTables:
    """One file for all tables. Samples and joint readings are thinned to the wanted rate; other tables are complete."""

    def __init__(self, folder: Path, placement: Placement) -> None:
        self.placement = placement
        self._file: IO[bytes] = (folder / FILE).open("wb")
        self.writer = Writer(
            self._file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD, enable_data_crcs=True
        )
        self.writer.start(profile="", library="truearm session export")

    def begin(self, name: str, columns: Columns) -> tuple[str, ColumnTable]:
        """Return the name under which a table is stored, and the table."""
        return f"{FILE} /{name}", McapTable(self, name, columns)

    def close(self) -> None:
        """Complete the file."""
        self.writer.finish()
        self._file.close()


class McapTable(ColumnTable):
    """A table as a channel of the file."""

    def __init__(self, tables: McapTables, name: str, columns: Columns) -> None:
        super().__init__()
        self._writer, self._placement = tables.writer, tables.placement
        schema = {
            "type": "object",
            "properties": {title: {"type": TYPES[column.dtype.kind]} for title, column in columns.items()},
        }
        registered = self._writer.register_schema(f"truearm/{name}", "jsonschema", json.dumps(schema).encode())
        self._channel = self._writer.register_channel(f"/{name}", "json", registered)
        self._time = next((title for title in TIMES if title in columns), "")
        self._dense = self._time == "host_time_ns" and bool({"gap", "controller_time_s"} & columns.keys())
        self._latest_bin = -1

    def _write(self, columns: Columns) -> int:
        n = len(next(iter(columns.values())))
        times = _times_ns(columns[self._time]) if self._time else np.full(n, UNKNOWN)
        rows = np.arange(n)
        if self._dense and self._placement.rate_hz:
            rows = self._thinned(columns, times)
        cells = [(title, column[rows].tolist()) for title, column in columns.items()]
        missing = [
            title for title, column in columns.items() if column.dtype.kind == "f" and np.isnan(column[rows]).any()
        ]
        for k, at in enumerate(times[rows].tolist()):
            row: dict[str, Any] = {title: values[k] for title, values in cells}
            for title in missing:
                if row[title] != row[title]:
                    del row[title]
            log_ns = max(0, (self._placement.begin_ns if at < 0 else at) + self._placement.utc_offset_ns)
            self._writer.add_message(self._channel, log_ns, _encoder.encode(row), log_ns)
        return len(rows)

    def _thinned(self, columns: Columns, times: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the first row of each interval at the wanted rate, and every row after a gap."""
        bins = (times * (1e-9 * self._placement.rate_hz)).astype(np.int64)
        kept = np.diff(bins, prepend=self._latest_bin) != 0
        self._latest_bin = int(bins[-1])
        if "gap" in columns:
            kept |= columns["gap"] == 1
        return np.flatnonzero(kept)

    def close(self) -> None:
        """Do nothing; see ``McapTables.close``, which completes the file."""


def _times_ns(column: NDArray[Any]) -> NDArray[np.int64]:
    """Return a column of times as nanoseconds on the host's clock; UNKNOWN for NaN. Floats are seconds."""
    if column.dtype.kind != "f":
        return column.astype(np.int64)
    return np.rint(np.where(np.isnan(column), UNKNOWN, NS.of(column))).astype(np.int64)
