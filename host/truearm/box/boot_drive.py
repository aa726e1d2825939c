"""Find, check and write the USB drive presented by the chip's boot ROM."""

from __future__ import annotations

import os
import re
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeVar

from truearm.box.uf2 import Image
from truearm.disk import read_text
from truearm.errors import InputError, LinkError

T = TypeVar("T")

INFO = "INFO_UF2.TXT"
_INFO_MAX = 4096
_POLL_S = 0.2
# Where systems mount a drive with that label, as patterns below the root.
_MOUNTS = ("media/*/{0}*", "run/media/*/{0}*", "media/{0}*", "mnt/{0}*", "Volumes/{0}*")


def find_drives(board: str, root: Path = Path("/")) -> list[Path]:
    """Return the boot drives of a board at the usual mount points."""
    if sys.platform == "win32":
        places: Iterable[Path] = (Path(f"{letter}:/") for letter in "DEFGHIJKLMNOPQRSTUVWXYZ")
    else:
        places = (place for pattern in _MOUNTS for place in sorted(root.glob(pattern.format(board))))
    return [place for place in places if board_of(place) == board]


def board_of(drive: Path) -> str | None:
    """Return the board that a boot drive states, such as "RPI-RP2"; None if a folder is not a boot drive."""
    try:
        text = read_text(drive / INFO, _INFO_MAX, InputError)
    except InputError:  # missing, not (yet) readable, or not text
        return None
    match = re.search(r"^Board-ID:(.*)$", text, re.MULTILINE)
    return match[1].strip() if match else None


def check_drive(drive: Path, image: Image) -> None:
    """Raise InputError unless ``drive`` is a boot drive of the image's chip."""
    board = board_of(drive)
    if board is None:
        raise InputError(
            f"{drive}: is not a boot drive ({INFO} is not there); hold BOOTSEL while you plug the box in, and mount the drive"
        )
    if board != image.chip.board:
        raise InputError(
            f"{drive}: is the boot drive of a {board[:40]!r}, the image is for {image.chip.board}; give an image for this board"
        )


def wait_for(find: Callable[[], T | None], timeout_s: float) -> T | None:
    """Return what ``find`` returns within the given time; it is called at least once."""
    deadline = time.monotonic() + timeout_s
    while (result := find()) is None and time.monotonic() < deadline:
        time.sleep(_POLL_S)
    return result


def write_image(image: Image, drive: Path, name: str) -> None:
    """Write a checked image to the drive as file ``name``. Raises InputError, LinkError.

    The chip restarts as soon as it has the last block, so the drive may be gone before the system has closed the file.
    An error therefore counts only while the drive is still there.
    """
    check_drive(drive, image)
    try:
        with (drive / name).open("wb") as file:
            file.write(image.data)
            file.flush()
            os.fsync(file.fileno())
    except OSError as exc:
        if board_of(drive) is not None:
            raise LinkError(f"{drive}: cannot be written ({exc.strerror}); check its permissions") from exc
