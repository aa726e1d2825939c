"""Read chunks of a session file into columns: some megabytes of records at a time, one row per message.

Python looks at each record only once, to find its length. NumPy then reads all record headers in one pass. The record
layout is that of the mcap library, which would allocate whatever an untrusted record claims; here everything is
bounded.
"""

from __future__ import annotations

import io
import json
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Metadata
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

from truearm.errors import SessionError
from truearm.types import Ints, Message

MAX_CHUNK_BYTES = 64 << 20
MAX_ATTACHMENT_BYTES = 16 << 20
MAX_METADATA_BYTES = 1 << 20
MAX_CHANNELS = 1000

CRC = "crc32"  # a key of every metadata record of ours
CHANNELS = "channels"  # the metadata record that repeats the mapping of channels to topics
PLAN_COPY = "plan.mcap"  # the attachment that repeats the plan and what was mounted

RECORD = struct.Struct("<BQ")
LATEST_NS = 1 << 62  # 146 years; differences of later times would not fit int64
FOOTER_BYTES = 20


def records(file: BinaryIO, end: int, at: int = len(MCAP0_MAGIC)) -> Iterator[tuple[int, int, int]]:
    """Yield opcode, body offset and body length of every complete record from ``at`` up to ``end``.

    At each yield the file is positioned at the body. Raises SessionError if the file ends before ``end``.
    """
    while at + RECORD.size <= end:
        file.seek(at)
        head = file.read(RECORD.size)
        if len(head) < RECORD.size:
            raise SessionError(f"{file.name}: became shorter while it was being read; wait until nothing writes to it")
        opcode, length = RECORD.unpack(head)
        at += RECORD.size
        if opcode == 0 or length > end - at:  # zeros: a power cut kept the file's length but not its bytes
            return
        yield opcode, at, length
        at += length


def has_footer(file: BinaryIO, size: int) -> bool:
    tail = RECORD.size + FOOTER_BYTES + len(MCAP0_MAGIC)
    file.seek(max(0, size - tail))
    data = file.read(tail)
    return data.endswith(MCAP0_MAGIC) and data.startswith(RECORD.pack(Opcode.FOOTER, FOOTER_BYTES))


class Unreadable(ValueError):
    """A record is damaged, or claims to be larger than it may be."""


def parse(kind: Any, body: bytes) -> Any:
    """Return a record of the library's from its bytes. Raises Unreadable."""
    try:
        return kind.read(ReadDataStream(io.BytesIO(body)))
    except (McapError, struct.error, ValueError, OverflowError) as exc:  # it ends early, or is not valid UTF-8
        raise Unreadable from exc


def metadata_crc(name: str, entries: Mapping[str, str]) -> str:
    """Return the CRC that the writer adds to the entries of a metadata record, as MCAP itself has none there."""
    texts = [name, *(text for key in sorted(entries) for text in (key, entries[key]))]
    return f"{zlib.crc32(json.dumps(texts).encode()):08x}"


def parse_metadata(body: bytes) -> tuple[str, dict[str, str], bool]:
    """Return name, entries and whether a CRC among them proves them. Raises Unreadable if that does not match."""
    record = parse(Metadata, body)
    entries = dict(record.metadata)
    crc = entries.pop(CRC, None)
    if crc is not None and crc != metadata_crc(record.name, entries):
        raise Unreadable
    return record.name, entries, crc is not None


def parse_attachment(body: bytes) -> tuple[str, bytes, bool]:
    """Return name, data and whether a CRC proves them. Raises Unreadable if that does not match."""
    record = parse(Attachment, body)
    crc = int.from_bytes(body[-4:], "little")
    if zlib.crc32(body[:-4]) != crc != 0:
        raise Unreadable
    return record.name, record.data, crc != 0


def chunk_fits(body: bytes, length: int) -> bool:
    """Return whether the lengths inside a chunk agree with its own."""
    if len(body) < 40:
        return False
    n_name = int.from_bytes(body[28:32], "little")
    return n_name <= 8 and 40 + n_name + int.from_bytes(body[32 + n_name : 40 + n_name], "little") == length


