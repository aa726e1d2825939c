"""Reading a session file, complete or cut off in the middle, within bounds.

The records' layout is the mcap library's; the walk over them is ours for two reasons: a stranger's file may claim any
size, which the library would allocate, and messages are wanted as they stand in the file, several times faster
than through its indices (1.3 µs a message of 200 bytes).
"""

from __future__ import annotations

import io
import os
import struct
import zlib
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, NoReturn

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Metadata, Statistics
from mcap.writer import MCAP0_MAGIC

from truearm.errors import SessionError
from truearm.types import Message

MAX_CHUNK_BYTES = 64 << 20
MAX_ATTACHMENT_BYTES = 16 << 20
MAX_METADATA_BYTES = 1 << 20
MAX_ITEMS = 1000  # attachments, and metadata records
MAX_CHANNELS = 1000

_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_FOOTER_BYTES = 20
_CRC_BLOCK = 1 << 20
# What the library raises for a record that ends early, holds no UTF-8 or claims a length beyond 63 bits.
_UNREADABLE = (McapError, struct.error, ValueError, OverflowError)


@dataclass(frozen=True)
class Session:
    """An opened session file.

    ``truncated``: the recorder did not complete it; ``messages`` then ends where the file does. ``metadata`` maps
    record names to their entries (of several records of one name the last), ``attachments`` names to bytes.
    """

    path: Path
    metadata: dict[str, dict[str, str]]
    attachments: dict[str, bytes]
    truncated: bool
    end: int  # byte at which the walk over the data ends

    def messages(self, topics: Collection[str] | None = None) -> Iterator[Message]:
        """Messages of ``topics`` (all if None) in the order in which they were written.

        Raises SessionError where the file is damaged.
        """
        wanted = None if topics is None else frozenset([topics] if isinstance(topics, str) else topics)
        channels: dict[int, str] = {}
        with _open(self.path) as file:
            for opcode, at, length in _records(file, self.end):
                if opcode == Opcode.CHUNK:
                    yield from _chunk_messages(self.path, _read_chunk(self.path, file, at, length), channels, wanted)
                elif opcode in (Opcode.CHANNEL, Opcode.MESSAGE):  # files of other programs need not have chunks
                    if length > MAX_CHUNK_BYTES:
                        _damaged(self.path, at)
                    raw = _RECORD.pack(opcode, length) + file.read(length)
                    yield from _chunk_messages(self.path, raw, channels, wanted)


def open_session(path: Path | str, allow_truncated: bool = False) -> Session:
    """Open a session file and read all but its messages.

    A file without its end (the recorder was killed, or is still at work) raises SessionError unless
    ``allow_truncated``. Raises SessionError too for what is missing, no MCAP, damaged or of absurd size. A complete file
    is read once as a whole, to hold it against its CRC (1 s a GB).
    """
    path = Path(path)
    with _open(path) as file:
        if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
            raise SessionError(f"{path}: is no MCAP file; give a session that truearm record wrote")
        session = _scan(path, file)
    if session.truncated and not allow_truncated:
        raise SessionError(
            f"{path}: ends in the middle: the recorder was killed or is still running; "
            "give --allow-truncated to use what is there"
        )
    return session


def _open(path: Path) -> BinaryIO:
    try:
        if path.exists() and not path.is_file():
            raise SessionError(f"{path}: is not a regular file; give a session that truearm record wrote")
        return path.open("rb")
    except FileNotFoundError as exc:
        raise SessionError(f"{path}: no such file") from exc
    except (OSError, ValueError) as exc:
        raise SessionError(f"{path}: cannot be read: {getattr(exc, 'strerror', exc)}") from exc


