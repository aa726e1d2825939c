"""Read a session file, complete or truncated, within bounds.

A complete file has a CRC of all its bytes. If that matches, nothing else is checked. Otherwise each record is checked
by itself: chunks, attachments and our metadata have CRCs. Behind a damaged record, the next intact one is searched for,
so one flipped bit costs the second of messages in its chunk. The writer repeats metadata, attachments and the plan, of
which any intact copy is used.

Chunks become ``Messages``: columns with one row per message, some megabytes of records at a time. Python only finds the
length of each record; NumPy reads all headers in one pass.

The record layout is that of the mcap library. The iteration is not, because an untrusted file may claim any size, which
the library would allocate, and because its order is that of the indices.
"""

from __future__ import annotations

import io
import json
import os
import re
import struct
import zlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, DataEnd, Metadata, Statistics
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray
from zstandard import ZstdDecompressor

from truearm.disk import open_input
from truearm.errors import SessionError
from truearm.progress import step
from truearm.types import Ints, Message

MAX_CHUNK_BYTES = 64 << 20
MAX_ATTACHMENT_BYTES = 16 << 20
MAX_METADATA_BYTES = 1 << 20
MAX_SUMMARY_BYTES = 16 << 20  # of a day; a length in it may claim gigabytes
MAX_CHANNELS = 1000

CRC = "crc32"  # a key of every metadata record of ours
CHANNELS = "channels"  # the metadata record that repeats the mapping of channels to topics
PLAN_COPY = "plan.mcap"  # the attachment that repeats the plan and what was mounted

RECORD = struct.Struct("<BQ")
LATEST_NS = 1 << 62  # 146 years; differences of later times would not fit int64
FOOTER_BYTES = 20


def records(file: BinaryIO, end: int, offset: int = len(MCAP0_MAGIC)) -> Iterator[tuple[int, int, int]]:
    """Yield opcode, body offset and body length of every complete record from ``offset`` up to ``end``.

    At each yield the file is positioned at the body. Raises SessionError if the file ends before ``end``.
    """
    while offset + RECORD.size <= end:
        file.seek(offset)
        head = file.read(RECORD.size)
        if len(head) < RECORD.size:
            raise SessionError(f"{file.name}: became shorter while it was being read; wait until nothing writes to it")
        opcode, length = RECORD.unpack(head)
        offset += RECORD.size
        if opcode == 0 or length > end - offset:  # zeros: a power cut kept the file's length but not its bytes
            return
        yield opcode, offset, length
        offset += length


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
        # If the frame states its size, zstandard allocates that much regardless of max_output_size.
        if chunk.compression not in ("zstd", "") or (
            chunk.compression and zstandard.frame_content_size(chunk.data) > MAX_CHUNK_BYTES
        ):
            raise Unreadable
        data = zstd.decompress(chunk.data, max_output_size=MAX_CHUNK_BYTES) if chunk.compression else bytes(chunk.data)
    except zstandard.ZstdError as exc:
        raise Unreadable from exc
    if len(data) != chunk.uncompressed_size or (chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc):
        raise Unreadable
    return data


# ------------------------------------------------------------------------------------------------------------- messages

BATCH_BYTES = 2 << 20  # of records, read together: enough for NumPy to be fast, with little memory
MARGIN = 64  # zero bytes after the last record: the header of a short record may be read beyond its end


