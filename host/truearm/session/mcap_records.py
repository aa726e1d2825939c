"""Records of an MCAP file, one by one and within bounds: a stranger's file may claim any size.

The records' layout is the mcap library's, which would allocate what a record claims.
"""

from __future__ import annotations

import io
import json
import struct
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import BinaryIO, NoReturn

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Metadata
from mcap.writer import MCAP0_MAGIC

from truearm.errors import Argument, SessionError

MAX_CHUNK_BYTES = 64 << 20
MAX_ATTACHMENT_BYTES = 16 << 20
MAX_METADATA_BYTES = 1 << 20
MAX_CHANNELS = 1000

CRC = "crc32"  # a key of every metadata record of ours
CHANNELS = "channels"  # the metadata record that says again which channel is which topic

RECORD = struct.Struct("<BQ")
LATEST_NS = 1 << 62  # 146 years; differences of later times would not fit int64
FOOTER_BYTES = 20
# What the library raises for a record that ends early, holds no UTF-8 or claims a length beyond 63 bits.
UNREADABLE = (McapError, struct.error, ValueError, OverflowError)
ADVICE = ("copy it again from where it was recorded, or, to use what is whole, give ", Argument("allow_damaged"))


def open_file(path: Path) -> BinaryIO:
    try:
        if path.exists() and not path.is_file():
            raise SessionError(f"{path}: is not a regular file; give a session that truearm record wrote")
        return path.open("rb")
    except FileNotFoundError as exc:
        raise SessionError(f"{path}: no such file") from exc
    except (OSError, ValueError) as exc:
        raise SessionError(f"{path}: cannot be read: {getattr(exc, 'strerror', exc)}") from exc


def records(file: BinaryIO, end: int, at: int = len(MCAP0_MAGIC)) -> Iterator[tuple[int, int, int]]:
    """Opcode, offset of the body and its length for every record from ``at`` on that is whole before ``end``.

    At each yield the file stands at the body. Raises SessionError where the file ends before ``end``.
    """
    while at + RECORD.size <= end:
        file.seek(at)
        head = file.read(RECORD.size)
        if len(head) < RECORD.size:
            raise SessionError(f"{file.name}: became shorter while it was read; read it when nobody writes it")
        opcode, length = RECORD.unpack(head)
        at += RECORD.size
        if opcode == 0 or length > end - at:  # zeros: a power cut left the file's length, not its bytes
            return
        yield opcode, at, length
        at += length


def has_footer(file: BinaryIO, size: int) -> bool:
    tail = RECORD.size + FOOTER_BYTES + len(MCAP0_MAGIC)
    file.seek(max(0, size - tail))
    data = file.read(tail)
    return data.endswith(MCAP0_MAGIC) and data.startswith(RECORD.pack(Opcode.FOOTER, FOOTER_BYTES))


def damaged(path: Path, at: int) -> NoReturn:
    raise SessionError(f"{path}: is damaged at byte {at}; ", *ADVICE)


def body_of(path: Path, file: BinaryIO, at: int, length: int, limit: int) -> bytes:
    if length > limit:
        raise SessionError(f"{path}: a record of {length} bytes at byte {at}; at most {limit} are read")
    file.seek(at)
    data = file.read(length)
    if len(data) < length:
        damaged(path, at)
    return data


def metadata_crc(name: str, entries: Mapping[str, str]) -> str:
    """What the writer puts beside the entries of a metadata record, of which MCAP itself takes no CRC."""
    texts = [name, *(text for key in sorted(entries) for text in (key, entries[key]))]
    return f"{zlib.crc32(json.dumps(texts).encode()):08x}"


def parse_metadata(path: Path, body: bytes, at: int) -> tuple[str, dict[str, str], bool]:
    """Name, entries and whether a CRC among these proves them; one that does not fit is damage."""
    try:
        record = Metadata.read(ReadDataStream(io.BytesIO(body)))
    except UNREADABLE:
        damaged(path, at)
    entries = dict(record.metadata)
    crc = entries.pop(CRC, None)
    if crc is not None and crc != metadata_crc(record.name, entries):
        damaged(path, at)
    return record.name, entries, crc is not None


def parse_attachment(path: Path, body: bytes, at: int) -> tuple[str, bytes]:
    try:
        record = Attachment.read(ReadDataStream(io.BytesIO(body)))
    except UNREADABLE:
        damaged(path, at)
    if len(body) < 4 or zlib.crc32(body[:-4]) != int.from_bytes(body[-4:], "little") != 0:
        damaged(path, at)
    return record.name, record.data


def chunk_records(path: Path, file: BinaryIO, at: int, length: int) -> bytes:
    """The records of a chunk, decompressed within bounds, its CRC checked."""
    body = body_of(path, file, at, length, MAX_CHUNK_BYTES)
    try:
        chunk = Chunk.read(ReadDataStream(io.BytesIO(body)))
        data = _decompress(chunk)
    except (*UNREADABLE, zstandard.ZstdError, RuntimeError):  # the last is what lz4 raises
        damaged(path, at)
    if data is None:
        raise SessionError(f"{path}: a chunk at byte {at} is compressed in a way, or to a size, that is not read")
    if len(data) != chunk.uncompressed_size or (chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc):
        damaged(path, at)
    return data


def _decompress(chunk: Chunk) -> bytes | None:
    """None for an unknown method or a chunk that is, or claims to be, larger than the bound."""
    if chunk.compression == "zstd":
        # With its size in the frame, zstandard allocates that, whatever max_output_size says.
        claimed = zstandard.get_frame_parameters(chunk.data).content_size
        if claimed > MAX_CHUNK_BYTES and claimed != zstandard.CONTENTSIZE_UNKNOWN:
            return None
        return zstandard.ZstdDecompressor().decompress(chunk.data, max_output_size=MAX_CHUNK_BYTES)
    if chunk.compression == "lz4":  # ours are not, bags may be
        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=MAX_CHUNK_BYTES + 1)
        return data if len(data) <= MAX_CHUNK_BYTES else None
    return chunk.data if chunk.compression == "" else None


def channel_of(path: Path, body: bytes, at: int) -> tuple[int, str]:
    """Id and topic that a channel record declares."""
    try:
        record = Channel.read(ReadDataStream(io.BytesIO(body)))
    except UNREADABLE:
        damaged(path, at)
    return record.id, record.topic