def _records(file: BinaryIO, end: int) -> Iterator[tuple[int, int, int]]:
    """Opcode, offset of the body and its length for every record that is whole before ``end``.

    At each yield the file stands at the body.
    """
    at = len(MCAP0_MAGIC)
    while at + _RECORD.size <= end:
        file.seek(at)
        opcode, length = _RECORD.unpack(file.read(_RECORD.size))
        at += _RECORD.size
        if opcode == 0 or length > end - at:  # zeros: a power cut left the file's length, not its bytes
            return
        yield opcode, at, length
        at += length


def _scan(path: Path, file: BinaryIO) -> Session:
    size = os.fstat(file.fileno()).st_size
    metadata: dict[str, dict[str, str]] = {}
    attachments: dict[str, bytes] = {}
    end = len(MCAP0_MAGIC)
    last_chunk: tuple[int, int] | None = None
    n_chunks = 0
    records = _records(file, size)
    for opcode, at, length in records:
        if opcode == Opcode.DATA_END:
            _check_chunks(path, file, records, n_chunks)
            _check_crc(path, file, at, length)
            return Session(path, metadata, attachments, not _has_footer(file, size), end)
        if opcode == Opcode.CHUNK:
            last_chunk = at, length
            n_chunks += 1
        elif opcode == Opcode.METADATA:
            name, entries = _metadata(path, _body(path, file, at, length, MAX_METADATA_BYTES), at)
            metadata[name] = entries
        elif opcode == Opcode.ATTACHMENT:
            name, data = _attachment(path, _body(path, file, at, length, MAX_ATTACHMENT_BYTES), at)
            attachments[name] = data
        if len(metadata) > MAX_ITEMS or len(attachments) > MAX_ITEMS:
            raise SessionError(f"{path}: holds more than {MAX_ITEMS} attachments or metadata records")
        end = at + length
    if _has_footer(file, size):
        _damaged(path, end)  # complete, yet the walk did not come to its end: a length is wrong
    if last_chunk is not None:
        end = _without_torn_chunk(path, file, last_chunk, end)
    return Session(path, metadata, attachments, True, end)


def _check_crc(path: Path, file: BinaryIO, at: int, length: int) -> None:
    """Hold all bytes before the record DataEnd against the CRC in it; 0 says that its writer took none."""
    written = int.from_bytes(_body(path, file, at, length, MAX_METADATA_BYTES)[:4], "little")
    if written == 0:
        return
    left, crc = at - _RECORD.size, 0
    file.seek(0)
    while left and (block := file.read(min(left, _CRC_BLOCK))):
        crc = zlib.crc32(block, crc)
        left -= len(block)
    if crc != written:
        raise SessionError(
            f"{path}: is damaged: its bytes do not fit its CRC; copy it again from where it was recorded"
        )


def _check_chunks(path: Path, file: BinaryIO, summary: Iterator[tuple[int, int, int]], n_chunks: int) -> None:
    """Hold the chunks that were found against the file's statistics: a damaged head would hide one."""
    for opcode, at, length in summary:
        if opcode == Opcode.STATISTICS:
            body = _body(path, file, at, length, MAX_METADATA_BYTES)
            try:
                counted = Statistics.read(ReadDataStream(io.BytesIO(body))).chunk_count
            except _UNREADABLE:
                _damaged(path, at)
            if counted != n_chunks:
                raise SessionError(f"{path}: is damaged: {n_chunks} of {counted} chunks were found; copy it again")


def _has_footer(file: BinaryIO, size: int) -> bool:
    tail = _RECORD.size + _FOOTER_BYTES + len(MCAP0_MAGIC)
    file.seek(max(0, size - tail))
    data = file.read(tail)
    return data.endswith(MCAP0_MAGIC) and data.startswith(_RECORD.pack(Opcode.FOOTER, _FOOTER_BYTES))


def _without_torn_chunk(path: Path, file: BinaryIO, last: tuple[int, int], end: int) -> int:
    """``end``, or the start of the last chunk if a power cut left its place on the disk but not its bytes."""
    try:
        _read_chunk(path, file, *last)
    except SessionError:
        return last[0] - _RECORD.size
    return end