def chunk_records(body: bytes, zstd: zstandard.ZstdDecompressor) -> bytes:
    """Return the records of a chunk, decompressed within bounds and with the CRC checked. Raises Unreadable.

    ``zstd`` may serve all chunks of one thread: to make it takes longer than to use it.
    """
    if not chunk_fits(body, len(body)):
        raise Unreadable
    chunk = parse(Chunk, body)
    try:
        data = _decompress(chunk, zstd)
    except zstandard.ZstdError as exc:
        raise Unreadable from exc
    if len(data) != chunk.uncompressed_size or (chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc):
        raise Unreadable
    return data


def _decompress(chunk: Chunk, zstd: zstandard.ZstdDecompressor) -> bytes:
    """Decompress a chunk, unless it claims to be larger than the bound."""
    if chunk.compression == "zstd":
        # If the frame states its size, zstandard allocates that much regardless of max_output_size.
        claimed = zstandard.get_frame_parameters(chunk.data).content_size
        if claimed <= MAX_CHUNK_BYTES or claimed == zstandard.CONTENTSIZE_UNKNOWN:
            return zstd.decompress(chunk.data, max_output_size=MAX_CHUNK_BYTES)
    elif chunk.compression == "":
        return bytes(chunk.data)
    raise Unreadable


# ------------------------------------------------------------------------------------------------------------- messages

BATCH_BYTES = 2 << 20  # of records, read together: enough for NumPy to be fast, with little memory
MARGIN = 64  # zero bytes after the last record: the header of a short record may be read beyond its end


# A message record. MCAP's log time is UTC and its publish time the host's clock; before session version 0.5 both are
# the host's clock.
_HEAD = np.dtype(
    {
        "names": ["opcode", "length", "channel", "sequence", "log_ns", "t_host_ns"],
        "formats": ["u1", "<u8", "<u2", "<u4", "<u8", "<u8"],
        "offsets": [0, 1, 9, 11, 15, 23],
        "itemsize": 31,
    }
)
_RECORD_BYTES = 9
_LENGTH = struct.Struct("<Q").unpack_from


@dataclass(frozen=True, eq=False)
class Messages:
    """Messages (m,) in the order of writing; the payload of each is bytes ``begin`` to ``end`` of ``data``.

    ``topic`` is an index into ``topics``, ``sequence`` the number within the topic, and ``log_ns`` MCAP's log time.
    """

    data: bytes
    topics: tuple[str, ...]
    topic: NDArray[np.int64]
    t_host_ns: Ints
    begin: Ints
    end: Ints
    sequence: Ints
    log_ns: NDArray[np.uint64]

    def __len__(self) -> int:
        return len(self.topic)

    @property
    def bytes_u1(self) -> NDArray[np.uint8]:
        """``data`` as an array of bytes."""
        return np.frombuffer(self.data, np.uint8)

    def rows(self, wanted: Callable[[str], bool]) -> NDArray[np.intp]:
        """Return the rows of the wanted topics, in order."""
        of_topic = np.array([wanted(topic) for topic in self.topics], dtype=bool)
        return np.flatnonzero(of_topic[self.topic]) if of_topic.any() else np.empty(0, np.intp)

    def payload(self, row: int) -> bytes:
        """Return the payload of one message."""
        return self.data[self.begin[row] : self.end[row]]

    def payloads(self, rows: NDArray[np.intp]) -> list[bytes]:
        """Return the payloads of several messages."""
        data = self.data
        return [data[a:b] for a, b in zip(self.begin[rows].tolist(), self.end[rows].tolist(), strict=True)]

    def without(self, wanted: Callable[[str], bool]) -> Messages:
        """Return the messages except those of some topics."""
        return self.take(self.rows(lambda topic: not wanted(topic)))

    def take(self, rows: NDArray[np.intp]) -> Messages:
        """Return a selection of the messages as columns."""
        columns = ("topic", "t_host_ns", "begin", "end", "sequence", "log_ns")
        return replace(self, **{name: getattr(self, name)[rows] for name in columns})

    def of(self, rows: NDArray[np.intp]) -> Iterator[Message]:
        """Return a selection of the messages."""
        columns = (column[rows].tolist() for column in (self.topic, self.t_host_ns, self.begin, self.end))
        for topic, t_host_ns, begin, end in zip(*columns, strict=True):
            yield Message(self.topics[topic], t_host_ns, self.data[begin:end])


