"""Read a session file, complete or truncated, within bounds.

The record layout is that of the mcap library. Iterating over the records is done here for two reasons. An untrusted
file may claim any size, which the library would allocate. And messages are needed in the order of the file, which is
several times faster than through its indices (1.3 µs for a message of 200 bytes).

**Recovering a damaged session** (``salvage()``) finds every record that can be verified, and where and how much is
missing in between.

Each chunk has its own CRC, so one flipped bit costs the second of messages in that chunk. If a record's length is wrong
or bytes are missing, the next valid record is searched for: first by its opcode and a plausible length, then by its
content. The file is read once. The search is abandoned if an untrusted file consists of false starts.

Metadata (the clock's anchors, the box's ident) have a CRC among their entries. Records without one (headers, metadata
of other programs) are accepted as they are. If a complete file does not match its CRC and the damaged place is not
found, this is reported.

The writer repeats metadata and attachments, of which any intact copy is as good as the first. The copy of the plan and
of what was mounted replaces those of its messages that are lost.
"""

from __future__ import annotations

import io
import os
import re
import struct
import zlib
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Statistics
from mcap.writer import MCAP0_MAGIC
from zstandard import ZstdDecompressor

from truearm.errors import SessionError
from truearm.file_names import open_input
from truearm.progress import step
from truearm.session.message_columns import (
    CHANNELS,
    MAX_ATTACHMENT_BYTES,
    MAX_CHANNELS,
    MAX_CHUNK_BYTES,
    MAX_METADATA_BYTES,
    PLAN_COPY,
    RECORD,
    UNREADABLE,
    Messages,
    batches,
    body_of,
    chunk_records,
    damaged,
    has_footer,
    parse_attachment,
    parse_metadata,
    records,
)
from truearm.types import Message

_CRC_BLOCK = 1 << 20
REPEATED = ("/plan", "/events")  # topics of which the writer repeats messages


@dataclass(frozen=True)
class Session:
    """An opened session file.

    ``truncated``: the recorder did not complete it; ``messages`` then ends where the file does. ``metadata`` maps
    record names to their entries (of several records with one name, the last). ``attachments`` maps names to bytes.
    ``damage``: what ``messages`` leaves out elsewhere, if that was allowed.
    """

    path: Path
    metadata: dict[str, dict[str, str]]
    attachments: dict[str, bytes]
    truncated: bool
    spans: tuple[tuple[int, int], ...]  # byte ranges that contain only complete records
    channels: dict[int, str] = field(default_factory=dict)  # that the records themselves may not declare
    damage: tuple[Damage, ...] = ()
    unread_bytes: int = 0  # of a damaged file: bytes that are not in a complete record
    counted: dict[str, int] = field(default_factory=dict)  # messages by topic according to the end of a damaged file
    restored: Messages | None = None  # of a damaged file: lost messages, from the copy of the plan

    def messages(self, topics: Collection[str] | None = None) -> Iterator[Message]:
        """Yield messages of ``topics`` (all if None) in the order of writing.

        Raises SessionError if the file is damaged.
        """
        wanted = None if topics is None else frozenset([topics] if isinstance(topics, str) else topics)
        for messages in self.batches():
            yield from messages.of(messages.rows(lambda topic: wanted is None or topic in wanted))

    def batches(self) -> Iterator[Messages]:
        """Yield all messages as columns, some megabytes at a time, in the order of writing.

        Raises SessionError if the file is damaged. Restored messages come first.
        """
        read = batches(self.path, self.packed(), dict(self.channels))
        if self.restored is None:
            return read
        has_plan = len(self.restored.rows("/plan".__eq__)) > 0
        return chain([self.restored], (m.without(lambda topic: has_plan and topic == "/plan") for m in read))

    def packed(self) -> Iterator[bytes]:
        """Yield the records of one chunk after the other."""
        first, last = min((start for start, _ in self.spans), default=0), max((end for _, end in self.spans), default=0)
        zstd = ZstdDecompressor()
        with open_input(self.path) as file, step(f"reading {self.path.name}") as advance:
            for start, end in self.spans:
                for opcode, at, length in records(file, end, start):
                    advance((at - first) / (last - first))
                    if opcode == Opcode.CHUNK:
                        yield chunk_records(self.path, file, at, length, zstd)
                    elif opcode in (Opcode.CHANNEL, Opcode.MESSAGE):  # files of other programs may have no chunks
                        yield RECORD.pack(opcode, length) + body_of(self.path, file, at, length, MAX_CHUNK_BYTES)


