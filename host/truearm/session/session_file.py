"""Reading a session file, complete or cut off in the middle, within bounds.

The records' layout is the mcap library's; the walk over them is ours for two reasons: a stranger's file may claim any
size, which the library would allocate, and messages are wanted as they stand in the file, several times faster
than through its indices (1.3 µs a message of 200 bytes).
"""

from __future__ import annotations

import io
import os
import zlib
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Statistics
from mcap.writer import MCAP0_MAGIC

from truearm.errors import Argument, SessionError
from truearm.session.mcap_records import (
    ADVICE,
    MAX_ATTACHMENT_BYTES,
    MAX_CHUNK_BYTES,
    MAX_METADATA_BYTES,
    RECORD,
    UNREADABLE,
    body_of,
    chunk_records,
    damaged,
    has_footer,
    open_file,
    parse_attachment,
    parse_metadata,
    records,
)
from truearm.session.message_columns import Messages, batches
from truearm.session.salvage import MAX_ITEMS, Damage, salvage
from truearm.types import Message

_CRC_BLOCK = 1 << 20


@dataclass(frozen=True)
class Session:
    """An opened session file.

    ``truncated``: the recorder did not complete it; ``messages`` then ends where the file does. ``metadata`` maps
    record names to their entries (of several records of one name the last), ``attachments`` names to bytes.
    ``damage``: what ``messages`` leaves out elsewhere, if that was allowed.
    """

    path: Path
    metadata: dict[str, dict[str, str]]
    attachments: dict[str, bytes]
    truncated: bool
    spans: tuple[tuple[int, int], ...]  # bytes between which there are whole records alone
    channels: dict[int, str] = field(default_factory=dict)  # that the records themselves may not declare
    damage: tuple[Damage, ...] = ()
    unread_bytes: int = 0  # of a damaged file: those that stand in no whole record
    counted: dict[str, int] = field(default_factory=dict)  # messages by topic as a damaged file's end has them

    def messages(self, topics: Collection[str] | None = None) -> Iterator[Message]:
        """Messages of ``topics`` (all if None) in the order in which they were written.

        Raises SessionError where the file is damaged.
        """
        wanted = None if topics is None else frozenset([topics] if isinstance(topics, str) else topics)
        for messages in self.batches():
            yield from messages.of(messages.rows(lambda topic: wanted is None or topic in wanted))

    def batches(self) -> Iterator[Messages]:
        """All messages as columns, some megabytes at a time, in the order in which they were written.

        Raises SessionError where the file is damaged.
        """
        return batches(self.path, self.packed(), dict(self.channels))

    def numbered(self) -> Iterator[tuple[int, Message]]:
        """All messages, each with the number that its writer gave it within its topic."""
        for messages in self.batches():
            yield from zip(messages.sequence.tolist(), messages.of(np.arange(len(messages))), strict=True)

    def packed(self) -> Iterator[bytes]:
        """The records of one chunk after the other."""
        with open_file(self.path) as file:
            for start, end in self.spans:
                for opcode, at, length in records(file, end, start):
                    if opcode == Opcode.CHUNK:
                        yield chunk_records(self.path, file, at, length)
                    elif opcode in (Opcode.CHANNEL, Opcode.MESSAGE):  # files of other programs need not have chunks
                        yield RECORD.pack(opcode, length) + body_of(self.path, file, at, length, MAX_CHUNK_BYTES)


def open_session(path: Path | str, allow_damaged: bool = False) -> Session:
    """Open a session file and read all but its messages.

    A file without its end (the recorder was killed, or is still at work) or with damage raises SessionError unless
    ``allow_damaged``; then what is whole of it is found. Raises SessionError too for what is missing, no MCAP or of absurd
    size. A complete file is read once as a whole, to hold it against its CRC (1 s a GB); a damaged one a second time.
    """
    path = Path(path)
    with open_file(path) as file:
        if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
            raise SessionError(f"{path}: is no MCAP file; give a session that truearm record wrote")
        try:
            session, proven = _scan(path, file)
        except SessionError:
            if not allow_damaged:
                raise
            return _salvaged(path, file, known_damaged=True)
        if allow_damaged and not proven:
            return _salvaged(path, file, known_damaged=False)
    if session.truncated and not allow_damaged:
        raise SessionError(
            f"{path}: ends in the middle: the recorder was killed or is still running; to use what is there, give ",
            Argument("allow_damaged"),
        )
    return session


def _salvaged(path: Path, file: BinaryIO, known_damaged: bool) -> Session:
    whole, complete = salvage(path, file)
    damage = whole.damage
    if known_damaged and complete and not damage:
        damage = (Damage(None, 0.0, 0.0),)
    found = whole.metadata, whole.attachments, not complete, tuple(whole.spans), whole.channels
    return Session(path, *found, damage, whole.unread_bytes, whole.counted)


def _scan(path: Path, file: BinaryIO) -> tuple[Session, bool]:
    """The session, and whether a CRC proves that it is as it was written."""
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
            return Session(path, metadata, attachments, not has_footer(file, size), ((start, end),)), proven
        if opcode == Opcode.CHUNK:
            last_chunk = at, length
            n_chunks += 1
        elif opcode == Opcode.METADATA:
            name, entries, _ = parse_metadata(path, body_of(path, file, at, length, MAX_METADATA_BYTES), at)
            metadata[name] = entries
        elif opcode == Opcode.ATTACHMENT:
            name, data = parse_attachment(path, body_of(path, file, at, length, MAX_ATTACHMENT_BYTES), at)
            attachments[name] = data
        if len(metadata) > MAX_ITEMS or len(attachments) > MAX_ITEMS:
            raise SessionError(f"{path}: holds more than {MAX_ITEMS} attachments or metadata records")
        end = at + length
    if last_chunk is not None:
        end = _without_torn_chunk(path, file, last_chunk, end)
    if has_footer(file, size):
        damaged(path, end)  # complete, yet the walk did not come to its end: a length is wrong, or bytes are missing
    return Session(path, metadata, attachments, True, ((start, end),)), False


def _check_crc(path: Path, file: BinaryIO, at: int, length: int) -> bool:
    """Hold all bytes before the record DataEnd against the CRC in it; False if its writer took none."""
    written = int.from_bytes(body_of(path, file, at, length, MAX_METADATA_BYTES)[:4], "little")
    if written == 0:
        return False
    left, crc = at - RECORD.size, 0
    file.seek(0)
    while left and (block := file.read(min(left, _CRC_BLOCK))):
        crc = zlib.crc32(block, crc)
        left -= len(block)
    if crc != written:
        raise SessionError(f"{path}: is damaged: its bytes do not fit its CRC; ", *ADVICE)
    return True


def _check_chunks(path: Path, file: BinaryIO, summary: Iterator[tuple[int, int, int]], n_chunks: int) -> None:
    """Hold the chunks that were found against the file's statistics: a damaged head would hide one."""
    for opcode, at, length in summary:
        if opcode == Opcode.STATISTICS:
            body = body_of(path, file, at, length, MAX_METADATA_BYTES)
            try:
                counted = Statistics.read(ReadDataStream(io.BytesIO(body))).chunk_count
            except UNREADABLE:
                damaged(path, at)
            if counted != n_chunks:
                raise SessionError(f"{path}: is damaged: {n_chunks} of {counted} chunks were found; ", *ADVICE)


def _without_torn_chunk(path: Path, file: BinaryIO, last: tuple[int, int], end: int) -> int:
    """``end``, or the start of the last chunk if a power cut left its place on the disk but not its bytes."""
    try:
        chunk_records(path, file, *last)
    except SessionError:
        return last[0] - RECORD.size
    return end
