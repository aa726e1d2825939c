"""Read a session file, complete or truncated, within bounds.

The record layout is that of the mcap library. Iterating over the records is done here for two reasons. An untrusted
file may claim any size, which the library would allocate. And messages are needed in the order of the file, which is
several times faster than through its indices (1.3 µs for a message of 200 bytes).

A complete file has a CRC of all its bytes. If that matches, nothing else is checked. Otherwise, every record is checked by
itself: a chunk and an attachment have a CRC, and ours among the metadata too. Behind a damaged record, the next intact one
is searched for. One flipped bit therefore costs the second of messages in its chunk. Records without a CRC (headers,
metadata of other programs) are accepted as they are.

The writer repeats metadata and attachments, of which any intact copy is as good as the first. Of a damaged file, the plan
and what was mounted are read from their copy.
"""

from __future__ import annotations

import io
import os
import re
import struct
import zlib
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Statistics
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC
from zstandard import ZstdDecompressor

from truearm.errors import SessionError
from truearm.file_names import open_input
from truearm.progress import step
from truearm.session.message_columns import (
    CHANNELS,
    FOOTER_BYTES,
    MAX_ATTACHMENT_BYTES,
    MAX_CHANNELS,
    MAX_CHUNK_BYTES,
    MAX_METADATA_BYTES,
    PLAN_COPY,
    RECORD,
    Messages,
    Unreadable,
    batches,
    chunk_fits,
    chunk_records,
    columns_of_records,
    has_footer,
    parse_attachment,
    parse_metadata,
    records,
)
from truearm.types import Message

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
    """A place where a file is damaged. ``at``: its first byte, None if only a CRC reveals it. Times in seconds of the
    session.

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
        wanted = None if topics is None else frozenset([topics] if isinstance(topics, str) else topics)
        for messages in self.batches():
            yield from messages.of(messages.rows(lambda topic: wanted is None or topic in wanted))

    def batches(self) -> Iterator[Messages]:
        """Yield all messages as columns, some megabytes at a time, in the order of writing.

        Raises SessionError if the file is damaged. Restored messages come first.
        """
        read = batches(self.path, self.packed(), dict(self.channels))
        return read if self.restored is None else chain([self.restored], map(self._not_restored, read))

    def packed(self) -> Iterator[bytes]:
        """Yield the records of one chunk after the other."""
        zstd = ZstdDecompressor()
        with open_input(self.path) as file, step(f"reading {self.path.name}") as advance:
            for number, (at, length) in enumerate(self.chunks):
                advance(number / len(self.chunks))
                file.seek(at)
                try:
                    yield chunk_records(file.read(length), zstd)
                except Unreadable as exc:
                    raise SessionError("damaged-session", place=self.path, where=f"at byte {at}") from exc

    def _not_restored(self, messages: Messages) -> Messages:
        """Return the messages that are not in the copy of the plan."""
        assert self.restored is not None
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
            where = f"at byte {walk.damaged_at[0]}" if walk.damaged_at else wrong_crc
            raise SessionError("damaged-session", place=path, where=where)
        return walk.salvaged(bool(wrong_crc))


class RecordWalk:
    """Goes through the records of a file.

    ``every_record``: check each record, and search for the next one behind a damaged one. Otherwise stop there, and leave
    the chunks packed.
    """

    def __init__(self, path: Path, file: BinaryIO, every_record: bool) -> None:
        self.session = Session(path)
        self.damaged_at: list[int] = []
        self.crc = 0  # of all bytes before ``_data_end``, as the file states it; 0: not stated
        self._file, self._every_record = file, every_record
        self._size = os.fstat(file.fileno()).st_size
        file.seek(0)
        self.has_magic = file.read(len(MCAP0_MAGIC)) == MCAP0_MAGIC
        self.complete = has_footer(file, self._size)
        self._span_ns: tuple[int, int] | None = None  # of the messages, as the end of the file states it
        self._times_ns: list[tuple[int, int]] = []  # of the messages of each chunk
        self._gaps: list[int] = []  # chunks before each damaged place
        self._proven: set[str] = set()  # metadata and attachments with a CRC
        self._data_end = 0
        if every_record and self.complete:
            self._summary()

    def walk(self) -> None:
        """Go through all records up to the end of data."""
        at = len(MCAP0_MAGIC) if self.has_magic else 0
        while at + RECORD.size <= self._size and not self._data_end:
            end = self._record(at)
            if end is None:
                self.damaged_at.append(at)
                self._gaps.append(len(self._times_ns))
                if not self._every_record:
                    return
                begin, at = at, self._search(at + 1)
                self.session.unread_bytes += at - begin
            else:
                at = end
        self.session.unread_bytes += 0 if self._data_end else self._size - at

    def wrong_crc(self) -> str:
        """Return where a CRC of a complete file does not match, "" if nowhere."""
        if not self._data_end:
            return "somewhere: its end of data is missing"
        self._file.seek(0)
        crc = 0
        while block := self._file.read(min(self._data_end - self._file.tell(), _BLOCK)):
            crc = zlib.crc32(block, crc)
        return "" if self.crc in (0, crc) else "somewhere: its CRC does not match"

    def salvaged(self, wrong_crc: bool) -> Session:
        """Return the session, with what is missing in each damaged place."""
        session, times_ns = self.session, self._times_ns
        gaps = [*zip(self.damaged_at, self._gaps, strict=True)]
        session.truncated = not self.complete
        if gaps and gaps[-1][1] == len(times_ns) and not (self.complete and self._span_ns):
            gaps.pop()  # nothing follows, and nothing says how long it was
            session.truncated = True
        first = min((begin for begin, _ in times_ns), default=0)
        first, last = self._span_ns or (first, max((end for _, end in times_ns), default=0))
        damage = dict[int, Damage]()
        for at, chunks in gaps:
            before = max((end for _, end in times_ns[:chunks]), default=first)
            after = min((begin for begin, _ in times_ns[chunks:]), default=last)
            lost_s, of_s, from_s = (1e-9 * max(0, ns) for ns in (after - before, last - first, before - first))
            damage.setdefault(chunks, Damage(at, lost_s, of_s, from_s))  # several places between two chunks are one
        session.damage = tuple(damage.values())
        if wrong_crc and not session.truncated and not damage:
            session.damage = (Damage(None, 0.0, 0.0),)
        copy = session.attachments.pop(PLAN_COPY, None)
        session.restored = None if copy is None else _messages_of_copy(copy)
        return session

    def _record(self, at: int) -> int | None:
        """Take the record at ``at`` and return where it ends; None if it is damaged."""
        self._file.seek(at)
        opcode, length = RECORD.unpack(self._file.read(RECORD.size))
        begin = at + RECORD.size
        end: int = begin + length
        if (
            end > self._size
            or length > _LIMITS.get(opcode, -1)
            or (opcode == Opcode.HEADER) != (at == len(MCAP0_MAGIC))
        ):
            return None
        session = self.session
        if opcode == Opcode.CHUNK and not self._every_record:
            session.chunks.append((begin, length))
            return end
        body = self._file.read(length)
        try:
            if opcode == Opcode.DATA_END:
                if length != _LIMITS[opcode]:
                    return None
                self.crc, self._data_end = int.from_bytes(body, "little"), at
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

    def _search(self, at: int) -> int:
        """Return the next position at which a record seems to begin; the end of the file if there is none."""
        if len(self.damaged_at) > MAX_BAD:
            raise SessionError(f"{self.session.path}: is damaged in more than {MAX_BAD} places; copy it again")
        while at + RECORD.size <= self._size:
            self._file.seek(at)
            block = self._file.read(_BLOCK + _HEAD_BYTES)
            for start in _START.finditer(block, 0, _BLOCK + RECORD.size - 1):
                begin = start.start()
                opcode, length = RECORD.unpack_from(block, begin)
                fits = length <= _LIMITS[opcode] and length <= self._size - at - begin - RECORD.size
                if fits and (opcode != Opcode.CHUNK or chunk_fits(block[begin + RECORD.size :], length)):
                    return at + begin
            at += _BLOCK
        return self._size

    def _summary(self) -> None:
        """Read what a complete file repeats at its end: its channels, and times and number of the messages."""
        self._file.seek(self._size - len(MCAP0_MAGIC) - FOOTER_BYTES)
        self._file.seek(min(int.from_bytes(self._file.read(8), "little"), self._size))
        channels = self.session.channels
        try:
            for record in StreamReader(self._file, skip_magic=True, record_size_limit=MAX_METADATA_BYTES).records:
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
    file = io.BytesIO(copy)
    places = [(at, length) for opcode, at, length in records(file, len(copy)) if opcode == Opcode.CHUNK]
    try:
        chunks = [chunk_records(copy[at : at + length], ZstdDecompressor()) for at, length in places]
        return columns_of_records(chunks, {}) if chunks else None
    except Unreadable:
        return None