def open_session(path: Path | str, allow_damaged: bool = False) -> Session:
    """Open a session file and read everything except its messages.

    A damaged file, or one without its end (the recorder was killed or is still running), raises SessionError unless
    ``allow_damaged`` is set; then its intact parts are found. SessionError is also raised if the file is missing, is
    not MCAP or has an absurd size. A complete file is read once in full to check its CRC (1 s per GB), a damaged one a
    second time.
    """
    path = Path(path)
    with open_input(path) as file:
        if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
            if not has_footer(file, os.fstat(file.fileno()).st_size):
                raise SessionError("not-a-session", place=path)
            if not allow_damaged:
                damaged(path, 0)
            return _salvaged(path, file, known_damaged=True)
        try:
            session, proven = _scan(path, file)
        except SessionError:
            if not allow_damaged:
                raise
            return _salvaged(path, file, known_damaged=True)
        if allow_damaged and not proven:
            return _salvaged(path, file, known_damaged=False)
    if session.truncated and not allow_damaged:
        raise SessionError("session-incomplete", place=path)
    return session


def _salvaged(path: Path, file: BinaryIO, known_damaged: bool) -> Session:
    whole, complete = salvage(path, file)
    damage = whole.damage
    if known_damaged and complete and not damage:
        damage = (Damage(None, 0.0, 0.0),)
    copy = whole.attachments.pop(PLAN_COPY, None)
    restored = None if copy is None else _restored(path, copy, whole.numbers)
    found = whole.metadata, whole.attachments, not complete, tuple(whole.spans), whole.channels
    return Session(path, *found, damage, whole.unread_bytes, whole.counted, restored)


def _restored(path: Path, copy: bytes, intact: Mapping[str, set[int]]) -> Messages | None:
    """Return the lost messages that a copy of the plan holds, None if there are none.

    ``intact``: the numbers of the messages that are left, by topic. If any row of the plan is lost, all are returned.
    """
    file = io.BytesIO(copy)
    places = [(at, length) for opcode, at, length in records(file, len(copy)) if opcode == Opcode.CHUNK]
    try:
        chunks = [chunk_records(path, file, at, length, ZstdDecompressor()) for at, length in places]
        messages = next(batches(path, chunks, {}), None)
    except SessionError:
        return None
    if messages is None:
        return None
    plan, events = (messages.rows(topic.__eq__) for topic in REPEATED)
    plan_lost, events_lost = (
        np.isin(messages.sequence[rows], list(intact[topic]), invert=True)
        for topic, rows in zip(REPEATED, (plan, events), strict=True)
    )
    rows = np.concatenate([plan if plan_lost.any() else plan[:0], events[events_lost]])
    return messages.take(rows) if len(rows) else None


def _scan(path: Path, file: BinaryIO) -> tuple[Session, bool]:
    """Return the session, and whether a CRC proves that it is unchanged."""
    size = os.fstat(file.fileno()).st_size
    metadata: dict[str, dict[str, str]] = {}
    attachments: dict[str, bytes] = {}
    start = end = len(MCAP0_MAGIC)
    last_chunk: tuple[int, int] | None = None
    n_chunks = 0
    walk = records(file, size)
    for opcode, at, length in walk:
        if opcode == Opcode.DATA_END:
            _check_chunks(path, file, walk, n_chunks)
            proven = _check_crc(path, file, at, length)
            complete = has_footer(file, size)
            if complete:
                _check_summary(path, file, at + length, size)
            return Session(path, metadata, attachments, not complete, ((start, end),)), proven
        if opcode == Opcode.CHUNK:
            last_chunk = at, length
            n_chunks += 1
        elif opcode == Opcode.METADATA:
            name, entries, _ = parse_metadata(path, body_of(path, file, at, length, MAX_METADATA_BYTES), at)
            metadata[name] = entries
        elif opcode == Opcode.ATTACHMENT:
            name, data, _ = parse_attachment(path, body_of(path, file, at, length, MAX_ATTACHMENT_BYTES), at)
            if name != PLAN_COPY:
                attachments[name] = data
        if len(metadata) > MAX_ITEMS or len(attachments) > MAX_ITEMS:
            raise SessionError(f"{path}: holds more than {MAX_ITEMS} attachments or metadata records")
        end = at + length
    if last_chunk is not None:
        end = _without_torn_chunk(path, file, last_chunk, end)
    if has_footer(file, size):
        damaged(path, end)  # complete, yet the scan did not reach its end: a length is wrong, or bytes are missing
    return Session(path, metadata, attachments, True, ((start, end),)), False


