"""What becomes of a session's file while it is written: other programs and people delete, rename, replace and truncate files.

A POSIX system keeps a deleted file for as long as it is open, so all of it can still be copied elsewhere. What a truncation took is gone.
"""

from __future__ import annotations

import os
from enum import StrEnum
from pathlib import Path
from typing import BinaryIO

from truearm.errors import WriteError

COPIED_BYTES = 1 << 20  # at once


class FileLoss(StrEnum):
    """What became of an open file."""

    TRUNCATED = "truncated"
    DELETED = "deleted"
    REPLACED = "replaced"
    RENAMED = "renamed"


def file_loss(file: BinaryIO, path: Path, size: int) -> FileLoss | None:
    """What became of ``file``, which was opened at ``path`` and has had ``size`` bytes on the disk; None: it is where it was."""
    own = os.fstat(file.fileno())
    if own.st_size < size:
        return FileLoss.TRUNCATED
    try:
        there = path.stat()
    except OSError:
        return FileLoss.DELETED if own.st_nlink == 0 else FileLoss.RENAMED
    return None if os.path.samestat(own, there) else FileLoss.REPLACED


def new_file_beside(path: Path) -> tuple[Path, BinaryIO]:
    """A new file, open to read and write, named after ``path``: ``session-rescued.mcap``, ``session-rescued-2.mcap`` …

    Raises WriteError where it cannot be made.
    """
    number = 1
    while True:
        out = path.with_name(f"{path.stem}-rescued{'' if number == 1 else f'-{number}'}{path.suffix}")
        try:
            return out, out.open("x+b")
        except FileExistsError:
            number += 1
        except OSError as exc:
            raise WriteError(f"{out}: cannot be written: {exc.strerror}", exc.strerror or "") from exc


def copy_open_file(file: BinaryIO, size: int, out: BinaryIO) -> None:
    """Copy the first ``size`` bytes of an open file, whether it still has a name or not. Raises OSError."""
    file.seek(0)
    while size:
        data = file.read(min(COPIED_BYTES, size))
        if not data:
            raise OSError(None, "the file became shorter")
        out.write(data)
        size -= len(data)
    out.flush()