def columns_of(messages: Iterable[Message]) -> Messages:
    """Return single messages as columns; ``sequence`` counts them."""
    messages = list(messages)
    numbers: dict[str, int] = {}
    topic = np.array([numbers.setdefault(m.topic, len(numbers)) for m in messages], dtype=np.int64)
    size = np.array([len(m.data) for m in messages], dtype=np.int64)
    end = np.cumsum(size)
    return Messages(
        data=b"".join([*(m.data for m in messages), bytes(MARGIN)]),
        topics=tuple(numbers),
        topic=topic,
        t_host_ns=np.array([m.t_host_ns for m in messages], dtype=np.int64),
        begin=end - size,
        end=end,
        sequence=np.arange(len(messages), dtype=np.int64),
        log_ns=np.array([m.t_host_ns for m in messages], dtype=np.uint64),
    )


def batches(path: Path, packed: Iterable[bytes], channels: dict[int, str]) -> Iterator[Messages]:
    """Yield the messages among the records of chunks; the channels that these declare are added to ``channels``.

    Raises SessionError if records are incomplete or a message belongs to an undeclared channel.
    """
    gathered: list[bytes] = []
    for data in chain(packed, [b""]):
        gathered.append(data)
        if sum(map(len, gathered)) >= (BATCH_BYTES if data else 1):
            try:
                messages = columns_of_records(gathered, channels)
            except Unreadable as exc:
                raise SessionError("damaged-session", place=path, where="in a record of a chunk") from exc
            gathered = []  # the batch has their bytes; release them while it is used
            yield messages


def columns_of_records(chunks: Sequence[bytes], channels: dict[int, str]) -> Messages:
    """Return the messages among the records of chunks. Raises Unreadable."""
    data = b"".join([*chunks, bytes(MARGIN)])
    begin = np.array(_starts(data, [len(chunk) for chunk in chunks]), dtype=np.int64)
    end = np.append(begin[1:], len(data) - MARGIN)[: len(begin)]
    head = heads(data, begin, _HEAD)
    topics: dict[str, int] = {}
    of_channel = np.full(1 << 16, -1)
    for channel, topic in channels.items():
        of_channel[channel] = topics.setdefault(topic, len(topics))
    number = of_channel[head["channel"]]
    for at in np.flatnonzero(head["opcode"] == Opcode.CHANNEL).tolist():
        record = parse(Channel, data[begin[at] + _RECORD_BYTES : end[at]])
        if channels.setdefault(record.id, record.topic) != record.topic or len(channels) > MAX_CHANNELS:
            raise Unreadable  # the specification allows a channel one topic
        of_channel[record.id] = topics.setdefault(record.topic, len(topics))
        number[at:] = of_channel[head["channel"][at:]]
    t_host_ns = head["t_host_ns"]
    is_message = head["opcode"] == Opcode.MESSAGE
    if np.any(is_message & ((end - begin < _HEAD.itemsize) | (number < 0) | (t_host_ns >= LATEST_NS))):
        raise Unreadable
    rows = np.flatnonzero(is_message)
    return Messages(
        data=data,
        topics=tuple(topics),
        topic=number[rows],
        t_host_ns=t_host_ns[rows].astype(np.int64),
        begin=begin[rows] + _HEAD.itemsize,
        end=end[rows],
        sequence=head["sequence"][rows].astype(np.int64),
        log_ns=head["log_ns"][rows],
    )


def _starts(data: bytes, sizes: Sequence[int]) -> list[int]:
    """Return where each record begins; the records of a chunk fill it completely."""
    starts: list[int] = []
    add, length_at, at, end = starts.append, _LENGTH, 0, 0
    for size in sizes:
        end += size
        while at < end:
            add(at)
            at += _RECORD_BYTES + length_at(data, at + 1)[0]
        if at != end:
            raise Unreadable
    return starts


def heads(data: bytes, begin: NDArray[np.integer[Any]], kind: np.dtype[Any]) -> NDArray[Any]:
    """Return the data at ``begin`` (n,) as records of this type, which end within MARGIN of the last message."""
    window = np.lib.stride_tricks.sliding_window_view(np.frombuffer(data, np.uint8), kind.itemsize)
    return np.asarray(window[begin]).view(kind)[:, 0]


Source = Callable[[], Iterator[Messages]]  # all messages of a session; may be called several times