def _check_crc(path: Path, file: BinaryIO, at: int, length: int) -> bool:
    """Check all bytes before the DataEnd record against the CRC in it; False if the writer stored none."""
    written = int.from_bytes(body_of(path, file, at, length, MAX_METADATA_BYTES)[:4], "little")
    if written == 0:
        return False
    if _crc(file, 0, at - RECORD.size) != written:
        raise SessionError("damaged-session", place=path, where="somewhere: its CRC does not match")
    return True


def _check_summary(path: Path, file: BinaryIO, begin: int, size: int) -> None:
    """Check the summary, by which other programs read the file, against the CRC in the footer, unless that is 0."""
    end = size - len(MCAP0_MAGIC) - 4
    file.seek(end)
    written = int.from_bytes(file.read(4), "little")
    if written not in (0, _crc(file, begin, end)):
        raise SessionError("damaged-session", place=path, where="in its summary: the CRC does not match")


def _crc(file: BinaryIO, begin: int, end: int) -> int:
    file.seek(begin)
    crc = 0
    while begin < end and (block := file.read(min(end - begin, _CRC_BLOCK))):
        crc = zlib.crc32(block, crc)
        begin += len(block)
    return crc


def _check_chunks(path: Path, file: BinaryIO, summary: Iterator[tuple[int, int, int]], n_chunks: int) -> None:
    """Compare the chunks found with the file's statistics: a damaged header would hide a chunk."""
    for opcode, at, length in summary:
        if opcode == Opcode.STATISTICS:
            body = body_of(path, file, at, length, MAX_METADATA_BYTES)
            try:
                counted = Statistics.read(ReadDataStream(io.BytesIO(body))).chunk_count
            except UNREADABLE:
                damaged(path, at)
            if counted != n_chunks:
                raise SessionError("damaged-session", place=path, where=f": {n_chunks} of {counted} chunks were found")


def _without_torn_chunk(path: Path, file: BinaryIO, last: tuple[int, int], end: int) -> int:
    """Return ``end``, or the start of the last chunk if a power cut kept its space on disk but not its bytes."""
    try:
        chunk_records(path, file, *last, ZstdDecompressor())
    except SessionError:
        return last[0] - RECORD.size
    return end


# ------------------------------------------------------------------------------------------- recovery of a damaged file

MAX_BAD = 1000  # records; for each, a chunk may have been decompressed
MAX_TRIES = 100_000  # positions checked in one search; a file of chunks has no false ones
MAX_ITEMS = 1000  # attachments, and metadata records
MAX_SUMMARY_BYTES = 16 << 20  # a day's chunks
_BLOCK = 1 << 20
_DATA_END = RECORD.pack(Opcode.DATA_END, 4)
# What is searched for: a chunk, an attachment, metadata or the end of data, of less than 4 GiB.
_START = re.compile(rb"[\x06\x09\x0c\x0f](?=.{4}\0{4})", re.DOTALL)
_CHUNK_HEAD = struct.Struct("<QQQII")


@dataclass(frozen=True)
class Damage:
    """A place where a file is damaged. ``at``: its first byte, None if only a CRC reveals it. Times in seconds of the
    session.

    ``lost_s`` of the ``of_s`` seconds are missing, starting ``from_s`` after the first message.
    """

    at: int | None
    lost_s: float
    of_s: float
    from_s: float = 0.0


