"""Who writes a file holds it, so that another program can tell a recording that goes on from one whose recorder was killed.

The lock is the operating system's (``flock``): it goes with the process, however that ends. Nobody is kept from reading or deleting.
Where the system has none, or a network drive refuses it, a file that was written to a moment ago counts as held.
"""

from __future__ import annotations

import time
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

A_MOMENT_S = 5.0  # a recorder writes every second


def hold(file: BinaryIO) -> None:
    """Hold a file that is open to write until it is closed."""
    if fcntl is not None:
        with suppress(OSError):  # a drive without locks, or one who reads it now: the recording goes on
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


def is_held(path: Path) -> bool:
    """Whether some process writes to a file."""
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
