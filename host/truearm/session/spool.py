"""Keep arrays of a session in a temporary file until it is known which of them are needed.

A session may hold more samples than fit in memory. The file lies in the folder for temporary files (``TMPDIR``), has no
name, and takes about as much space as the session.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from truearm.errors import SessionError
from truearm.file_names import system_reason

IN_MEMORY_BYTES = 1 << 20


class Spool:
    """Arrays that belong together, by number, in the order in which they were added.

    ``spans``: the segment of each number, and its first and last time.
    """

    def __init__(self) -> None:
        self.spans: list[tuple[int, float, float]] = []
        self._file = tempfile.SpooledTemporaryFile(max_size=IN_MEMORY_BYTES)
        self._layouts: list[tuple[int, list[tuple[np.dtype[Any], tuple[int, ...]]]]] = []

    def append(self, arrays: Sequence[NDArray[Any]], span: tuple[int, float, float]) -> None:
        """Add arrays. Raises SessionError if the disk is full."""
        try:
            self._layouts.append((self._file.seek(0, 2), [(array.dtype, array.shape) for array in arrays]))
            self._file.write(b"".join(array.tobytes() for array in arrays))
        except OSError as exc:
            raise SessionError(
                f"{tempfile.gettempdir()}: the samples cannot be kept here while the session is read: "
                f"{system_reason(exc)}; set TMPDIR to a folder with more space"
            ) from exc
        self.spans.append(span)

    def load(self, number: int) -> list[NDArray[Any]]:
        """Return the arrays with a number."""
        begin, layout = self._layouts[number]
        self._file.seek(begin)
        return [np.frombuffer(self._file.read(d.itemsize * prod(shape)), d).reshape(shape) for d, shape in layout]