# A message record. MCAP's log time is UTC and its publish time the host's clock; before session version 0.5 both are
# the host's clock.
_RECORD = [("opcode", "u1"), ("length", "<u8")]
_HEAD = np.dtype([*_RECORD, ("channel", "<u2"), ("sequence", "<u4"), ("log_ns", "<u8"), ("t_host_ns", "<u8")])


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

    def rows(self, is_chosen: Callable[[str], bool]) -> NDArray[np.intp]:
        """Return the rows of the wanted topics, in order."""
        of_topic = np.array([is_chosen(topic) for topic in self.topics], dtype=bool)
        return np.flatnonzero(of_topic[self.topic]) if of_topic.any() else np.empty(0, np.intp)

    def payload(self, row: int) -> bytes:
        """Return the payload of one message."""
        return self.data[self.begin[row] : self.end[row]]

    def payloads(self, rows: NDArray[np.intp]) -> list[bytes]:
        """Return the payloads of several messages."""
        data = self.data
        return [data[a:b] for a, b in zip(self.begin[rows].tolist(), self.end[rows].tolist(), strict=True)]

    def take(self, rows: NDArray[np.intp]) -> Messages:
        """Return a selection of the messages as columns."""
        columns = ("topic", "t_host_ns", "begin", "end", "sequence", "log_ns")
        return replace(self, **{name: getattr(self, name)[rows] for name in columns})

    def one_by_one(self, rows: NDArray[np.intp]) -> Iterator[Message]:
        """Yield a selection of the messages, each with its payload."""
        columns = (column[rows].tolist() for column in (self.topic, self.t_host_ns, self.begin, self.end))
        for topic, t_host_ns, begin, end in zip(*columns, strict=True):
            yield Message(self.topics[topic], t_host_ns, self.data[begin:end])


def columns_of_records(chunks: Sequence[bytes], channels: dict[int, str]) -> Messages:
    """Return the messages among the records of chunks; the channels that these declare are added to ``channels``.

    Raises Unreadable if records are incomplete or a message belongs to an undeclared channel.
    """
    data = b"".join([*chunks, bytes(MARGIN)])
    begin = np.array(_starts(data, [len(chunk) for chunk in chunks]), dtype=np.int64)
    end = np.append(begin[1:], len(data) - MARGIN)[: len(begin)]
    head = heads(data, begin, _HEAD)
    topics: dict[str, int] = {}
    of_channel = np.full(1 << 16, -1)
    for channel, topic in channels.items():
        of_channel[channel] = topics.setdefault(topic, len(topics))
    number = of_channel[head["channel"]]
    for row in np.flatnonzero(head["opcode"] == Opcode.CHANNEL).tolist():
        record = parse(Channel, data[begin[row] + RECORD.size : end[row]])
        if channels.setdefault(record.id, record.topic) != record.topic or len(channels) > MAX_CHANNELS:
            raise Unreadable  # the specification allows a channel one topic
        of_channel[record.id] = topics.setdefault(record.topic, len(topics))
        number[row:] = of_channel[head["channel"][row:]]
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
    add, unpack, offset, end = starts.append, RECORD.unpack_from, 0, 0
    for size in sizes:
        end += size
        while offset < end:
            add(offset)
            offset += RECORD.size + unpack(data, offset)[1]
        if offset != end:
            raise Unreadable
    return starts


def heads(data: bytes, begin: NDArray[np.integer[Any]], kind: np.dtype[Any]) -> NDArray[Any]:
    """Return the data at ``begin`` (n,) as records of this type, which end within MARGIN of the last message."""
    window = np.lib.stride_tricks.sliding_window_view(np.frombuffer(data, np.uint8), kind.itemsize)
    return np.asarray(window[begin]).view(kind)[:, 0]


Source = Callable[[], Iterator[Messages]]  # all messages of a session; may be called several times


MAX_BAD = 1000  # damaged records and false starts; for each, a chunk may have been decompressed
MAX_ITEMS = 1000  # attachments, and metadata records
REPEATED = ("/plan", "/events")  # topics of which the writer repeats messages
_BLOCK = 1 << 20
_HEAD_BYTES = 64  # of a chunk, before its contents
_LIMITS = {
    **dict.fromkeys((Opcode.HEADER, Opcode.METADATA, Opcode.MESSAGE_INDEX), MAX_METADATA_BYTES),
    Opcode.CHUNK: MAX_CHUNK_BYTES,
    Opcode.ATTACHMENT: MAX_ATTACHMENT_BYTES,
    Opcode.DATA_END: 4,
}
# What is searched for: a chunk, an attachment, metadata or the end of data, of less than 4 GiB.
_START = re.compile(rb"[\x06\x09\x0c\x0f](?=.{4}\0{4})", re.DOTALL)


@dataclass(frozen=True)
class Damage:
    """A place where a file is damaged.

    ``at``: its first byte, None if only a CRC reveals it. Times in seconds of the session.

    ``lost_s`` of the ``of_s`` seconds are missing, starting ``from_s`` after the first message.
    """

    at: int | None
    lost_s: float
    of_s: float
    from_s: float = 0.0


