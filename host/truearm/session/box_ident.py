"""Parse a box's description of itself (protocol/SPEC.md §5): streams, channels, scales and calibrations.

The recorder and every reader of a session use this one parser. If a single channel cannot be read, that channel gets a
``fault`` instead of an error: its counts are still worth recording, and the other channels are intact.

A scale or coefficient is transmitted as ``[mantissa, exponent]`` and means mantissa · 10^exponent. For negative
exponents, 10^exponent has no exact binary form, so the product of two rounded numbers could be off by one ulp. Parsing
the decimal number in one step rounds once and correctly.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import cbor2
import msgspec

from truearm import units
from truearm.errors import ProtocolError, SessionError
from truearm.units import MDEGC

if TYPE_CHECKING:
    from truearm.session.session_file import Session

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
    """A stream of samples, on the topic ``/box/<name>``. The signal precedes a sample's timestamp by
    ``group_delay_ns``.

    ``period_ns`` and ``group_delay_ns`` apply to ``osr``. Below ``shortest_period_ns`` the box would lose samples (0: not stated).
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
    """A box. ``document`` is its complete description in JSON-compatible form; ``faults`` lists problems for the
    operator.
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
    """Return the float nearest to ``[mantissa, exponent]``. Raises ValueError naming ``key`` if it is not such a pair."""
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
    """Return ``value`` in JSON-compatible form; a value of a type outside this protocol is replaced by the type's name."""
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
    """Return the box's description in the session's metadata; None if there is none. Raises SessionError if it is not valid."""
    text = session.metadata.get("box", {}).get("ident")
    try:
        return None if text is None else parse_ident(json.loads(text))
    except (ValueError, RecursionError, ProtocolError) as exc:
        raise SessionError(
            f"the box's ident in the session's metadata cannot be used: {exc}; copy the session again"
        ) from exc
