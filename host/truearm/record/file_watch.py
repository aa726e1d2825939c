"""Detect when other programs or people delete, rename, replace, truncate or overwrite a session's file while it is being
written.

A POSIX system keeps a deleted file for as long as it is open, so all of it can still be copied elsewhere. Data lost by
a truncation cannot be recovered.
"""

from __future__ import annotations

import os
import tempfile
import zlib
from collections.abc import Iterator
from contextlib import suppress
from functools import reduce
from itertools import count
from pathlib import Path
from typing import BinaryIO

from truearm.record.write_lock import hold

COPIED_BYTES = 1 << 20  # per step


def file_loss(file: BinaryIO, path: Path, size: int) -> str:
    """Return what happened to ``file``, opened at ``path`` with ``size`` bytes written; "" if nothing.

    It is "truncated", "renamed", "deleted" or "replaced".
    """
    status = os.fstat(file.fileno())
    if status.st_size < size:
        return "truncated"
    try:
        return "" if os.path.samestat(status, path.stat()) else "replaced"
    except OSError:
        return "renamed" if status.st_nlink else "deleted"


def rescued_file(file: BinaryIO, size: int, path: Path) -> tuple[Path, BinaryIO]:
    """Copy the first ``size`` bytes of an open file, whether or not it still has a name, to a new one named after ``path``:
    ``session-rescued.mcap``, ``session-rescued-2.mcap`` …

    It is in the folder of ``path``, which is created again if it was removed. If that is impossible or its disk is full,
    it is in the system's folder for temporary files. Raises OSError if it cannot be written there either. A copy that is
    not complete is removed.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        return _copied(file, size, path)
    except OSError:
        return _copied(file, size, Path(tempfile.gettempdir()) / path.name)


def _copied(file: BinaryIO, size: int, path: Path) -> tuple[Path, BinaryIO]:
    names = (f"{path.stem}-rescued{'' if number == 1 else f'-{number}'}{path.suffix}" for number in count(1))
    out = next(path.with_name(name) for name in names if not path.with_name(name).exists())
    copy = out.open("x+b")
    hold(copy)
    try:
        for data in _pieces(file, size):
            copy.write(data)
        copy.flush()
        os.fsync(copy.fileno())
    except OSError:
        out.unlink()
        with suppress(OSError):  # a full disk refuses the same bytes again
            copy.close()
        raise
    return out, copy


def _pieces(file: BinaryIO, size: int) -> Iterator[bytes]:
    """Yield the first ``size`` bytes of an open file. Raises OSError if it is shorter."""
    file.seek(0)
    while size:
        data = file.read(min(COPIED_BYTES, size))
        if not data:
            raise OSError(None, "the file became shorter")
        yield data
        size -= len(data)


def content_crc(file: BinaryIO, size: int) -> int:
    """Return the CRC-32 of the first ``size`` bytes of an open file. Takes about 1 s per GB. Raises OSError if it is shorter."""
    return reduce(lambda crc, data: zlib.crc32(data, crc), _pieces(file, size), 0)
