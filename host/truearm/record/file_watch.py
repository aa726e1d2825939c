"""Detect when other programs or people delete, rename, replace, truncate or overwrite a session's file while it is being
written.

A POSIX system keeps a deleted file for as long as it is open, so all of it can still be copied elsewhere. Data lost by
a truncation cannot be recovered.
"""

from __future__ import annotations

import os
import tempfile
import zlib
from collections.abc import Callable
from contextlib import suppress
from enum import StrEnum
from itertools import count
from pathlib import Path
from typing import BinaryIO

from truearm.errors import WriteError
from truearm.file_names import system_reason
from truearm.files.write_lock import hold

COPIED_BYTES = 1 << 20  # per step


class FileLoss(StrEnum):
    """What happened to an open file."""

    TRUNCATED = "truncated"
    DELETED = "deleted"
    REPLACED = "replaced"
    RENAMED = "renamed"


def file_loss(file: BinaryIO, path: Path, size: int) -> FileLoss | None:
    """Return what happened to ``file``, opened at ``path`` with ``size`` bytes written; None if it is unchanged."""
    own = os.fstat(file.fileno())
    if own.st_size < size:
        return FileLoss.TRUNCATED
    try:
        there = path.stat()
    except OSError:
        return FileLoss.DELETED if own.st_nlink == 0 else FileLoss.RENAMED
    return None if os.path.samestat(own, there) else FileLoss.REPLACED


def rescued_file(path: Path, fill: Callable[[BinaryIO], None]) -> tuple[Path, BinaryIO]:
    """Create a new file, open for reading and writing, named after ``path``, and fill it: ``session-rescued.mcap``,
    ``session-rescued-2.mcap`` …

    It is in the folder of ``path``, which is created again if it was removed. If that is impossible or its disk is full,
    it is in the system's folder for temporary files. Raises OSError or WriteError if it cannot be written there either. A
    file that could not be filled is removed.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        return _filled(path, fill)
    except (OSError, WriteError):
        return _filled(Path(tempfile.gettempdir()) / path.name, fill)


def _filled(path: Path, fill: Callable[[BinaryIO], None]) -> tuple[Path, BinaryIO]:
    for number in count(1):
        out = path.with_name(f"{path.stem}-rescued{'' if number == 1 else f'-{number}'}{path.suffix}")
        try:
            file = out.open("x+b")
            break
        except FileExistsError:
            continue
        except OSError as exc:
            raise WriteError(f"{out}: cannot be written: {system_reason(exc)}", exc.strerror or "") from exc
    hold(file)
    try:
        fill(file)
    except OSError:
        out.unlink()
        with suppress(OSError):  # a full disk refuses the same bytes again
            file.close()
        raise
    return out, file


def copy_open_file(file: BinaryIO, size: int, out: BinaryIO) -> None:
    """Copy the first ``size`` bytes of an open file to the disk, whether or not it still has a name. Raises OSError."""
    file.seek(0)
    while size:
        data = file.read(min(COPIED_BYTES, size))
        if not data:
            raise OSError(None, "the file became shorter")
        out.write(data)
        size -= len(data)
    out.flush()
    os.fsync(out.fileno())


def content_crc(file: BinaryIO, size: int) -> int | None:
    """Return the CRC-32 of the first ``size`` bytes of an open file, None if it is shorter. Takes about 1 s per GB."""
    file.seek(0)
    crc = 0
    while size:
        data = file.read(min(COPIED_BYTES, size))
        if not data:
            return None
        crc = zlib.crc32(data, crc)
        size -= len(data)
    return crc