@dataclass
class Session:
    """An opened session file.

    ``truncated``: the recorder did not complete it; ``messages`` then ends where the file does. ``metadata`` maps
    record names to their entries (of several records with one name, the last). ``attachments`` maps names to bytes.
    ``damage``: what ``messages`` leaves out elsewhere, if that was allowed.
    """

    path: Path
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)
    truncated: bool = True
    chunks: list[tuple[int, int]] = field(default_factory=list)  # offset and length of their contents
    channels: dict[int, str] = field(default_factory=dict)  # that the records themselves may not declare
    damage: tuple[Damage, ...] = ()
    unread_bytes: int = 0  # of a damaged file: bytes that are not in a complete record
    counted: dict[str, int] = field(default_factory=dict)  # messages by topic according to the end of a damaged file
    restored: Messages | None = None  # of a damaged file: the copy of the plan and of what was mounted

    def messages(self, topics: Collection[str] | None = None) -> Iterator[Message]:
        """Yield messages of ``topics`` (all if None) in the order of writing.

        Raises SessionError if the file is damaged.
        """
        chosen = None if topics is None else frozenset([topics] if isinstance(topics, str) else topics)
        for messages in self.batches():
            yield from messages.one_by_one(messages.rows(lambda topic: chosen is None or topic in chosen))

    def batches(self) -> Iterator[Messages]:
        """Yield all messages as columns, some megabytes at a time, in the order of writing.

        Raises SessionError if the file is damaged. Restored messages come first.
        """
        zstd, channels, gathered = ZstdDecompressor(), dict(self.channels), list[bytes]()
        if self.restored is not None:
            yield self.restored
        with open_input(self.path) as file, step(f"reading {self.path.name}") as advance:
            for number, (offset, length) in enumerate(self.chunks, start=1):
                advance((number - 1) / len(self.chunks))
                file.seek(offset)
                try:
                    gathered.append(chunk_records(file.read(length), zstd))
                    if sum(map(len, gathered)) < BATCH_BYTES and number < len(self.chunks):
                        continue
                    # The batch has their bytes: they are released while it is used.
                    messages, gathered = columns_of_records(gathered, channels), []
                except Unreadable as exc:
                    raise SessionError("damaged-session", place=self.path, where=f"at byte {offset}") from exc
                yield self._not_restored(messages)

    def _not_restored(self, messages: Messages) -> Messages:
        """Return the messages that are not in the copy of the plan."""
        if self.restored is None:
            return messages
        lasting = np.ones(len(messages), bool)
        for topic in REPEATED:
            copy = self.restored.sequence[self.restored.rows(topic.__eq__)]
            rows = messages.rows(topic.__eq__)
            lasting[rows] = ~np.isin(messages.sequence[rows], copy)
        return messages.take(np.flatnonzero(lasting))


def open_session(path: Path | str, allow_damaged: bool = False) -> Session:
    """Open a session file and read everything except its messages.

    A damaged file, or one without its end (the recorder was killed or is still running), raises SessionError unless
    ``allow_damaged`` is set; then its intact parts are found. SessionError is also raised if the file is missing, is
    not MCAP or has an absurd size. A complete file is read once in full to check its CRC (1 s per GB), a damaged one a
    second time.
    """
    path = Path(path)
    with open_input(path) as file:
        quick = RecordWalk(path, file, every_record=False)
        if not quick.complete and not quick.has_magic:
            raise SessionError("not-a-session", place=path)
        quick.walk()
        if not quick.complete and not allow_damaged:
            raise SessionError("session-incomplete", place=path)
        wrong_crc = quick.wrong_crc()
        if quick.complete and not wrong_crc and (quick.crc or not allow_damaged):
            quick.session.truncated = False
            quick.session.attachments.pop(PLAN_COPY, None)
            return quick.session
        walk = RecordWalk(path, file, every_record=True)
        walk.walk()
        if not allow_damaged:
            place = f"at byte {walk.gaps[0][0]}" if walk.gaps else wrong_crc
            raise SessionError("damaged-session", place=path, where=place)
        return walk.salvaged(bool(wrong_crc))


