"""What writers of tables of columns have in common (``files.column_writers``, ``files.mcap_tables``)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

from numpy.typing import NDArray

Columns = Mapping[str, NDArray[Any]]  # titles and columns of equal length


class Placement(NamedTuple):
    """For files of messages in time: UTC minus the host's clock, the start of the session on that clock [ns], and the
    highest wanted rate.

    The rate is in samples per second for each stream; 0 keeps all samples.
    """

    utc_offset_ns: int = 0
    begin_ns: int = 0
    rate_hz: float = 0.0


class ColumnTable(ABC):
    """A table that is being written; ``rows`` is the number of rows so far, of the ``session_rows`` that the session has.
    Raises OSError if the disk refuses a write.

    It is created from the first batch, which defines titles and types. That batch is not written yet.
    """

    def __init__(self) -> None:
        self.rows = 0
        self.session_rows = 0

    def write(self, columns: Columns) -> None:
        """Append a batch with the titles and types of the first."""
        self.rows += self._write(columns)
        self.session_rows += len(next(iter(columns.values())))

    @abstractmethod
    def _write(self, columns: Columns) -> int:
        """Write a batch and return the number of rows written."""

    @abstractmethod
    def close(self) -> None:
        """Complete the table."""


class Tables(Protocol):
    """All tables of a folder."""

    def begin(self, name: str, columns: Columns) -> tuple[str, ColumnTable]:
        """Return the name under which a table is stored, and the table; ``columns`` is its first batch."""

    def close(self) -> None:
        """Complete the parts that the tables share."""
