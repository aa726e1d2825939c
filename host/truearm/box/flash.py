"""Write the firmware to a box by its boot drive, and wait for its answer (``truearm box flash``).

UF2 images are untrusted files, checked before anything is written. A UF2 file is a sequence of 512-byte blocks: eight
words, 476 bytes of data, and a third magic number (github.com/microsoft/uf2). The words are two magic numbers, flags,
address, size of the data, number of this block, number of blocks, and family of the chip. The chip's boot ROM writes
what it receives without checks and skips what it does not understand, so a damaged file leaves a box that does not
start. Here every block must be valid: of the chip's family, complete, in order, and without a gap from the start of its
flash. The boot stage in the first 256 bytes must have the checksum without which the ROM does not start it (RP2040
datasheet, 2.8.1.3.1).
"""

from __future__ import annotations

import os
import re
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from truearm.box.control import conversation, one_line_of
from truearm.box.requests import FlashOptions
from truearm.disk import read_bytes, read_text
from truearm.errors import Argument, ImageError, InputError, LinkError
from truearm.findings import Finding
from truearm.progress import step
from truearm.record.links import usb_ports
from truearm.session.frames import Ident
from truearm.version import VERSION
from truearm_wire.messages import BOOT_LOADER

BLOCK = 512
PAGE = 256  # bytes of data in a block; the ROM accepts no other size
_MAGIC = (0x0A324655, 0x9E5D5157)
_MAGIC_END = 0x0AB16F30
_NOT_MAIN_FLASH, _FAMILY_PRESENT = 0x1, 0x2000
_WORDS = ("flags", "address", "size", "number", "count", "family")
_LAYOUT = np.dtype([("magic", "<u4", 2), *((name, "<u4") for name in _WORDS), ("data", "V476"), ("end", "<u4")])
_MARK = b"truearm_box"  # the package's name occurs in every image with frozen firmware
_VERSION = re.compile(rb"truearm_box (\d{1,4}\.\d{1,4}\.\d{1,4})\b")  # MARK of truearm_wire/version.py
T = TypeVar("T")

INFO = "INFO_UF2.TXT"
_INFO_MAX = 4096
_POLL_S = 0.2
# Where systems mount a drive with that label, as patterns below the root.
_MOUNTS = ("media/*/{0}*", "run/media/*/{0}*", "media/{0}*", "mnt/{0}*", "Volumes/{0}*")
_SHORT = 4  # attempts of half a second, repeated


@dataclass(frozen=True)
class Chip:
    """Properties of a chip family: ``flash`` bytes from ``start`` on; ``board`` is the name shown by its boot drive."""

    name: str
    start: int
    flash: int
    board: str


CHIPS = {0xE48BFF56: Chip("RP2040", 0x1000_0000, 2 << 20, "RPI-RP2")}
MAX_BYTES = max(chip.flash for chip in CHIPS.values()) // PAGE * BLOCK


@dataclass(frozen=True)
class Image:
    """A checked image.

    ``size``: bytes of flash that it takes. ``is_box``: it contains the box's firmware. ``version``: of that firmware,
    or "".
    """

    chip: Chip
    blocks: int
    size: int
    is_box: bool
    version: str
    data: bytes  # the contents of the file


def read_uf2(path: Path) -> Image:
    """Return the image in a file. Raises ImageError."""
    return parse_uf2(read_bytes(path, MAX_BYTES, ImageError), str(path))


def parse_uf2(data: bytes, name: str) -> Image:
    """Return the image in the bytes of a UF2 file. Raises ImageError, which refers to the file as ``name``."""
    if not data or len(data) % BLOCK:
        raise ImageError(
            f"{name}: is {len(data)} bytes long, not a whole number of UF2 blocks of {BLOCK}; get the file again"
        )
    if len(data) > MAX_BYTES:
        raise ImageError(f"{name}: is larger than the chip's flash; give an image of the box's firmware")
    blocks = np.frombuffer(data, _LAYOUT)
    is_intact = (blocks["magic"] == _MAGIC).all(axis=1) & (blocks["end"] == _MAGIC_END)
    if not is_intact[0]:
        raise ImageError(f"{name}: is not a UF2 file; give an image of the box's firmware")
    chip = _chip(blocks[0], name)
    numbers = np.arange(len(blocks))
    in_order = (blocks["number"] == numbers) & (blocks["count"] == len(blocks))
    is_main = blocks["flags"] & (_FAMILY_PRESENT | _NOT_MAIN_FLASH) == _FAMILY_PRESENT
    rules = (
        (is_intact, "is damaged"),
        (is_main & (blocks["family"] == blocks["family"][0]), f"is not for the {chip.name}'s flash"),
        (in_order, "is marked as block {number} of {count}; the file is incomplete"),
        (
            (blocks["size"] == PAGE) & (blocks["address"] == chip.start + PAGE * numbers),
            f"holds {{size}} bytes for address {{address:#x}}; the pages of {PAGE} bytes must fill the {chip.name}'s flash from its start",
        ),
    )
    for is_valid, text in rules:
        if not is_valid.all():
            k = int(is_valid.argmin())
            reason = text.format(**{word: int(blocks[word][k]) for word in _WORDS})
            raise ImageError(f"{name}: block {k} of {len(blocks)} {reason}; get the file again")
    pages = [block.tobytes()[:PAGE] for block in blocks["data"]]
    if boot_checksum(pages[0][:-4]) != int.from_bytes(pages[0][-4:], "little"):
        raise ImageError(
            f"{name}: its boot stage has a wrong checksum, so the chip would not start; get the file again"
        )
    content = b"".join(pages)
    version = _VERSION.search(content)
    return Image(chip, len(blocks), PAGE * len(blocks), _MARK in content, version[1].decode() if version else "", data)


