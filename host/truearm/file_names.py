"""Open external files; what to say of one that does not exist or that the system refuses."""

from __future__ import annotations

import difflib
import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedReader
from itertools import islice
from pathlib import Path

from truearm.errors import InputError, MissingFileError

MOST_NAMES = 10_000  # of a folder that are compared


def open_input(path: Path) -> BufferedReader:
    """Open a regular file for reading. Raises MissingFileError if there is none, InputError if it cannot be read."""
    if "\0" in str(path) or (os.path.exists(path) and not os.path.isfile(path)):
        raise InputError("unreadable-file", place=path)  # reading a pipe or a device would block or never end
    with reading(path):
        return path.open("rb")


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn what the system says about a file that it cannot read into InputError."""
    try:
        yield
    except FileNotFoundError as exc:
        raise missing_file(path) from exc
    except OSError as exc:
        raise InputError("unreadable-file", place=path, reason=system_reason(exc)) from exc


def missing_file(path: Path) -> MissingFileError:
    """Return the error for a file that does not exist, with the name that was probably meant."""
    folder = path.parent
    try:
        if not folder.is_dir():
            return MissingFileError("missing-file", place=path, folder=folder)
        names = [entry.name for entry in islice(folder.iterdir(), MOST_NAMES) if entry.name != path.name]
        if path.suffix:  # "results" is a folder, not what "result.json" should have been
            names = [name for name in names if not (folder / name).is_dir()]
    except OSError:  # a folder that may not be listed
        names = []
    close = difflib.get_close_matches(path.name, names, n=1, cutoff=0.75)
    meant = str(folder / close[0]) if close else ""
    return MissingFileError("missing-file", place=path, meant=meant)


DISK_FAILED = (errno.ENOSPC, errno.EDQUOT, errno.EIO)  # whatever the name of the file
_REMEDIES = {
    errno.EACCES: "change its permissions, or use another folder",
    errno.EPERM: "change its permissions, or use another folder",
    errno.EROFS: "use another folder",
    errno.ENAMETOOLONG: "use a shorter name",
    errno.ENOTDIR: "check the path: a file stands where a folder should be",
    errno.EISDIR: "give a file, not a folder",
    errno.ENOSPC: "free some space, or use another disk",
    errno.EDQUOT: "free some space, or use another disk",
    errno.EMFILE: "close other programs",
    errno.ENFILE: "close other programs",
    errno.EIO: "copy it to another disk: this one may fail",
}


def system_reason(exc: Exception) -> str:
    """Return the system's reason, and what to do about it."""
    reason, number = getattr(exc, "strerror", None) or str(exc), getattr(exc, "errno", None) or 0
    return f"{reason}; {_REMEDIES.get(number, 'check the path, the disk and its permissions')}"
