"""Read UF2 images for the box's chip as untrusted files and check them before anything is written.

A UF2 file is a sequence of 512-byte blocks: eight words, 476 bytes of data, and a third magic number
(github.com/microsoft/uf2). The words are two magic numbers, flags, address, size of the data, number of this block,
number of blocks, and family of the chip. The chip's boot ROM writes what it receives without checks and skips what it
does not understand, so a damaged file leaves a box that does not start. Here every block must be valid: of the chip's
family, complete, in order, and without a gap from the start of its flash. The boot stage in the first 256 bytes must
have the checksum without which the ROM does not start it (RP2040 datasheet, 2.8.1.3.1).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from truearm.disk import read_bytes
from truearm.errors import ImageError

BLOCK = 512
PAGE = 256  # bytes of data in a block; the ROM accepts no other size
_MAGIC = (0x0A324655, 0x9E5D5157)
_MAGIC_END = 0x0AB16F30
_NOT_MAIN_FLASH, _FAMILY_PRESENT = 0x1, 0x2000
_WORDS = ("flags", "address", "size", "number", "count", "family")
_LAYOUT = np.dtype([("magic", "<u4", 2), *((name, "<u4") for name in _WORDS), ("data", "V476"), ("end", "<u4")])
_MARK = b"truearm_box"  # the package's name occurs in every image with frozen firmware
_VERSION = re.compile(rb"truearm_box (\d{1,4}\.\d{1,4}\.\d{1,4})\b")  # MARK of truearm_wire/version.py


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
