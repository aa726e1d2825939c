"""The process that writes a file holds a lock on it, so that other programs can see whether a recording is still
running.

The lock is the operating system's (``flock``): it is released when the process ends, in whatever way. It prevents
nobody from reading or deleting the file. If the system has no locks, or a network drive refuses them, a file that was
written to recently counts as held.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import BinaryIO

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

A_MOMENT_S = 5.0  # a recorder writes every second


def hold(file: BinaryIO) -> bool:
    """Hold a file that is open for writing until it is closed; return False if another process holds it."""
    if fcntl is not None:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        except OSError:  # a drive without locks: the recording continues
            pass
    return True


def is_held(path: Path) -> bool:
    """Return whether some process is writing to a file."""
    if fcntl is not None:
        try:
            with path.open("rb") as file:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            return False
        except BlockingIOError:
            return True
        except OSError:
            pass
    return time.time() - path.stat().st_mtime < A_MOMENT_S
