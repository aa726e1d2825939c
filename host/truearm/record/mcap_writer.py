"""An MCAP file, to the byte as the mcap library's ``Writer`` writes it with Zstandard and all checksums, at a quarter of the cost a message.

The library packs a message in eight calls and each entry of its index in two; a recorder stores a hundred messages a second for hours.
Only messages, their index and the end of a chunk are written here; every other record is the library's own.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Mapping
from typing import Protocol

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC

_MESSAGE = struct.Struct("<BQHIQQ")  # opcode and length of the record, channel, sequence, log and publish time
_MESSAGE_INDEX = struct.Struct("<BQHI")  # opcode and length of the record, channel, bytes of the entries
_OPCODE_AND_LENGTH = 9  # bytes
_IS_MESSAGE, _IS_MESSAGE_INDEX = int(Opcode.MESSAGE), int(Opcode.MESSAGE_INDEX)


class Output(Protocol):
    """Where the bytes go."""

    def write(self, data: bytes, /) -> int: ...
    def flush(self) -> None: ...


class McapWriter:
    """A file that has begun; messages wait in a chunk until ``flush``. ``finish`` completes it. OSErrors of the output pass through."""

    def __init__(self, out: Output, profile: str, library: str) -> None:
        self._out = out
        self._at = 0  # bytes written
        self._crc = 0  # of them
        self._compressor = zstandard.ZstdCompressor()
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._chunks: list[ChunkIndex] = []
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._counts: dict[int, int] = {}  # messages of finished chunks, by channel
        self._parts: list[bytes] = []  # of the chunk
        self._size = 0  # of the chunk
        self._index: dict[int, list[int]] = {}  # by channel: log time and offset in the chunk, log time and offset …
        self._begin = MCAP0_MAGIC + _bytes_of(Header(profile, library))
        self._write(self._begin)

    def register_schema(self, name: str, encoding: str, data: bytes) -> int:
        """The number of a new schema."""
        self._schemas.append(Schema(id=len(self._schemas) + 1, data=data, encoding=encoding, name=name))
        self._add_part(_bytes_of(self._schemas[-1]))
        return len(self._schemas)

    def register_channel(self, topic: str, message_encoding: str, schema: int) -> int:
        """The number of a new channel."""
        number = len(self._channels) + 1
        self._channels.append(Channel(number, topic, message_encoding, {}, schema))
        self._add_part(_bytes_of(self._channels[-1]))
        return number

    def add_message(self, channel: int, sequence: int, log_ns: int, publish_ns: int, data: bytes) -> None:
        """Append a message to the chunk. About 0.7 µs."""
        entries = self._index.get(channel)
        if entries is None:
            entries = self._index[channel] = []
        entries += (log_ns, self._size)
        head = _MESSAGE.pack(
            _IS_MESSAGE, _MESSAGE.size - _OPCODE_AND_LENGTH + len(data), channel, sequence, log_ns, publish_ns
        )
        self._parts += (head, data)
        self._size += _MESSAGE.size + len(data)

    def add_metadata(self, name: str, entries: Mapping[str, str]) -> None:
        """Write a metadata record, before the chunk under way."""
        record = _bytes_of(Metadata(name=name, metadata=dict(entries)))
        self._metadata.append(MetadataIndex(offset=self._at, length=len(record), name=name))
        self._write(record)

    def add_attachment(self, time_ns: int, name: str, media_type: str, data: bytes) -> None:
        """Write an attachment, before the chunk under way."""
        record = _bytes_of(Attachment(time_ns, time_ns, name, media_type, data))
        self._attachments.append(
            AttachmentIndex(self._at, len(record), time_ns, time_ns, len(data), name=name, media_type=media_type)
        )
        self._write(record)

    def flush(self) -> None:
        """Write the chunk, if it holds a message, and flush the output."""
        self._finish_chunk()
        self._out.flush()

    def begin_again(self, first: Iterable[tuple[int, int, int, int, bytes]]) -> None:
        """Begin a new file on the output, which is empty again: what was written is not in it, the chunk under way will be.

        ``first`` are the arguments of messages to come before those of that chunk.
        """
        parts, index, size = self._parts, self._index, self._size
        self._parts = [_bytes_of(record) for record in (*self._schemas, *self._channels)]
        self._index, self._size = {}, sum(map(len, self._parts))
        for message in first:
            self.add_message(*message)
        for channel, entries in index.items():
            entries[1::2] = [offset + self._size for offset in entries[1::2]]
            self._index.setdefault(channel, []).extend(entries)
        self._parts += parts
        self._size += size
        self._at = self._crc = 0
        self._chunks, self._attachments, self._metadata, self._counts = [], [], [], {}
        self._write(self._begin)

    def finish(self) -> None:
        """Write the last chunk, the summary and the end."""
        self._finish_chunk()
        self._write(_bytes_of(DataEnd(self._crc)))
        start = self._at
        groups: list[tuple[Opcode, Iterable[McapRecord]]] = [
            (Opcode.SCHEMA, self._schemas),
            (Opcode.CHANNEL, self._channels),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, self._chunks),
            (Opcode.ATTACHMENT_INDEX, self._attachments),
            (Opcode.METADATA_INDEX, self._metadata),
        ]
        summary, offsets = RecordBuilder(), list[SummaryOffset]()
        for opcode, records in groups:
            begin = summary.count
            for record in records:
                record.write(summary)
            offsets.append(
                SummaryOffset(group_opcode=opcode, group_start=start + begin, group_length=summary.count - begin)
            )
        offsets_start = start + summary.count
        for offset in offsets:
            offset.write(summary)
        data = summary.end()
        crc = zlib.crc32(struct.pack("<BQQQ", Opcode.FOOTER, 20, start, offsets_start), zlib.crc32(data))
        self._write(data)
        self._write(_bytes_of(Footer(summary_start=start, summary_offset_start=offsets_start, summary_crc=crc)))
        self._write(MCAP0_MAGIC)

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=len(self._chunks),
            message_count=sum(self._counts.values()),
            message_end_time=max((chunk.message_end_time for chunk in self._chunks), default=0),
            message_start_time=min((chunk.message_start_time for chunk in self._chunks), default=0),
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )

    def _finish_chunk(self) -> None:
        if not self._index:
            return
        data = b"".join(self._parts)
        packed = self._compressor.compress(data)
        first_ns = min(min(entries[::2]) for entries in self._index.values())
        last_ns = max(max(entries[::2]) for entries in self._index.values())
        record = _bytes_of(Chunk("zstd", packed, last_ns, first_ns, zlib.crc32(data), len(data)))
        at, offsets, indices = self._at, dict[int, int](), b""
        for channel, entries in self._index.items():
            offsets[channel] = at + len(record) + len(indices)
            body = 8 * len(entries)
            length = _MESSAGE_INDEX.size - _OPCODE_AND_LENGTH + body
            indices += _MESSAGE_INDEX.pack(_IS_MESSAGE_INDEX, length, channel, body)
            indices += struct.pack(f"<{len(entries)}Q", *entries)
        self._write(record)
        self._write(indices)
        self._chunks.append(
            ChunkIndex(
                chunk_length=len(record),
                chunk_start_offset=at,
                compression="zstd",
                compressed_size=len(packed),
                message_end_time=last_ns,
                message_index_length=len(indices),
                message_index_offsets=offsets,
                message_start_time=first_ns,
                uncompressed_size=len(data),
            )
        )
        for channel, entries in self._index.items():
            self._counts[channel] = self._counts.get(channel, 0) + len(entries) // 2
        self._parts, self._size, self._index = [], 0, {}

    def _add_part(self, record: bytes) -> None:
        self._parts.append(record)
        self._size += len(record)

    def _write(self, data: bytes) -> None:
        self._crc = zlib.crc32(data, self._crc)
        self._at += len(data)
        self._out.write(data)


def _bytes_of(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())