def _damaged(path: Path, at: int) -> NoReturn:
    raise SessionError(f"{path}: is damaged at byte {at}; copy it again from where it was recorded")


def _body(path: Path, file: BinaryIO, at: int, length: int, limit: int) -> bytes:
    if length > limit:
        raise SessionError(f"{path}: a record of {length} bytes at byte {at}; at most {limit} are read")
    file.seek(at)
    data = file.read(length)
    if len(data) < length:
        _damaged(path, at)
    return data


def _metadata(path: Path, body: bytes, at: int) -> tuple[str, dict[str, str]]:
    try:
        record = Metadata.read(ReadDataStream(io.BytesIO(body)))
    except _UNREADABLE:
        _damaged(path, at)
    return record.name, record.metadata


def _attachment(path: Path, body: bytes, at: int) -> tuple[str, bytes]:
    try:
        record = Attachment.read(ReadDataStream(io.BytesIO(body)))
    except _UNREADABLE:
        _damaged(path, at)
    if len(body) < 4 or zlib.crc32(body[:-4]) != int.from_bytes(body[-4:], "little") != 0:
        _damaged(path, at)
    return record.name, record.data


def _read_chunk(path: Path, file: BinaryIO, at: int, length: int) -> bytes:
    """The records of a chunk, decompressed within bounds, its CRC checked."""
    body = _body(path, file, at, length, MAX_CHUNK_BYTES)
    try:
        chunk = Chunk.read(ReadDataStream(io.BytesIO(body)))
        data = _decompress(chunk)
    except (*_UNREADABLE, zstandard.ZstdError):
        _damaged(path, at)
    if data is None:
        raise SessionError(f"{path}: a chunk at byte {at} is compressed in a way, or to a size, that is not read")
    if len(data) != chunk.uncompressed_size or (chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc):
        _damaged(path, at)
    return data


def _decompress(chunk: Chunk) -> bytes | None:
    """None for an unknown method or a chunk that is, or claims to be, larger than the bound."""
    if chunk.compression == "zstd":
        # With its size in the frame, zstandard allocates that, whatever max_output_size says.
        claimed = zstandard.get_frame_parameters(chunk.data).content_size
        if claimed > MAX_CHUNK_BYTES and claimed != zstandard.CONTENTSIZE_UNKNOWN:
            return None
        return zstandard.ZstdDecompressor().decompress(chunk.data, max_output_size=MAX_CHUNK_BYTES)
    return chunk.data if chunk.compression == "" else None


def _chunk_messages(
    path: Path, data: bytes, channels: dict[int, str], wanted: frozenset[str] | None
) -> Iterator[Message]:
    """The wanted messages among the records ``data``; ``channels`` gains those that it declares."""
    at, size = 0, len(data)
    while at < size:
        if at + _RECORD.size > size:
            _damaged(path, at)
        opcode, length = _RECORD.unpack_from(data, at)
        at += _RECORD.size
        end = at + length
        if end > size:
            _damaged(path, at)
        if opcode == Opcode.MESSAGE:
            if length < _MESSAGE.size:
                _damaged(path, at)
            channel, _, t_host_ns, _ = _MESSAGE.unpack_from(data, at)
            topic = channels.get(channel)
            if topic is None:
                _damaged(path, at)
            if wanted is None or topic in wanted:
                yield Message(topic, t_host_ns, data[at + _MESSAGE.size : end])
        elif opcode == Opcode.CHANNEL:
            channel, topic = _channel(path, data[at:end], at)
            channels[channel] = topic
            if len(channels) > MAX_CHANNELS:
                raise SessionError(f"{path}: has more than {MAX_CHANNELS} channels")
        at = end


def _channel(path: Path, body: bytes, at: int) -> tuple[int, str]:
    try:
        record = Channel.read(ReadDataStream(io.BytesIO(body)))
    except _UNREADABLE:
        _damaged(path, at)
    return record.id, record.topic