@dataclass
class IntactParts:
    """Intact parts of a file. ``spans`` are byte ranges that contain only complete records."""

    channels: dict[int, str]
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)
    spans: list[tuple[int, int]] = field(default_factory=list)
    damage: tuple[Damage, ...] = ()
    unread_bytes: int = 0  # not in a complete record
    counted: dict[str, int] = field(default_factory=dict)  # messages by topic, according to the end of the file
    first_ns: int | None = None
    last_ns: int | None = None  # of the messages, by MCAP's log time
    numbers: dict[str, set[int]] = field(default_factory=lambda: {topic: set() for topic in REPEATED})
    _gaps: list[tuple[int, int | None, int | None]] = field(default_factory=list)  # at byte, times before and after
    _proven: set[str] = field(default_factory=set)  # metadata and attachments with a CRC

    def bad(self, at: int) -> None:
        """Note that the record at ``at`` is invalid or incomplete; consecutive ones count as one."""
        if not self._gaps or self._gaps[-1][2] is not None:
            self._gaps.append((at, self.last_ns, None))

    def good(self, start: int, end: int) -> None:
        """Note a complete record."""
        if self.spans and self.spans[-1][1] == start:
            start = self.spans.pop()[0]
        self.spans.append((start, end))

    def add(self, records: dict[str, Any], name: str, content: Any, proven: bool) -> None:
        """Note metadata or an attachment. Without a CRC it may consist of zeros, and never replaces one with a CRC."""
        if proven or (name and name not in self._proven):
            records[name] = content
        if proven:
            self._proven.add(name)

    def declare(self, entries: dict[str, str]) -> None:
        """Note the channels that the writer declares outside of the chunks, if it does."""
        named = {int(number): topic for number, topic in entries.items() if re.fullmatch("[0-9]{1,5}", number)}
        if len(named) <= MAX_CHANNELS:
            self.channels.update(named)

    def saw(self, first_ns: int, last_ns: int) -> None:
        """Note the message times of a complete chunk."""
        self._close(first_ns)
        self.first_ns = first_ns if self.first_ns is None else min(self.first_ns, first_ns)
        self.last_ns = last_ns if self.last_ns is None else max(self.last_ns, last_ns)

    def finish(self, complete: bool, span: tuple[int, int] | None) -> bool:
        """Compute ``damage``; return whether the end of the session is known.

        ``span``: times of the first and last message according to the file's summary, if it is readable.
        """
        if self._gaps and self._gaps[-1][2] is None and not (complete and span):
            self._gaps.pop()  # nothing follows, and nothing says how long it was
            complete = False
        first, last = span or (self.first_ns or 0, self.last_ns or 0)
        of_s = 1e-9 * max(0, last - first)
        times = [(at, first if a is None else a, last if b is None else b) for at, a, b in self._gaps]
        self.damage = tuple(
            Damage(at, 1e-9 * max(0, after - before), of_s, 1e-9 * max(0, before - first))
            for at, before, after in times
        )
        return complete

    def _close(self, now_ns: int) -> None:
        if self._gaps and self._gaps[-1][2] is None:
            self._gaps[-1] = (*self._gaps[-1][:2], now_ns)


def salvage(path: Path, file: BinaryIO) -> tuple[IntactParts, bool]:
    """Return the intact parts of a file, and whether it has its end. Raises SessionError if hardly anything is intact."""
    size = os.fstat(file.fileno()).st_size
    complete = has_footer(file, size)
    channels, span, counted = _summary(path, file, size) if complete else ({}, None, {})
    whole = IntactParts(channels, counted={channels[k]: n for k, n in counted.items() if k in channels})
    at: int | None = len(MCAP0_MAGIC)
    n_bad = 0
    file.seek(0)
    if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
        whole.bad(0)
        whole.unread_bytes += len(MCAP0_MAGIC)
    while at is not None and at + RECORD.size <= size:
        file.seek(at)
        opcode, length = RECORD.unpack(file.read(RECORD.size))
        end = at + RECORD.size + length
        if end <= size and _is_whole(path, file, opcode, at, length, whole):
            if opcode == Opcode.DATA_END:
                break
            whole.good(at, end)
            at = end
            continue
        n_bad += 1
        if n_bad > MAX_BAD:
            raise SessionError(f"{path}: is damaged in more than {MAX_BAD} places; copy it again")
        whole.bad(at)
        begin, at = at, end if _may_begin(file, end, size) else _search(file, at + 1, size)
        whole.unread_bytes += (size if at is None else at) - begin
    if at is not None and not complete:
        whole.unread_bytes += size - at
    return whole, whole.finish(complete, span)


def _is_whole(path: Path, file: BinaryIO, opcode: int, at: int, length: int, whole: IntactParts) -> bool:
    """Return whether a record passes all possible checks; its contents are added to ``whole``."""
    body = at + RECORD.size
    try:
        if opcode == Opcode.CHUNK:
            if not _fits(file, at, body + length):  # the library would skip bytes after the contents of the chunk
                return False
            _take_messages(path, chunk_records(path, file, body, length, ZstdDecompressor()), whole)
        elif opcode in (Opcode.CHANNEL, Opcode.MESSAGE, Opcode.SCHEMA):
            _take_messages(
                path, RECORD.pack(opcode, length) + body_of(path, file, body, length, MAX_CHUNK_BYTES), whole
            )
        elif opcode == Opcode.METADATA:
            name, entries, proven = parse_metadata(path, body_of(path, file, body, length, MAX_METADATA_BYTES), body)
            whole.add(whole.metadata, name, entries, proven)
            if name == CHANNELS and proven:  # wrong names would turn intact messages into others
                whole.declare(entries)
        elif opcode == Opcode.ATTACHMENT:
            name, data, proven = parse_attachment(path, body_of(path, file, body, length, MAX_ATTACHMENT_BYTES), body)
            whole.add(whole.attachments, name, data, proven)
        elif opcode == Opcode.MESSAGE_INDEX:
            head = body_of(path, file, body, min(length, 6), 6)
            return length >= 6 and int.from_bytes(head[2:], "little") == length - 6 and length % 16 == 6
        else:
            return (opcode == Opcode.DATA_END and length == 4) or (opcode == Opcode.HEADER and at == len(MCAP0_MAGIC))
    except SessionError:
        return False
    if len(whole.metadata) > MAX_ITEMS or len(whole.attachments) > MAX_ITEMS:
        raise SessionError(f"{path}: holds more than {MAX_ITEMS} attachments or metadata records")
    return True


