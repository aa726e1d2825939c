"""Write a session file: MCAP that survives a crash.

Messages are collected in a chunk of at most CHUNK_NS, and flushed to the disk once a second. A killed recorder loses
less than a second. Log times are UTC by one pair of times (metadata ``session``); publish times are the host's own
clock, which all computations use.

The robot's lines are accompanied by their numbers as columns. What every message needs is repeated: metadata once a
minute, attachments and a copy of the plan every ten minutes, and at the end. A completed file ends with a CRC.

Twice a second the writer checks its file (``file_loss``). A deleted or replaced file is copied from the open descriptor
to a new one, where the recording continues. Others are written to as before.
"""

from __future__ import annotations

import io
import json
import os
import sys
import tempfile
import time
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import reduce
from itertools import count
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from mcap.writer import CompressionType, Writer

from truearm.disk import hold
from truearm.errors import InputError, WriteError
from truearm.record.links import Clock
from truearm.session.joint_format import ARRAYS, COLUMNS, JOINTS, READINGS, JointLine, columns_of_rows, pack, parse_line
from truearm.session.session_file import CHANNELS, CRC, LATEST_NS, PLAN_COPY, metadata_crc
from truearm.types import BAR_MOUNTED, LINE_MOUNTED
from truearm.version import VERSION
from truearm_wire import messages as wire

PREVIEW = "/preview/"  # followed by a stream's name
ROBOT_PREVIEW = "/robot/preview"
PREVIEW_NS = 100_000_000  # between two values displayed

_INTEGER, _NUMBER, _TEXT, _BOOLEAN = ({"type": name} for name in ("integer", "number", "string", "boolean"))
_NUMBERS = {"type": "array", "items": _NUMBER}
_MOUNTED = dict.fromkeys((*BAR_MOUNTED, "shell", *LINE_MOUNTED), _TEXT)
_LINE = {
    **{"t": _NUMBER, "seq": _INTEGER},
    **dict.fromkeys(("q", *ARRAYS), _NUMBERS),
    **dict.fromkeys(("inputs", "robot_mode", "runtime_state"), _INTEGER),
    **{"line": _TEXT, "arrival": _BOOLEAN},
}
_JSON: dict[str, dict[str, Any]] = {
    "/sync": dict.fromkeys(("id", "t0_ns", "t1_us", "t2_us", "t3_ns"), _INTEGER),
    **dict.fromkeys((JOINTS, ROBOT_PREVIEW), _LINE),
    "/events": {
        "kind": _TEXT,
        **_MOUNTED,
        **dict.fromkeys(("text", "reason", "device"), _TEXT),
        **dict.fromkeys(("begin_ns", "end_ns", "heard_ns", "pose", "lost", "boot_id", "boot_id_before"), _INTEGER),
        **dict.fromkeys(("mean_m", "noise_m", "away_s"), _NUMBER),
        "settled": _BOOLEAN,
    },
    "/plan": {"pose": _INTEGER, "move": _TEXT, **_MOUNTED, "speed_m_s": _NUMBER, "q": _NUMBERS},
}
_FRAMES = (
    *(wire.DATA, wire.EVENT, wire.HEARTBEAT, wire.IDENT, wire.TEMPERATURE, wire.SYNC_REPLY, wire.REPLY, wire.ERROR),
)
_COLUMNS = """; n readings of j joints: those since the last such message
columns = {"arrival_ns": ints, "t": floats, "seq": ints, "q": floats, * text => ints / floats}
floats = #6.86(bytes) ; RFC 8746 float64, little endian
ints = #6.79(bytes)   ; RFC 8746 sint64, little endian
"""
_BYTES = "received bytes that are not a frame or a reading, exactly as they came"


class Encodings(NamedTuple):
    """A channel's encoding, and the name, encoding and data of its schema."""

    message: str
    name: str
    schema: str
    data: str