def boot_checksum(stage: bytes) -> int:
    """Return CRC-32/MPEG-2, by which the boot ROM recognises a boot stage."""
    crc = 0xFFFFFFFF
    for byte in stage:
        crc ^= byte << 24
        for _ in range(8):
            crc = (crc << 1 ^ (0x04C11DB7 if crc >> 31 else 0)) & 0xFFFFFFFF
    return crc


def _chip(block: np.void, name: str) -> Chip:
    family = int(block["family"]) if block["flags"] & _FAMILY_PRESENT else None
    if family not in CHIPS:
        names = ", ".join(chip.name for chip in CHIPS.values())
        text = "no family" if family is None else f"family {family:#010x}"
        raise ImageError(f"{name}: is for another chip ({text}); the box has the {names}; give an image for it")
    return CHIPS[family]


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


def flash_box(options: FlashOptions) -> list[Finding]:
    """Flash a box and wait for its answer; return what was written and what answers.

    Raises InputError, ImageError, LinkError.
    """
    earlier_ports = {port.device for port in usb_ports()} - {options.box}
    path = options.image or own_image()
    image = read_uf2(path)
    drive = _drive_for(path, image, options)
    with step(f"writing {path.name}"):
        write_image(image, drive, path.name)
    written = {"image": str(path), "drive": str(drive), "chip": image.chip.name, "size": image.size // 1024}
    written |= {"other": not image.is_box, "version": image.version, "box": None}
    if options.no_check:
        return [Finding("flashed", written)]
    with step(f"waiting for the box, {options.timeout:g} s at most"):
        ident = _wait_for_box(options.box, earlier_ports, options.timeout, drive)
    other = image.version and ident.firmware != image.version
    return [
        Finding("flashed", {**written, "box": one_line_of(ident)}),
        *([Finding("other-firmware", {"image": image.version, "box": ident.firmware})] if other else []),
        *(Finding("box-fault", {"fault": fault}) for fault in ident.faults),
    ]


def own_image() -> Path:
    """Return the image of this version, from the wheel or built in this checkout by make uf2. Raises InputError."""
    package, name = Path(__file__).parent, f"truearm-{VERSION}.uf2"
    places = (package / "image" / name, package.parents[2] / "build" / "uf2" / name)
    for path in places:
        if path.is_file():
            return path
    raise InputError(f"{name} is not part of this installation; give the image to flash (make uf2 builds one)")


def _drive_for(path: Path, image: Image, options: FlashOptions) -> Path:
    """Return the boot drive to write to; a running box is first asked to present it."""
    device, drive, timeout = options.box, options.drive, options.timeout
    earlier_drives = find_drives(image.chip.board) if drive is None else []
    if device is None:
        return drive or _only(earlier_drives)
    if drive is None or board_of(drive) is None:
        with conversation(device, stop=options.stop) as box:
            box.reset(BOOT_LOADER)

    def appeared() -> Path | None:
        if drive is not None:
            return None if board_of(drive) is None else drive
        return next((place for place in find_drives(image.chip.board) if place not in earlier_drives), None)

    with step(f"waiting for the boot drive, {timeout:g} s at most"):
        boot_drive = wait_for(appeared, timeout)
    if boot_drive is None:
        raise LinkError(
            f"{device}: no boot drive appeared within {timeout:g} s; mount it and name its folder: truearm box flash {path} --drive FOLDER"
        )
    return boot_drive


def _only(drives: list[Path]) -> Path:
    if not drives:
        raise InputError(
            "no boot drive found; hold BOOTSEL while you plug the box in, name its folder with ",
            *(Argument("drive"), ", or give ", Argument("box"), " to restart a running box"),
        )
    if len(drives) > 1:
        raise InputError(
            f"there are several boot drives, {', '.join(map(str, drives))}; name one with ", Argument("drive")
        )
    return drives[0]


def _wait_for_box(device: str | None, earlier_ports: set[str], timeout: float, drive: Path) -> Ident:
    """Return the ident of the box that starts, at ``device`` or at a port that is not among ``earlier_ports``.

    Raises LinkError.
    """
    reason = ""

    def answering() -> Ident | None:
        nonlocal reason
        for place in _places(device, earlier_ports):
            try:
                with conversation(place, retries=_SHORT) as box:
                    return box.ident
            except LinkError as exc:
                reason = f" ({exc})"
        return None

    if (ident := wait_for(answering, timeout)) is None:
        raise LinkError(f"{drive}: written, but no box answered within {timeout:g} s{reason}; see truearm box list")
    return ident


def _places(device: str | None, earlier_ports: set[str]) -> list[str]:
    """Return where the box may be: its port may have another name after a restart."""
    if device is not None and ("://" in device or Path(device).exists()):
        return [device]
    return [port.device for port in usb_ports() if port.candidate and port.device not in earlier_ports]