def _take_messages(path: Path, data: bytes, whole: IntactParts) -> None:
    channels = dict(whole.channels)
    (messages,) = batches(path, [data], channels)
    whole.channels.update(channels)
    for topic, numbers in whole.numbers.items():
        numbers.update(messages.sequence[messages.rows(topic.__eq__)].tolist())
    if len(messages):
        whole.saw(int(messages.log_ns.min()), int(messages.log_ns.max()))


def _may_begin(file: BinaryIO, at: int, size: int) -> bool:
    """Return whether a record may begin at ``at`` or the file ends there; otherwise the length that led there is wrong."""
    if at + RECORD.size > size:
        return at == size
    file.seek(at)
    opcode, length = RECORD.unpack(file.read(RECORD.size))
    return bool(Opcode.HEADER <= opcode <= Opcode.DATA_END and length <= size - at - RECORD.size)


def _search(file: BinaryIO, at: int, size: int) -> int | None:
    """Return the next position at which a record seems to begin; None if there is none or the limits are reached."""
    tries = 0
    while at + RECORD.size <= size:
        file.seek(at)
        block = file.read(_BLOCK + RECORD.size - 1)
        for found in _START.finditer(block):
            if _fits(file, at + found.start(), size):
                return at + found.start()
            tries += 1
            if tries > MAX_TRIES:
                return None
        at += _BLOCK
    return None


def _fits(file: BinaryIO, at: int, size: int) -> bool:
    """Return whether the lengths inside a record agree with its own."""
    file.seek(at)
    opcode, length = RECORD.unpack(file.read(RECORD.size))
    if length > size - at - RECORD.size:
        return False
    if opcode == Opcode.DATA_END:
        return bool(length == 4)
    if opcode != Opcode.CHUNK:
        return bool(length <= (MAX_METADATA_BYTES if opcode == Opcode.METADATA else MAX_ATTACHMENT_BYTES))
    head = file.read(_CHUNK_HEAD.size)
    if len(head) < _CHUNK_HEAD.size or length > MAX_CHUNK_BYTES:
        return False
    n_name = _CHUNK_HEAD.unpack(head)[4]
    if n_name > 8:
        return False
    name_and_size = file.read(n_name + 8)
    n_data = int.from_bytes(name_and_size[n_name:], "little")
    return bool(_CHUNK_HEAD.size + n_name + 8 + n_data == length)


_Summary = tuple[dict[int, str], tuple[int, int] | None, dict[int, int]]


def _summary(path: Path, file: BinaryIO, size: int) -> _Summary:
    """Return what a complete file repeats at its end.

    These are its channels, the times of its first and last message, and the number of messages per channel. If bytes
    are missing, the footer's offset is wrong: the summary is then what follows the end of data.
    """
    tail = min(size, MAX_SUMMARY_BYTES)
    file.seek(size - tail)
    found = file.read(tail).rfind(_DATA_END)
    channels: dict[int, str] = {}
    counts: dict[int, int] = {}
    span = None
    if found < 0:
        return channels, span, counts
    start = size - tail + found
    try:
        for opcode, at, length in records(file, size, start):
            if opcode == Opcode.CHANNEL:
                body = RECORD.pack(opcode, length) + body_of(path, file, at, length, MAX_METADATA_BYTES)
                list(batches(path, [body], channels))
            elif opcode == Opcode.STATISTICS:
                body = body_of(path, file, at, length, MAX_METADATA_BYTES)
                statistics = Statistics.read(ReadDataStream(io.BytesIO(body)))
                span = statistics.message_start_time, statistics.message_end_time
                counts = statistics.channel_message_counts
    except (SessionError, *UNREADABLE):  # the summary is damaged too: what was read of it is used
        pass
    return channels, span, counts
