"""The drive as which the chip's boot ROM shows itself on USB: found, checked and written to."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path

from truearm.box.uf2 import Image
from truearm.errors import InputError, LinkError
from truearm.files.disk import read_text

INFO = "INFO_UF2.TXT"
_INFO_MAX = 4096
_POLL_S = 0.2
# Where systems mount a drive of that label, each a pattern below the root.
_MOUNTS = ("media/*/{0}*", "run/media/*/{0}*", "media/{0}*", "mnt/{0}*", "Volumes/{0}*")


def find_drives(board: str, root: Path = Path("/")) -> list[Path]:
    """The boot drives of a board at the usual mount points."""
    if sys.platform == "win32":
        places: Iterable[Path] = (Path(f"{letter}:/") for letter in "DEFGHIJKLMNOPQRSTUVWXYZ")
    else:
        places = (place for pattern in _MOUNTS for place in sorted(root.glob(pattern.format(board))))
    return [place for place in places if board_of(place) == board]


def board_of(drive: Path) -> str | None:
    """What the boot drive says that it is the drive of, "RPI-RP2"; None where a folder is no boot drive."""
    try:
        text = read_text(drive / INFO, _INFO_MAX, InputError)
    except InputError:  # not there, not readable (yet), or no text
        return None
    for line in text.splitlines():
        key, _, value = line.partition(":")
        if key.strip() == "Board-ID":
            return value.strip()
    return None


def check_drive(drive: Path, image: Image) -> None:
    """Raises InputError unless ``drive`` is a boot drive of the image's chip."""
    board = board_of(drive)
    if board is None:
        raise InputError(
            f"{drive}: is no boot drive ({INFO} is not there); hold BOOTSEL while you plug the box in, and mount the drive"
        )
    if board != image.chip.board:
        raise InputError(f"{drive}: is the boot drive of a {board[:40]!r}, the image is for {image.chip.board}")


def wait_for(find: Callable[[], Path | None], timeout_s: float) -> Path | None:
    """What ``find`` finds within that time."""
    deadline = time.monotonic() + timeout_s
    while (found := find()) is None and time.monotonic() < deadline:
        time.sleep(_POLL_S)
    return found


def write_image(image: Image, drive: Path, name: str) -> None:
    """Write a judged image as the file ``name`` onto the drive. Raises InputError, LinkError.

    The chip restarts as soon as it has the last block, so the drive may be gone before the system has closed the file;
    an error is one only while the drive is still there.
    """
    check_drive(drive, image)
    try:
        with (drive / name).open("wb") as file:
            file.write(image.data)
            file.flush()
            os.fsync(file.fileno())
    except OSError as exc:
        if board_of(drive) is not None:
            raise LinkError(f"{drive}: cannot be written ({exc.strerror}); may you write there?") from exc
