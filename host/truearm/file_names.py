"""Files in messages: what to say of one that does not exist, and what to do if the system refuses one."""

from __future__ import annotations

import difflib
import errno
from itertools import islice
from pathlib import Path

MOST_NAMES = 10_000  # of a folder that are compared


def no_such_file(path: Path) -> str:
    """Return the message for a file that does not exist: the name that was probably meant, or what to check."""
    folder = path.parent
    try:
        if not folder.is_dir():
            return f"{path}: no such file, because the folder {folder} does not exist; check the path"
        names = [one.name for one in islice(folder.iterdir(), MOST_NAMES) if one.name != path.name]
        if path.suffix:  # "results" is a folder, not what "result.json" should have been
            names = [name for name in names if not (folder / name).is_dir()]
    except OSError:  # a folder that may not be listed
        names = []
    if close := difflib.get_close_matches(path.name, names, n=1, cutoff=0.75):
        return f"{path}: no such file; did you mean {folder / close[0]}?"
    return f"{path}: no such file; check its name and folder"


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