def encodings_of(topic: str, first: bytes) -> Encodings:
    """Return the encodings of a topic, given its first message (docs/reference/session-format.md).

    PlotJuggler looks up every channel's schema. Foxglove reads JSON with a JSON schema in which every property has one
    type; it does not support CBOR.
    """
    if topic in ("/box/console", "/robot/console"):
        return Encodings("application/octet-stream", "truearm/bytes", "text/plain", _BYTES)
    if topic in (COLUMNS, READINGS):
        return Encodings("cbor", "truearm" + topic, "cddl", _COLUMNS)
    if topic.startswith("/box/"):
        return Encodings("cbor", "truearm" + topic, "cddl", _grammar())
    properties = _JSON.get(topic, {})
    if topic.startswith(PREVIEW):
        properties = dict.fromkeys(json.loads(first), _NUMBER)
    return Encodings("json", "truearm" + topic, "jsonschema", json.dumps({"type": "object", "properties": properties}))


def _grammar() -> str:
    """Return the CDDL (RFC 8610) of a box's frames; protocol/SPEC.md §4 explains them.

    ``/box/other`` has others too.
    """
    frames = (
        f"[{', '.join([str(kind), *(f'{name}: any' for name in wire.names(kind)), '* any'])}]" for kind in _FRAMES
    )
    return f"frame = {' / '.join(frames)}\n"


# ------------------------------------------------------------------------------------------- what others do to the file

COPIED_BYTES = 1 << 20  # per step


def file_loss(file: BinaryIO, path: Path, size: int) -> str:
    """Return what happened to ``file``, opened at ``path`` with ``size`` bytes written; "" if nothing.

    It is "truncated", "renamed", "deleted" or "replaced". A POSIX system keeps a deleted file for as long as it is
    open, so all of it can still be copied. Data lost by a truncation cannot be recovered.
    """
    status = os.fstat(file.fileno())
    if status.st_size < size:
        return "truncated"
    try:
        return "" if os.path.samestat(status, path.stat()) else "replaced"
    except OSError:
        return "renamed" if status.st_nlink else "deleted"