class RecordWalk:
    """Goes through the records of a file.

    ``every_record``: check each record, and search for the next one behind a damaged one. Otherwise stop there, and
    leave the chunks packed.
    """

    def __init__(self, path: Path, file: BinaryIO, every_record: bool) -> None:
        self.session = Session(path)
        self.gaps: list[tuple[int, int]] = []  # byte of each damaged place, and chunks before it
        self.crc = 0  # of all bytes before ``_data_end``, as the file states it; 0: not stated
        self._file, self._every_record = file, every_record
        self._size = os.fstat(file.fileno()).st_size
        file.seek(0)
        self.has_magic = file.read(len(MCAP0_MAGIC)) == MCAP0_MAGIC
        self.complete = has_footer(file, self._size)
        self._span_ns: tuple[int, int] | None = None  # of the messages, as the end of the file states it
        self._times_ns: list[tuple[int, int]] = []  # of the messages of each chunk
        self._proven: set[str] = set()  # metadata and attachments with a CRC
        self._data_end = 0
        if every_record and self.complete:
            self._summary()

    def walk(self) -> None:
        """Go through all records up to the end of data."""
        offset = len(MCAP0_MAGIC) if self.has_magic else 0
        while offset + RECORD.size <= self._size and not self._data_end:
            end = self._record(offset)
            if end is None:
                self.gaps.append((offset, len(self._times_ns)))
                if not self._every_record:
                    return
                begin, offset = offset, self._search(offset + 1)
                self.session.unread_bytes += offset - begin
            else:
                offset = end
        self.session.unread_bytes += 0 if self._data_end else self._size - offset

    def wrong_crc(self) -> str:
        """Return where a CRC of a complete file does not match, "" if nowhere.

        Other programs read the file by its summary, behind the end of data.
        """
        if not self._data_end:
            return "somewhere: its end of data is missing"
        if self.crc not in (0, self._crc_of_bytes(0, self._data_end)):
            return "somewhere: its CRC does not match"
        end = self._size - len(MCAP0_MAGIC) - 4
        own_crc = self._crc_of_bytes(self._data_end + RECORD.size + _LIMITS[Opcode.DATA_END], end)
        summary_crc = int.from_bytes(self._file.read(4), "little")
        return "" if summary_crc in (0, own_crc) else "in its summary: the CRC does not match"

    def _crc_of_bytes(self, begin: int, end: int) -> int:
        """Return the CRC of these bytes, and leave the file at their end."""
        self._file.seek(begin)
        crc = 0
        while block := self._file.read(max(0, min(end - self._file.tell(), _BLOCK))):
            crc = zlib.crc32(block, crc)
        return crc

    def salvaged(self, wrong_crc: bool) -> Session:
        """Return the session, with what is missing in each damaged place."""
        session, times_ns, gaps = self.session, self._times_ns, list(self.gaps)
        session.truncated = not self.complete
        while gaps and gaps[-1][1] == len(times_ns) and not (self.complete and self._span_ns):
            gaps.pop()  # nothing follows, and nothing says how long it was
            session.truncated = True
        first = min((begin for begin, _ in times_ns), default=0)
        first, last = self._span_ns or (first, max((end for _, end in times_ns), default=0))
        damage = dict[int, Damage]()
        for offset, chunks in gaps:
            end = max((end for _, end in times_ns[:chunks]), default=first)
            begin = min((begin for begin, _ in times_ns[chunks:]), default=last)
            lost_s, of_s, from_s = (1e-9 * max(0, ns) for ns in (begin - end, last - first, end - first))
            damage.setdefault(chunks, Damage(offset, lost_s, of_s, from_s))  # several places between two chunks are one
        session.damage = tuple(damage.values())
        if wrong_crc and not session.truncated and not damage:
            session.damage = (Damage(None, 0.0, 0.0),)
        copy = session.attachments.pop(PLAN_COPY, None)
        session.restored = None if copy is None else _messages_of_copy(copy)
        return session

    def _record(self, offset: int) -> int | None:
        """Take the record at ``offset`` and return where it ends; None if it is damaged."""
        self._file.seek(offset)
        opcode, length = RECORD.unpack(self._file.read(RECORD.size))
        begin = offset + RECORD.size
        end: int = begin + length
        if (
            end > self._size
            or length > _LIMITS.get(opcode, -1)
            or (opcode == Opcode.HEADER) != (offset == len(MCAP0_MAGIC))
        ):
            return None
        session = self.session
        if opcode == Opcode.CHUNK and not self._every_record:
            session.chunks.append((begin, length))
            return end
        body = self._file.read(length)
        try:
            if opcode == Opcode.DATA_END:
                self.crc, self._data_end = parse(DataEnd, body).data_section_crc, offset
            elif opcode == Opcode.METADATA:
                name, entries, proven = parse_metadata(body)
                self._keep(session.metadata, name, entries, proven)
                if name == CHANNELS and proven:  # wrong names would turn intact messages into others
                    declared = {int(key): topic for key, topic in entries.items() if re.fullmatch("[0-9]{1,5}", key)}
                    session.channels.update(list(declared.items())[:MAX_CHANNELS])
            elif opcode == Opcode.ATTACHMENT:
                self._keep(session.attachments, *parse_attachment(body))
            elif opcode == Opcode.MESSAGE_INDEX:
                return end if length % 16 == 6 and int.from_bytes(body[2:6], "little") == length - 6 else None
            elif opcode == Opcode.CHUNK:
                messages = columns_of_records([chunk_records(body, ZstdDecompressor())], session.channels)
                session.chunks.append((begin, length))
                if len(messages):
                    self._times_ns.append((int(messages.log_ns.min()), int(messages.log_ns.max())))
        except Unreadable:
            return None
        return end

    def _keep(self, items: dict[str, Any], name: str, content: Any, proven: bool) -> None:
        """Keep metadata or an attachment. Without a CRC it may consist of zeros, and never replaces one with a CRC."""
        if proven or not self._every_record or (name and name not in self._proven):
            items[name] = content
        if proven:
            self._proven.add(name)
        if len(items) > MAX_ITEMS:
            raise SessionError(f"{self.session.path}: holds more than {MAX_ITEMS} attachments or metadata records")

    def _search(self, offset: int) -> int:
        """Return the next position at which a record seems to begin; the end of the file if there is none."""
        if len(self.gaps) > MAX_BAD:
            raise SessionError(f"{self.session.path}: is damaged in more than {MAX_BAD} places; copy it again")
        while offset + RECORD.size <= self._size:
            self._file.seek(offset)
            block = self._file.read(_BLOCK + _HEAD_BYTES)
            for start in _START.finditer(block, 0, _BLOCK + RECORD.size - 1):
                begin = start.start()
                opcode, length = RECORD.unpack_from(block, begin)
                fits = length <= _LIMITS[opcode] and length <= self._size - offset - begin - RECORD.size
                if fits and (opcode != Opcode.CHUNK or chunk_fits(block[begin + RECORD.size :], length)):
                    return offset + begin
            offset += _BLOCK
        return self._size

    def _summary(self) -> None:
        """Read what a complete file repeats at its end: its channels, and times and number of the messages."""
        self._file.seek(self._size - len(MCAP0_MAGIC) - FOOTER_BYTES)
        self._file.seek(min(int.from_bytes(self._file.read(8), "little"), self._size))
        channels, summary = self.session.channels, io.BytesIO(self._file.read(MAX_SUMMARY_BYTES))
        try:
            for record in StreamReader(summary, skip_magic=True, record_size_limit=MAX_METADATA_BYTES).records:
                if isinstance(record, Channel) and len(channels) < MAX_CHANNELS:
                    channels[record.id] = record.topic
                elif isinstance(record, Statistics):
                    self._span_ns = record.message_start_time, record.message_end_time
                    counts = record.channel_message_counts
                    self.session.counted = {channels[k]: n for k, n in counts.items() if k in channels}
        except (McapError, struct.error, ValueError, OverflowError):  # the summary is damaged too
            pass


def _messages_of_copy(copy: bytes) -> Messages | None:
    """Return the messages in the copy of the plan; None if it cannot be read."""
    copied = records(io.BytesIO(copy), len(copy))
    try:
        chunks = [chunk_records(copy[k : k + n], ZstdDecompressor()) for op, k, n in copied if op == Opcode.CHUNK]
        return columns_of_records(chunks, {}) if chunks else None
    except Unreadable:
        return None
