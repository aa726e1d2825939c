"""Decode and check what a box sends (protocol/SPEC.md §4, §5): its frames, and the description of itself in idents.

Nearly all frames are data and sync replies, whose heads have a fixed layout (protocol/frames.cddl). NumPy reads these
in one pass, as a table with one row per frame, in order of arrival. All others are decoded singly and keep their
elements.

The recorder uses the functions for single frames too. Files are untrusted: each of these returns None if its input is
invalid. The recorder and every reader of a session parse idents alike. If a single channel cannot be read, that channel
gets a ``fault`` instead of an error: its counts are still worth recording, and the other channels are intact.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, NamedTuple, NoReturn

import cbor2
import msgspec
import numpy as np
from numpy.typing import NDArray

from truearm import units
from truearm.errors import ProtocolError, SessionError
from truearm.session.session_file import LATEST_NS, Messages, Session, heads
from truearm.types import Ints
from truearm.units import MDEGC
from truearm_wire import messages as wire
from truearm_wire.messages import PAGE_BYTES, PAGES_MAX

TAG_INT32 = 78
MAX_PAYLOAD = 250
MAX_DEVICE_US = 2**53  # 285 years: a later time comes from a damaged or hostile file, and ns still fit 63 bits
MAX_N0 = 2**62


class Data(NamedTuple):
    """A data frame; ``samples`` are int32."""

    seq: int
    stream: int
    n0: int
    t0_us: int
    period_ns: int
    samples: bytes
    flags: int


def data_of(frame: list[Any]) -> Data:
    """Return the elements of a data frame that conforms."""
    _, seq, stream, n0, t0_us, period_ns, samples, flags = frame[:8]
    return Data(seq, stream, n0, t0_us, period_ns, samples.value, flags)


def decode(payload: bytes) -> list[Any] | None:
    """Return the elements of a payload; None if it is not [type, seq, …]."""
    if len(payload) > MAX_PAYLOAD:
        return None
    try:
        frame = cbor2.loads(payload, max_depth=4, allow_indefinite=False)
    except cbor2.CBORError:
        return None
    if type(frame) is not list or len(frame) < 2 or type(frame[0]) is not int or type(frame[1]) is not int:
        return None
    return frame if 0 <= frame[0] < 256 and 0 <= frame[1] < 2**32 else None


# The key "boot_id" and its unsigned integer in an ident, of which the first page has only a part.
_BOOT_ID = re.compile(rb"\x67boot_id(?:([\x00-\x17])|\x18(.)|\x19(..)|\x1a(....))", re.DOTALL)

# Of elements; all others are integers
_TYPES: dict[str, type] = {"data": bytes, "text": str, "samples": cbor2.CBORTag}
_RANGES = {
    **dict.fromkeys(("t_us", "t0_us", "t1_us", "t2_us"), range(MAX_DEVICE_US)),
    **dict.fromkeys(("stream", "n0", "flags"), range(MAX_N0)),
    **{"boot_id": range(2**32), "period_ns": range(1, 2**32)},
}
_INT64 = range(-(2**63), 2**63)  # of all other integers
# By type of a frame: the types of its elements, and the index and range of the integers.
_ELEMENTS = {
    kind: (
        [_TYPES.get(name, int) for name in wire.names(kind)],
        [(k, _RANGES.get(name, _INT64)) for k, name in enumerate(wire.names(kind), start=1) if name not in _TYPES],
    )
    for kind in wire.LAYOUT
}


_HostTime = Annotated[int, msgspec.Meta(gt=-LATEST_NS, lt=LATEST_NS)]
_DeviceTime = Annotated[int, msgspec.Meta(ge=0, lt=MAX_DEVICE_US)]


class _SyncLine(msgspec.Struct, gc=False):
    t0_ns: _HostTime
    t1_us: _DeviceTime
    t2_us: _DeviceTime
    t3_ns: _HostTime


_read_exchange = msgspec.json.Decoder(_SyncLine).decode


def parse_exchange(data: bytes) -> tuple[int, ...] | None:
    """Parse a ``/sync`` message: times of host write, device receive, device send and host arrival.

    None if the request was not answered or the message is invalid.
    """
    try:
        return msgspec.structs.astuple(_read_exchange(data))
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return None


def is_echo(frame: list[Any]) -> bool:
    """Return whether a frame has a type that only a host sends (SPEC §6)."""
    return bool(frame[0] == wire.SYNC_REQUEST or 48 <= frame[0] < 64)


def conforms(frame: list[Any]) -> bool:
    """Return whether a frame of a known type has the elements that the specification demands, within bounds.

    Frames of other types conform. A box with a newer minor version may append elements.
    """
    kind = frame[0]
    if kind not in wire.LAYOUT:
        return True
    types, ranges = _ELEMENTS[kind]
    if len(frame) <= wire.needed(kind) or list(map(type, frame[1 : len(types) + 1])) != types[: len(frame) - 1]:
        return False
    is_samples = kind != wire.DATA or (frame[6].tag == TAG_INT32 and type(frame[6].value) is bytes)
    return is_samples and all(frame[k] in allowed for k, allowed in ranges if k < len(frame))


def fields_of(kind: int, payload: bytes) -> dict[str, Any] | None:
    """Return the elements of a frame by name; None if it is not of this kind, or violates the specification."""
    frame = decode(payload)
    return None if frame is None or frame[0] != kind else named_elements(frame)


def named_elements(frame: list[Any]) -> dict[str, Any] | None:
    """Return the elements of a frame by name; None if its type is not known, or it violates the specification."""
    if frame[0] not in wire.LAYOUT or not conforms(frame):
        return None
    return dict(zip(wire.names(frame[0]), frame[1:], strict=False))


def boot_id(frame: list[Any]) -> int:
    """Return the boot id that a heartbeat or the first page of an ident states; NONE for other frames."""
    if frame[0] == wire.HEARTBEAT:
        return int(frame[2])
    match = _BOOT_ID.search(frame[5]) if frame[0] == wire.IDENT and frame[3] == 0 else None
    return NONE if match is None else int.from_bytes(match[1] or match[2] or match[3] or match[4])


class Pages:
    """Joins the pages of one document at a time, within the size limits of the specification.

    Page 0 begins a document. A page that is not the next one of it discards it.
    """

    def __init__(self) -> None:
        self._key: tuple[int, int] | None = None  # req_id and number of pages of the document being joined
        self._parts: list[bytes] = []

    def push(self, req_id: int, page: int, pages: int, data: bytes) -> bytes | None:
        """Return the document if this page completes it, else None."""
        if not 0 <= page < pages <= PAGES_MAX or len(data) > PAGE_BYTES:
            return None
        if page == 0:
            self._key, self._parts = (req_id, pages), []
        if self._key != (req_id, pages) or page != len(self._parts):
            self._key = None
            return None
        self._parts.append(data)
        if len(self._parts) < pages:
            return None
        self._key = None
        return b"".join(self._parts)


NONE = -1  # of a frame without this element
_OF_ALL = ["message", "seq", "type", "boot_id"]
_OF_DATA = ["t_us", "stream", "n0", "period_ns", "flags", "samples_bytes"]
_OF_ACCOUNT = ["lost", "n", "run"]
FRAME = np.dtype([*((name, np.int64) for name in (*_OF_ALL, *_OF_DATA, *_OF_ACCOUNT)), ("gap", np.bool_)])

_BEGIN = [("begin", "u1"), ("type", "u1"), ("m_seq", "u1"), ("seq", ">u4"), ("stream", "u1")]
_TIMES = [("m_n0", "u1"), ("n0", ">u8"), ("m_t0", "u1"), ("t_us", ">u8"), ("m_p", "u1"), ("period_ns", ">u4")]
_DATA = np.dtype([*_BEGIN, *_TIMES, ("tag", "3u1"), ("size", "u1")])
_DATA_TAG = np.array([0xD8, 0x4E, 0x58], np.uint8)
_SYNC = np.dtype([("begin", "4u1"), ("seq", ">u4")])
_SYNC_BEGIN = np.array([0x85, 0x18, wire.SYNC_REPLY, 0x1A], np.uint8)
_SYNC_BYTES = (27, 28, 29, 31)  # by the width of the request's number
_UINT32, _UINT64 = 0x1A, 0x1B  # CBOR: an unsigned integer of this many bits follows


@dataclass(frozen=True, eq=False)
class Frames:
    """The frames (f,) in a batch of messages, which may follow frames of earlier ones.

    Messages that are not frames are left out.

    ``table`` (f,) of FRAME; ``message`` is an index in the batch. ``lost``, ``n``, ``run`` and ``gap`` are for
    ``streams`` to fill in. ``contents``: the samples of each data frame, and the elements of each other frame that was
    decoded singly. The type of a frame that violates the specification is NONE; ``malformed`` counts these and the
    messages that are not frames.
    """

    table: NDArray[Any] = field(default_factory=lambda: np.empty(0, FRAME))
    contents: list[Any] = field(default_factory=list)
    malformed: int = 0

    def followed_by(self, later: Frames) -> Frames:
        """Return these frames, then all of ``later``."""
        return Frames(np.concatenate([self.table, later.table]), self.contents + later.contents, later.malformed)


def frames_of(messages: Messages) -> Frames:
    """Return the frames among the messages of a box."""
    rows = messages.rows(lambda topic: topic.startswith("/box/") and topic != "/box/console")
    begin, end = messages.begin[rows], messages.end[rows]
    table = np.full(len(rows), NONE, FRAME)
    table["message"] = rows
    usual = _usual_data(messages, begin, end, table) | _usual_syncs(messages, begin, end, table)
    first = begin + _DATA.itemsize
    places = zip(first.tolist(), (first + table["samples_bytes"]).tolist(), strict=True)
    contents: list[Any] = [messages.data[a:b] for a, b in places]
    is_frame = np.ones(len(rows), bool)
    for k in np.flatnonzero(~usual).tolist():
        frame = decode(messages.payload(int(rows[k])))
        if frame is None or is_echo(frame):
            is_frame[k] = False
            continue
        contents[k], table["seq"][k] = frame, frame[1]
        if not conforms(frame):
            continue
        table["type"][k], table["boot_id"][k] = frame[0], boot_id(frame)
        if frame[0] == wire.DATA:
            data = data_of(frame)
            contents[k] = data.samples
            table[_OF_DATA][k] = data.t0_us, data.stream, data.n0, data.period_ns, data.flags, len(data.samples)
    malformed = int(np.count_nonzero(table["type"] == NONE))
    return Frames(table[is_frame], [contents[k] for k in np.flatnonzero(is_frame).tolist()], malformed)


def _usual_data(messages: Messages, begin: Ints, end: Ints, table: NDArray[Any]) -> NDArray[np.bool_]:
    """Enter the data frames of the usual layout in the table; return which messages they are."""
    head, size = heads(messages.data, begin, _DATA), end - begin
    usual = (head["begin"] == 0x88) & (head["type"] == wire.DATA) & (head["m_seq"] == _UINT32)
    usual &= (head["m_n0"] == _UINT64) & (head["m_t0"] == _UINT64) & (head["m_p"] == _UINT32)
    usual &= np.all(head["tag"] == _DATA_TAG, axis=1) & (size <= MAX_PAYLOAD)
    usual &= (size > _DATA.itemsize) & (head["size"] == size - _DATA.itemsize - 1)
    usual &= (head["stream"] < 24) & (head["period_ns"] > 0) & (head["t_us"] < MAX_DEVICE_US) & (head["n0"] < MAX_N0)
    flags = np.frombuffer(messages.data, np.uint8)[np.maximum(end - 1, 0)]
    usual &= flags < 24
    for name in ("seq", "type", "t_us", "stream", "n0", "period_ns"):
        table[name][usual] = head[name][usual]
    table["flags"][usual], table["samples_bytes"][usual] = flags[usual], head["size"][usual]
    return np.asarray(usual)


def _usual_syncs(messages: Messages, begin: Ints, end: Ints, table: NDArray[Any]) -> NDArray[np.bool_]:
    """Enter the sync replies of the usual layout in the table; return which messages they are.

    Their times are those of the exchange on ``/sync``.
    """
    head = heads(messages.data, begin, _SYNC)
    usual = np.all(head["begin"] == _SYNC_BEGIN, axis=1) & np.isin(end - begin, _SYNC_BYTES)
    table["seq"][usual], table["type"][usual] = head["seq"][usual], wire.SYNC_REPLY
    return np.asarray(usual)


# -------------------------------------------------------------------------------------- the box's description of itself

PROTOCOL_MAJOR = 1
MAX_STREAMS = 16
MAX_THERMOMETERS = 64
MAX_MDEGC = 200_000
MAX_CHANNELS = 62  # SPEC §1: a payload of 250 bytes holds no more int32 values
MAX_COEFFICIENTS = 16
MAX_EXPONENT = 300
_MAX_DEPTH = 16
_SHOWN = 60  # characters of untrusted text quoted in our messages
_REFERENCES = (25, 28, 29, 256)  # tags that let a short document expand to an endless one

# A stream with one of these names would share its topic with the frames of that kind.
RESERVED_NAMES = frozenset({"event", "heartbeat", "ident", "temperature", "sync", "reply", "other", "console"})


EMULATED_UID = "e6614103e7452b2f"  # SPEC §5: of the emulated chip, which runs the firmware of a real box
RATIO_STEP = 2.0**-20  # scale of a channel divided by another: ±8 in 24 bits


@dataclass(frozen=True)
class Channel:
    """A channel of a stream: volts (or the given ``unit``) = counts · scale.

    ``poly``: value in ``calibrated_unit`` = Σ poly[k] · (counts · scale)^k; empty without a calibration. ``over``:
    index of the box channel by which this one is divided (``samples.with_ratios``). In that case ``scale`` is
    ``RATIO_STEP`` and ``per_count`` is the ratio of one count to one count. ``calibrated_degc``: temperature of the box
    during calibration, NaN if it was not noted. ``fault``: why the box's description of the channel cannot be used; if
    set, the scale is NaN and the other fields are empty.
    """

    name: str
    unit: str
    scale: float
    calibrated_unit: str = ""
    poly: tuple[float, ...] = ()
    over: int | None = None
    per_count: float = 1.0
    fault: str = ""
    calibrated_degc: float = math.nan

    @property
    def length_unit(self) -> units.Scale | None:
        """The unit of length given by the calibration; None if the channel is unusable or does not measure length."""
        return None if self.fault or not self.poly else units.length(self.calibrated_unit)


_Unsigned31 = Annotated[int, msgspec.Meta(ge=0, lt=2**31)]
_Unsigned32 = Annotated[int, msgspec.Meta(ge=0, lt=2**32)]
_Unsigned40 = Annotated[int, msgspec.Meta(ge=0, lt=2**40)]
_Name = Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]{0,31}\Z")]


class Stream(msgspec.Struct, frozen=True):
    """A stream of samples, on the topic ``/box/<name>``.

    The signal precedes a sample's timestamp by ``group_delay_ns``.

    ``period_ns`` and ``group_delay_ns`` apply to ``osr``. Below ``shortest_period_ns`` the box would lose samples (0:
    not stated).
    """

    id: _Unsigned31
    name: _Name
    period_ns: _Unsigned32
    osr: _Unsigned32
    group_delay_ns: _Unsigned40
    channels: tuple[Channel, ...]
    shortest_period_ns: _Unsigned32 = 0


@dataclass(frozen=True)
class Ident:
    """A box.

    ``document`` is its complete description in JSON-compatible form; ``faults`` lists problems for the operator.
    """

    firmware: str
    boot_id: int
    streams: Mapping[int, Stream]
    faults: tuple[str, ...]
    thermometers: tuple[str, ...]  # their names
    document: Mapping[str, Any] = field(repr=False)

    @property
    def simulated(self) -> bool:
        """Whether the box is a simulated one."""
        return self.document.get("board") == "vm" or self.document.get("uid") == EMULATED_UID


_Streams = Annotated[list[dict[str, Any]], msgspec.Meta(min_length=1, max_length=MAX_STREAMS)]
_Channels = Annotated[list[Any], msgspec.Meta(min_length=1, max_length=MAX_CHANNELS)]


class _Calibration(msgspec.Struct):
    unit: str = ""
    poly: Annotated[list[Any], msgspec.Meta(max_length=MAX_COEFFICIENTS)] = []
    temperature_mdegc: Any = None


class _ChannelEntry(msgspec.Struct):
    name: str
    scale: Any
    unit: str = ""
    calibration: _Calibration | None = None


class _Wrong(ValueError):
    """A part of the document is unusable; the text names its key."""


def decode_ident(data: bytes) -> Ident:
    """Decode the ident document sent by a box. Raises ProtocolError as ``parse_ident`` does."""
    try:
        document = load_document(data)
    except cbor2.CBORError as exc:
        raise ProtocolError(
            "old-firmware", reason=f"sends a description of itself that cannot be decoded ({exc})"
        ) from exc
    return parse_ident(document)


def load_document(data: bytes) -> Any:
    """Load a CBOR document from the box. References are rejected, as this protocol does not use them.

    Raises cbor2.CBORError.
    """
    references = dict.fromkeys(_REFERENCES, _refuse)
    return cbor2.loads(data, max_depth=_MAX_DEPTH, allow_indefinite=False, semantic_decoders=references)


def parse_ident(document: object) -> Ident:
    """Parse an ident document decoded from CBOR or JSON; unknown keys and newer minor versions are accepted.

    The document is checked in its JSON form, so the recorder and every reader of the session's metadata get the same
    result.

    Raises ProtocolError if the major version differs, or if samples could not be distinguished: without a boot id, or
    if a stream lacks an id, name, times or channels.
    """
    try:
        table = _plain(document)
        if not isinstance(table, dict):
            raise _Wrong("it is not a map")
        _check_protocol(table.get("protocol"))
        boot_id: int = _converted(table.get("boot_id"), _Unsigned32, "boot_id")
        streams = [_stream(entry) for entry in _converted(table.get("streams"), _Streams, "streams")]
        if len({s.id for s in streams}) < len(streams) or len({s.name for s in streams}) < len(streams):
            raise _Wrong("two streams have the same id or name")
    except _Wrong as exc:
        raise ProtocolError("old-firmware", reason=f"sends a wrong description of itself: {exc}") from exc
    firmware = table.get("firmware")
    faults = [f"channel {_shown(c.name)} of stream {s.name}: {c.fault}" for s in streams for c in s.channels if c.fault]
    if "last_error" in table:
        faults.insert(0, f"the box's firmware stopped with an error earlier: {_last_line(table['last_error'])}")
    if "fault" in table:
        faults.insert(0, f"the box says {_shown(table['fault'])}")
    if not isinstance(firmware, str):
        faults.append("the box does not say its firmware's version")
    return Ident(
        firmware=firmware if isinstance(firmware, str) else "",
        boot_id=boot_id,
        streams={stream.id: stream for stream in streams},
        faults=tuple(faults),
        thermometers=_thermometers(table.get("thermometers")),
        document=table,
    )


def find_channels(ident: Ident, *names: str) -> tuple[Stream, tuple[int, ...]] | None:
    """Return the stream that has channels of these names, and their indices; None if no single stream has them all."""
    for stream in ident.streams.values():
        available = [channel.name for channel in stream.channels]
        if set(names) <= set(available):
            return stream, tuple(map(available.index, names))
    return None


def decimal(value: object, key: str) -> float:
    """Return the float nearest to ``[mantissa, exponent]``, mantissa · 10^exponent, such as a scale.

    10^−n has no exact binary form, so the product of two rounded numbers could be off by one ulp. Parsing the decimal
    number in one step rounds once and correctly. Raises ValueError naming ``key`` if it is not such a pair.
    """
    if not isinstance(value, list) or len(value) != 2 or any(type(item) is not int for item in value):
        raise _Wrong(f"{key} must be [mantissa, exponent]")
    mantissa, exponent = value
    if abs(mantissa) >= 2**64 or abs(exponent) > MAX_EXPONENT or math.isinf(number := float(f"{mantissa}e{exponent}")):
        raise _Wrong(f"{key} is out of range")
    return number


def _converted(value: object, kind: Any, key: str) -> Any:
    """Return a checked entry of the document. Raises _Wrong that names the key."""
    try:
        return msgspec.convert(value, kind)
    except msgspec.ValidationError as exc:
        reason, _, place = str(exc).partition(" - at `$")
        raise _Wrong(f"{key}{place.rstrip('`')}: {reason}") from exc


def _check_protocol(version: object) -> None:
    if not isinstance(version, list) or len(version) < 2 or not all(type(v) is int for v in version):
        raise _Wrong("it does not report its protocol version")
    if version[0] != PROTOCOL_MAJOR:
        side = "truearm" if version[0] > PROTOCOL_MAJOR else "the box's firmware with truearm box flash"
        spoken = ".".join(_shown(v) for v in version[:2])
        raise ProtocolError(f"the box speaks protocol {spoken}, this truearm {PROTOCOL_MAJOR}.x; update {side}")


def _thermometers(entries: object) -> tuple[str, ...]:
    """Return the names of the thermometers by number; an invalid name becomes "". A box before 1.3 has none."""
    listed = entries[:MAX_THERMOMETERS] if isinstance(entries, list) else []
    names = [entry.get("name") if isinstance(entry, dict) else None for entry in listed]
    return tuple(name if isinstance(name, str) else "" for name in names)


def _stream(entry: dict[str, Any]) -> Stream:
    listed = _converted(entry.get("channels"), _Channels, "channels")
    stream: Stream = _converted({**entry, "channels": ()}, Stream, "stream")
    if stream.name in RESERVED_NAMES:
        raise _Wrong(f"a stream is named {_shown(stream.name)}, which cannot be a topic")
    channels = [_channel(channel) for channel in listed]
    divided = (_divided(channel, described, channels) for channel, described in zip(channels, listed, strict=True))
    return msgspec.structs.replace(stream, channels=tuple(divided))


def _channel(entry: object) -> Channel:
    try:
        parsed = _converted(entry, _ChannelEntry, "")
        calibration = parsed.calibration or _Calibration()
        noted = calibration.temperature_mdegc
        return Channel(
            name=parsed.name,
            unit=parsed.unit,
            scale=decimal(parsed.scale, "scale"),
            calibrated_unit=calibration.unit,
            poly=tuple(decimal(coefficient, f"poly[{k}]") for k, coefficient in enumerate(calibration.poly)),
            calibrated_degc=MDEGC.to_si(noted) if type(noted) is int and abs(noted) <= MAX_MDEGC else math.nan,
        )
    except _Wrong as exc:
        name = entry.get("name") if isinstance(entry, dict) else None
        return Channel(name if isinstance(name, str) else "", "", math.nan, fault=str(exc))


def _divided(channel: Channel, entry: object, channels: list[Channel]) -> Channel:
    """Return the channel as a ratio if the box specifies that it is divided by another channel of its stream."""
    over = entry.get("over") if isinstance(entry, dict) and not channel.fault else None
    if over is None:
        return channel
    index = next((k for k, divisor in enumerate(channels) if divisor.name == over and divisor is not channel), None)
    if index is None or channels[index].fault or not channels[index].scale:
        return replace(
            channel,
            scale=math.nan,
            poly=(),
            fault=f"over is {_shown(over)}, which names no other channel that can be used",
        )
    return replace(channel, unit="V/V", scale=RATIO_STEP, over=index, per_count=channel.scale / channels[index].scale)


def _last_line(text: object) -> str:
    """Return the last line of a traceback: the exception and its text."""
    lines = text.strip().splitlines() if isinstance(text, str) else []
    return _shown(lines[-1] if lines else text)


def _shown(value: object) -> str:
    return repr(_plain(value))[:_SHOWN]


def _plain(value: Any) -> Any:
    """Return ``value`` in JSON-compatible form.

    A value of a type outside this protocol is replaced by the type's name.
    """
    if value is None or isinstance(value, str | bool) or (isinstance(value, int) and value.bit_length() <= 64):
        return value
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, Mapping):
        return {key if isinstance(key, str) else str(_plain(key)): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return str(value) if isinstance(value, float) else f"<{type(value).__name__}>"


def _refuse(_: object) -> NoReturn:
    raise ValueError("references are not supported")


def recorded_ident(session: Session) -> Ident | None:
    """Return the box's description in the session's metadata; None if there is none.

    Raises SessionError if it is not valid.
    """
    text = session.metadata.get("box", {}).get("ident")
    try:
        return None if text is None else parse_ident(json.loads(text))
    except (ValueError, RecursionError, ProtocolError) as exc:
        raise SessionError(
            f"the box's ident in the session's metadata cannot be used: {exc}; copy the session again"
        ) from exc