def rescued_file(file: BinaryIO, size: int, path: Path) -> tuple[Path, BinaryIO]:
    """Copy the first ``size`` bytes of an open file to a new one named after ``path``.

    The open file need not have a name any more. The new one is ``session-rescued.mcap``, ``session-rescued-2.mcap`` …

    It is in the folder of ``path``, which is created again if it was removed. If that is impossible or its disk is
    full, it is in the system's folder for temporary files. Raises OSError if it cannot be written there either. A copy
    that is not complete is removed.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        return _copied(file, size, path)
    except OSError:
        return _copied(file, size, Path(tempfile.gettempdir()) / path.name)


def _copied(file: BinaryIO, size: int, path: Path) -> tuple[Path, BinaryIO]:
    names = (f"{path.stem}-rescued{'' if number == 1 else f'-{number}'}{path.suffix}" for number in count(1))
    out = next(path.with_name(name) for name in names if not path.with_name(name).exists())
    copy = out.open("x+b")
    hold(copy)
    try:
        for data in _pieces(file, size):
            copy.write(data)
        copy.flush()
        os.fsync(copy.fileno())
    except OSError:
        out.unlink()
        with suppress(OSError):  # a full disk refuses the same bytes again
            copy.close()
        raise
    return out, copy


def _pieces(file: BinaryIO, size: int) -> Iterator[bytes]:
    """Yield the first ``size`` bytes of an open file. Raises OSError if it is shorter."""
    file.seek(0)
    while size:
        data = file.read(min(COPIED_BYTES, size))
        if not data:
            raise OSError(None, "the file became shorter")
        yield data
        size -= len(data)


def content_crc(file: BinaryIO, size: int) -> int:
    """Return the CRC-32 of the first ``size`` bytes of an open file.

    Takes about 1 s per GB. Raises OSError if it is shorter.
    """
    return reduce(lambda crc, data: zlib.crc32(data, crc), _pieces(file, size), 0)


# ----------------------------------------------------------------------------------------------------------- the writer

CHUNK_NS = 800_000_000  # with the recorder's interval of 50 ms no message waits longer than 1 s
_CHUNK_BYTES = 1 << 20
_COPY_EVERY = 75  # chunks: the metadata are repeated once a minute
_ATTACHED_EVERY = 10 * _COPY_EVERY
_COLUMN_LINES = 1024  # maximum; a reader holds this many in memory
_FSYNC_EVERY_S = 0.9
_WATCH_EVERY_S = 0.5
_OUTCOMES = {  # what becomes of a file that is still there
    "truncated": "its earlier content is lost; truearm session recover saves what was written since",
    "renamed": "the recording continues in it, under its new name",
}

_as_json = json.JSONEncoder(separators=(",", ":")).encode  # one for all rows: dumps would make a new one each time

Anchor = tuple[int, int]  # the same instant in UTC and on the host's clock [ns]


_Message = tuple[int, int, bytes, int, int]  # arguments of add_message(): channel, log time, data, publish time, number


class SessionWriter:
    """An open session file. ``close`` (or leaving the ``with`` block) completes it; an unclosed file is readable too.

    With ``hold`` there is no file if the writer is closed before ``keep``; in place of an earlier recording, nothing is
    written before it. Without a ``clock`` the file is a copy of a finished recording: it contains no times of its own
    except those in ``metadata`` and ``close``.

    Messages get their log time from the last metadata ``session``. Before it, or if it has no pair of times, the host's
    clock is used.

    Raises InputError if the file cannot be created, WriteError if it cannot be written (a full disk).
    """

    def __init__(self, path: Path, clock: Clock | None, *, overwrite: bool = False, hold: bool = False) -> None:
        self.path = path
        self._overwrite = overwrite
        self.kept = not hold  # whether there is a file
        self._new = False  # not an earlier recording
        self._file = self._open()
        self._out = _Output(self._file if self._new or not hold else io.BytesIO())
        self._clock = clock
        self._channels: dict[str, _Channel] = {}  # by topic
        self._utc_offset_ns = 0  # UTC minus the host's clock
        self._chunk_since_ns: int | None = None
        self._chunk_bytes = 0
        self._latest_ns = 0
        self._readings: list[JointLine | None] = []  # without columns yet; None for a line that is not a reading
        self._arrival_ns: list[int] = []
        self._columns = COLUMNS  # their topic
        self._synced_s = self._watched_s = time.monotonic()
        self.losses: list[str] = []  # what happened to the file, one sentence each
        self._reported = ""  # what happened to this file, as far as it is in ``losses``
        self._failure: WriteError | None = None  # of a write: nothing more is written
        self._size = 0  # on the disk, as last written
        self._head: list[_Message] = []  # the plan and what is mounted, which a replacement file must also contain
        self._metadata: dict[str, dict[str, str]] = {}
        self._attachments: dict[str, bytes] = {}
        self._chunks = 0
        self._writer = _begun(self._out)
        if clock is not None:
            self.metadata("session", {"version": VERSION, "clock": clock.kind, **_anchor(clock)})

    def __enter__(self) -> SessionWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def keep(self) -> None:
        """Let the file be a session, in place of an earlier one. A second call does nothing."""
        if not self.kept and self._new and self._size_on_disk() != self._size:
            raise InputError("file-exists", place=self.path, may_force=True)  # somebody else's, of the same name
        self.kept, held = True, self._out.file
        if not isinstance(held, io.BytesIO):
            return
        if file_loss(self._file, self.path, 0):  # of the earlier recording
            self._file.close()
            self._file = self._open()
        self._out.file = self._file
        try:
            self._file.truncate(self._file.seek(0))
            self._file.write(held.getvalue())
            self._flushed()
        except OSError as exc:
            raise self._cannot_write(exc) from exc

    def add(self, topic: str, t_host_ns: int, data: bytes, sequence: int | None = None) -> None:
        """Append a message unchanged; ``sequence`` is its number within its topic, by default the next one.

        Columns of joint readings are left out: the writer makes its own.
        """
        if topic == JOINTS:
            self.add_reading(t_host_ns, data, parse_line(data), sequence)
        elif topic != COLUMNS:
            if topic == "/events":
                self._add_columns()
            self._add(topic, t_host_ns, data, sequence)
            self._end_chunk(t_host_ns)

    def add_reading(
        self, t_host_ns: int, line: bytes | None, reading: JointLine | None, sequence: int | None = None
    ) -> None:
        """Append a line of the robot unchanged; ``reading`` is its contents, None if it is not a reading.

        ``line`` is None for all readings of a source that sends numbers: they become columns only.
        """
        if line is not None:
            self._add(JOINTS, t_host_ns, line, sequence)
        self._columns = READINGS if line is None else COLUMNS
        self._readings.append(reading)
        self._arrival_ns.append(t_host_ns)
        self._end_chunk(t_host_ns)

    def _end_chunk(self, t_host_ns: int) -> None:
        """After a message: write what has waited long enough."""
        self._latest_ns = t_host_ns
        if len(self._readings) >= _COLUMN_LINES:
            self._add_columns()
        if self._chunk_since_ns is None:
            self._chunk_since_ns = t_host_ns
        elif abs(t_host_ns - self._chunk_since_ns) >= CHUNK_NS or self._chunk_bytes >= _CHUNK_BYTES:
            self._finish_chunk()

    def _add(self, topic: str, t_host_ns: int, data: bytes, sequence: int | None = None) -> None:
        """Append a message to its topic's channel, and to the head if a replacement file must contain it too."""
        channel = self._channels.get(topic)
        if channel is None:
            encodings = encodings_of(topic, data)
            channel = self._channels[topic] = _Channel(_register(self._writer, topic, encodings), encodings)
            # MCAP has this only once, in the current chunk; if that chunk is lost, the others need it to be readable.
            self.metadata(CHANNELS, {str(channel.number): topic for topic, channel in self._channels.items()})
        if sequence is not None:
            channel.sequence = sequence
        message = (channel.number, t_host_ns + self._utc_offset_ns, data, t_host_ns, channel.sequence)
        self._writer.add_message(*message)
        if topic == "/plan" or (topic == "/events" and b'"mounted"' in data):
            self._head.append(message)
        channel.sequence = channel.sequence + 1 & 0xFFFFFFFF
        self._chunk_bytes += len(data)

    def _add_columns(self) -> None:
        """Add columns for the robot's lines since the last columns; none if one of the lines is not a reading."""
        readings, arrival_ns = self._readings, self._arrival_ns
        self._readings, self._arrival_ns = [], []
        rows = [reading for reading in readings if reading is not None]
        if rows and len(rows) == len(readings) and len({len(row.q) for row in rows}) == 1:
            self._add(self._columns, self._latest_ns, pack(columns_of_rows(rows, arrival_ns)))

    def add_json(self, topic: str, t_host_ns: int, row: Mapping[str, Any]) -> None:
        """Append ``row`` as JSON; entries that are None are left out."""
        entries = {key: value for key, value in row.items() if value is not None}
        self.add(topic, t_host_ns, _as_json(entries).encode())

    def event(self, kind: str, t_host_ns: int, **fields: Any) -> None:
        """Append to ``/events``."""
        self.add_json("/events", t_host_ns, {"kind": kind, **fields})

    def metadata(self, name: str, entries: Mapping[str, str]) -> None:
        """Write a metadata record. A later one of the same name replaces it."""
        if name == "session":
            utc_ns, host_ns = read_anchor(entries) or (0, 0)
            self._utc_offset_ns = max(0, utc_ns - host_ns)
        with self._writing():
            self._metadata[name] = {**entries, CRC: metadata_crc(name, entries)}
            self._writer.add_metadata(name, self._metadata[name])

    def attach(self, name: str, data: bytes) -> None:
        """Write an attachment."""
        with self._writing():
            self._add_attachment(name, data)
            self._attachments[name] = data

    def tick(self, now_ns: int) -> None:
        """End the chunk if it is old enough; call this several times a second, even when nothing arrives."""
        if self._chunk_since_ns is not None and now_ns - self._chunk_since_ns >= CHUNK_NS:
            self._finish_chunk()
        elif time.monotonic() - self._watched_s >= _WATCH_EVERY_S:
            with self._writing():
                pass

    def close(self, end: Mapping[str, str] | None = None) -> None:
        """Write the metadata ``session-end`` (the clock's anchor and ``end``, if present) and the index, and flush all.

        A second call does nothing.
        """
        if self._out.file.closed:
            return
        if not self.kept:
            unused = self._new and self._size_on_disk() == self._size
            unused = unused and not file_loss(self._out.file, self.path, self._size)
            self._out.file.close()
            self._file.close()
            if unused:
                self.path.unlink()
            return
        try:
            with self._writing():
                self._add_columns()
                self._writer.flush()
                self._copy_head(attached=True)
                entries = {**({} if self._clock is None else _anchor(self._clock)), **(end or {})}
                if entries:
                    self.metadata("session-end", entries)
                self._writer.finish()
                self._flushed()
                os.fsync(self._out.file.fileno())
                self._watch()
                if not self._reported and not self._is_as_written():
                    self.losses.append(
                        f"{self.path}: parts of it were overwritten while it was written; truearm inspect "
                        f"{self.path} shows what is left"
                    )
        finally:
            with suppress(OSError):  # a full disk refuses the same bytes again
                self._out.file.close()

    def _is_as_written(self) -> bool:
        """Return whether nobody overwrote the file or appended to it; its name is the same."""
        return self._size_on_disk() == self._size and content_crc(self._out.file, self._size) == self._out.crc

    def _size_on_disk(self) -> int:
        return os.fstat(self._out.file.fileno()).st_size

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Check the file before something is written, and flush it afterwards. Raises WriteError."""
        if self._failure is not None:
            raise self._failure
        try:
            self._watch()
            yield
            self._flushed()
        except OSError as exc:
            raise self._cannot_write(exc) from exc

    def _open(self) -> BinaryIO:
        try:
            self._new = not (self._overwrite and self.path.exists())
            file = self.path.open("x+b" if self._new else "w+b" if self.kept else "r+b")
        except FileExistsError as exc:
            raise InputError("file-exists", place=self.path, may_force=True) from exc
        except OSError as exc:
            raise InputError(f"{self.path}: cannot be written: {exc.strerror}") from exc
        if not hold(file) and not self._new:
            file.close()
            raise InputError("in-use", place=self.path)
        return file

    def _flushed(self) -> None:
        self._out.flush()
        self._size = self._out.tell()

    def _watch(self) -> None:
        """Check the file before more is written to it; report each kind of loss once. Raises OSError, WriteError."""
        if isinstance(self._out.file, io.BytesIO):
            return
        self._watched_s = time.monotonic()
        loss, old = file_loss(self._out.file, self.path, self._size), self.path
        if loss in ("", self._reported):
            return
        if loss not in _OUTCOMES:  # the file is gone; the new one has lost nothing yet
            self._move(loss)
        self._reported = loss if loss in _OUTCOMES else ""
        outcome = _OUTCOMES.get(loss, f"all of it is in {self.path}")
        self.losses.append(f"{old}: was {loss} while it was written; {outcome}")

    def _move(self, loss: str) -> None:
        """Continue in a new file that has the contents of the old one."""
        try:
            path, new = rescued_file(self._out.file, self._size, self.path)
        except OSError as exc:
            why = exc.strerror or str(exc)
            raise WriteError(
                f"{self.path}: was {loss} while it was written, and could not be copied ({why}); its content is lost",
                why,
            ) from exc
        self._out.file.close()
        self.path, self._out.file = path, new

    def _copy_head(self, attached: bool) -> None:
        """Repeat all metadata, and the attachments with a copy of the plan and of what was mounted."""
        for name, entries in self._metadata.items():
            self._writer.add_metadata(name, entries)
        if attached:
            for name, data in self._attachments.items():
                self._add_attachment(name, data)
            if self._head:
                copy = io.BytesIO()
                writer = _begun(copy)
                for topic, channel in self._channels.items():
                    _register(writer, topic, channel.encodings)  # the numbers are the same because they are sequential
                for message in self._head:
                    writer.add_message(*message)
                writer.finish()
                self._add_attachment(PLAN_COPY, copy.getvalue())

    def _add_attachment(self, name: str, data: bytes) -> None:
        media_type = "application/toml" if name.endswith(".toml") else "application/octet-stream"
        now_ns = 0 if self._clock is None else self._clock.now_ns() + self._utc_offset_ns
        self._writer.add_attachment(now_ns, now_ns, name, media_type, data)

    def _finish_chunk(self) -> None:
        self._add_columns()
        self._chunk_since_ns, self._chunk_bytes = None, 0
        with self._writing():
            self._writer.flush()
            self._chunks += 1
            if self._chunks % _COPY_EVERY == 0:
                self._copy_head(attached=self._chunks % _ATTACHED_EVERY == 0)
            # The real clock is used on purpose: in virtual time an hour passes in seconds.
            if self.kept and time.monotonic() - self._synced_s >= _FSYNC_EVERY_S:
                os.fsync(self._out.file.fileno())
                self._synced_s = time.monotonic()

    def _cannot_write(self, exc: OSError) -> WriteError:
        why = exc.strerror or str(exc)
        text = f"{self.path}: cannot be written any more ({why}); the data already in it remain readable"
        self._failure = WriteError(text, why)
        return self._failure


def _begun(out: Any) -> Writer:
    """Return a writer to an ``_Output`` or a buffer; only its ``flush`` ends a chunk."""
    writer = Writer(out, chunk_size=sys.maxsize, compression=CompressionType.ZSTD, enable_data_crcs=True)
    writer.start(profile="truearm", library=f"truearm {VERSION}")
    return writer


def _register(writer: Writer, topic: str, encodings: Encodings) -> int:
    schema = writer.register_schema(encodings.name, encodings.schema, encodings.data.encode())
    return writer.register_channel(topic, encodings.message, schema)


@dataclass
class _Channel:
    number: int
    encodings: Encodings
    sequence: int = 0  # of the next message


class _Output:
    """Destination of the session; the file behind it may change. ``crc`` is that of everything written."""

    def __init__(self, file: BinaryIO) -> None:
        self.file = file
        self.crc = 0

    def write(self, data: bytes) -> int:
        self.crc = zlib.crc32(data, self.crc)
        return self.file.write(data)

    def tell(self) -> int:
        return self.file.tell()

    def flush(self) -> None:
        self.file.flush()


def read_anchor(entries: Mapping[str, str]) -> Anchor | None:
    """Return the pair of times in metadata ``session`` or ``session-end``, None if there is none."""
    try:
        utc_ns, host_ns = int(entries["utc_ns"][:20]), int(entries["monotonic_ns"][:20])
    except (KeyError, ValueError):
        return None
    return (utc_ns, host_ns) if abs(utc_ns) < LATEST_NS and abs(host_ns) < LATEST_NS else None


def _anchor(clock: Clock) -> dict[str, str]:
    utc_ns, monotonic_ns = clock.utc_anchor()
    return {"utc_ns": str(utc_ns), "monotonic_ns": str(monotonic_ns)}
