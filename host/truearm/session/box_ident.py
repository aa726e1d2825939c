"""What a box says of itself (protocol/SPEC.md §5): its streams, their channels, scales and calibrations.

One parser for the recorder and for everything that reads a session. What cannot be read of a single channel is a
``fault`` of that channel, not an error: its counts are still worth recording, and the other channels are whole.

A scale or coefficient travels as ``[mantissa, exponent]`` and stands for mantissa · 10^exponent. 10^exponent has no
exact binary form for negative exponents, so the product of two rounded numbers could be an ulp off; reading the decimal
number as a whole rounds once and correctly.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NoReturn

import cbor2

from truearm import units
from truearm.errors import ProtocolError, SessionError
from truearm.units import MDEGC

PROTOCOL_MAJOR = 1
MAX_STREAMS = 16
MAX_THERMOMETERS = 64
MAX_MDEGC = 200_000
MAX_CHANNELS = 62  # SPEC §1: a payload of 250 bytes holds no more int32
MAX_COEFFICIENTS = 16
MAX_EXPONENT = 300
_MAX_DEPTH = 16
_SHOWN = 60  # characters of a stranger's text in ours
_REFERENCES = (25, 28, 29, 256)  # tags by which a short document would stand for an endless one

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,31}")
# A stream of such a name would share its topic with the frames of that kind.
RESERVED_NAMES = frozenset({"event", "heartbeat", "ident", "temperature", "sync", "reply", "other", "console"})


RATIO_STEP = 2.0**-20  # of a channel that is divided by another: ±8 in 24 bits


@dataclass(frozen=True)
class Channel:
    """A channel of a stream: volts (or whatever ``unit`` says) = counts · scale.

    ``poly``: value in ``calibrated_unit`` = Σ poly[k] · (counts · scale)^k; empty without a calibration. ``over``: the channel that
    this one is divided by, as the box's channel of that index (``samples.with_ratios``); then ``scale`` is ``RATIO_STEP``, and
    ``per_count`` what a count over a count is, a ratio. ``calibrated_degc``: the box's temperature while it was calibrated, NaN if nobody noted it. With a ``fault`` the box's description cannot be used (the text says why), the scale is NaN and the rest empty.
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
        """The unit of length that the calibration gives; None for a channel that cannot be used or shows no length."""
        return None if self.fault or not self.poly else units.length(self.calibrated_unit)


@dataclass(frozen=True)
class Stream:
    """A stream of samples; its topic is ``/box/<name>``, the signal lies ``group_delay_ns`` before a sample's stamp.

    ``period_ns`` and ``group_delay_ns`` belong to ``osr``.
    """

    id: int
    name: str
    period_ns: int
    osr: int
    group_delay_ns: int
    channels: tuple[Channel, ...]


@dataclass(frozen=True)
class Ident:
    """A box. ``document`` is the whole of what it said, fit for JSON; ``faults`` what the operator should know of it."""

    firmware: str
    boot_id: int
    streams: Mapping[int, Stream]
    faults: tuple[str, ...]
    thermometers: tuple[str, ...]  # their names
    document: Mapping[str, Any] = field(repr=False)


class _Wrong(ValueError):
    """A part of the document that cannot be used; the text names its key."""


def decode_ident(data: bytes) -> Ident:
    """The ident document as a box sends it. Raises ProtocolError as ``parse_ident`` does."""
    try:
        document = load_document(data)
    except cbor2.CBORError as exc:
        raise ProtocolError(f"the box's description of itself cannot be decoded ({exc}); update its firmware") from exc
    return parse_ident(document)


def load_document(data: bytes) -> Any:
    """A document of the box, without references, which are not on this wire. Raises cbor2.CBORError."""
    references = dict.fromkeys(_REFERENCES, _refuse)
    return cbor2.loads(data, max_depth=_MAX_DEPTH, allow_indefinite=False, semantic_decoders=references)


def parse_ident(document: object) -> Ident:
    """An ident document, decoded from CBOR or JSON; unknown keys and a newer minor version are accepted.

    It is judged as JSON holds it, so the recorder and every reader of the session's metadata find the same in it.

    Raises ProtocolError for another major version, and where samples could not even be told apart: without a boot id,
    or with streams that have no id, name, times or channels.
    """
    try:
        return _ident(_plain(_typed(document, dict, "document")))
    except _Wrong as exc:
        raise ProtocolError(f"the box's description of itself: {exc}; update its firmware") from exc


def parse_ident_json(text: str) -> Ident:
    """The ident document as a session's metadata hold it. Raises SessionError where it is none."""
    try:
        return parse_ident(json.loads(text))
    except (ValueError, RecursionError) as exc:
        raise SessionError("the box's ident in the session's metadata is no JSON") from exc
    except ProtocolError as exc:
        raise SessionError(f"the box's ident in the session's metadata cannot be used: {exc}") from exc


def find_channel(ident: Ident, name: str) -> tuple[Stream, int] | None:
    """The stream that has a channel of this name, and the channel's index; None where there is none."""
    for stream in ident.streams.values():
        for index, channel in enumerate(stream.channels):
            if channel.name == name:
                return stream, index
    return None


def decimal(value: object, key: str) -> float:
    """The float nearest to ``[mantissa, exponent]``. Raises ValueError, which names ``key``, where it is no such pair."""
    pair = _typed(value, list, key)
    if len(pair) != 2 or any(type(part) is not int for part in pair):
        raise _Wrong(f"{key} must be [mantissa, exponent]")
    mantissa, exponent = pair
    if abs(mantissa) >= 2**64 or abs(exponent) > MAX_EXPONENT or math.isinf(number := float(f"{mantissa}e{exponent}")):
        raise _Wrong(f"{key} is out of range")
    return number


def _ident(table: dict[Any, Any]) -> Ident:
    _check_protocol(table.get("protocol"))
    boot_id = _unsigned(table.get("boot_id"), "boot_id", 2**32)
    streams = _streams(_typed(table.get("streams"), list, "streams"))
    firmware = table.get("firmware")
    faults = [f"channel {_shown(c.name)} of stream {s.name}: {c.fault}" for s in streams for c in s.channels if c.fault]
    if "last_error" in table:
        faults.insert(0, f"its firmware once ended by an error: {_last_line(table['last_error'])}")
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


def _check_protocol(version: object) -> None:
    if not isinstance(version, list) or len(version) < 2 or not all(type(v) is int for v in version):
        raise _Wrong("it does not say which protocol it speaks")
    if version[0] != PROTOCOL_MAJOR:
        side = "truearm" if version[0] > PROTOCOL_MAJOR else "the box's firmware"
        spoken = ".".join(_shown(v) for v in version[:2])
        raise ProtocolError(f"the box speaks protocol {spoken}, this truearm {PROTOCOL_MAJOR}.x; update {side}")


def _thermometers(entries: object) -> tuple[str, ...]:
    """Names by number; one that is no name is "". A box of before 1.3 has none."""
    found = entries[:MAX_THERMOMETERS] if isinstance(entries, list) else []
    names = [entry.get("name") if isinstance(entry, dict) else None for entry in found]
    return tuple(name if isinstance(name, str) else "" for name in names)


def _streams(entries: list[Any]) -> list[Stream]:
    if not 1 <= len(entries) <= MAX_STREAMS:
        raise _Wrong(f"{len(entries)} streams; 1 to {MAX_STREAMS} are possible")
    streams = [_stream(_typed(entry, dict, "a stream")) for entry in entries]
    if len({s.id for s in streams}) < len(streams) or len({s.name for s in streams}) < len(streams):
        raise _Wrong("two streams share an id or a name")
    return streams


def _stream(entry: dict[str, Any]) -> Stream:
    name = _typed(entry.get("name"), str, "a stream's name")
    if not _NAME.fullmatch(name) or name in RESERVED_NAMES:
        raise _Wrong(f"a stream is named {_shown(name)}, which cannot be a topic")
    channels = _typed(entry.get("channels"), list, "channels")
    if not 1 <= len(channels) <= MAX_CHANNELS:
        raise _Wrong(f"stream {name} has {len(channels)} channels, 1 to {MAX_CHANNELS} are possible")
    found = [_channel(channel) for channel in channels]
    return Stream(
        id=_unsigned(entry.get("id"), "id", 2**31),
        name=name,
        period_ns=_unsigned(entry.get("period_ns"), "period_ns", 2**32),
        osr=_unsigned(entry.get("osr"), "osr", 2**32),
        group_delay_ns=_unsigned(entry.get("group_delay_ns"), "group_delay_ns", 2**40),
        channels=tuple(_divided(channel, entry, found) for channel, entry in zip(found, channels, strict=True)),
    )


def _channel(entry: object) -> Channel:
    try:
        return _whole_channel(_typed(entry, dict, "its description"))
    except _Wrong as exc:
        name = entry.get("name") if isinstance(entry, dict) else None
        return Channel(name if isinstance(name, str) else "", "", math.nan, fault=str(exc))


def _divided(channel: Channel, entry: object, channels: list[Channel]) -> Channel:
    """The channel as a ratio, if the box says that it is to be divided by another of its stream."""
    over = entry.get("over") if isinstance(entry, dict) and not channel.fault else None
    if over is None:
        return channel
    index = next((k for k, other in enumerate(channels) if other.name == over and other is not channel), None)
    if index is None or channels[index].fault or not channels[index].scale:
        return replace(
            channel,
            scale=math.nan,
            poly=(),
            fault=f"over is {_shown(over)}, which names no other channel that can be used",
        )
    return replace(channel, unit="V/V", scale=RATIO_STEP, over=index, per_count=channel.scale / channels[index].scale)


def _whole_channel(entry: dict[str, Any]) -> Channel:
    calibration = _typed(entry.get("calibration") or {}, dict, "calibration")
    poly = _typed(calibration.get("poly", []), list, "poly")
    noted = calibration.get("temperature_mdegc")
    if len(poly) > MAX_COEFFICIENTS:
        raise _Wrong(f"its calibration has {len(poly)} coefficients, {MAX_COEFFICIENTS} are possible")
    return Channel(
        name=_typed(entry.get("name"), str, "name"),
        unit=_typed(entry.get("unit", ""), str, "unit"),
        scale=decimal(entry.get("scale"), "scale"),
        calibrated_unit=_typed(calibration.get("unit", ""), str, "the calibration's unit"),
        poly=tuple(decimal(coefficient, f"poly[{k}]") for k, coefficient in enumerate(poly)),
        calibrated_degc=MDEGC.to_si(noted) if type(noted) is int and abs(noted) <= MAX_MDEGC else math.nan,
    )


_KINDS: dict[type, str] = {dict: "map", list: "list", str: "text"}


def _typed(value: object, kind: type, key: str) -> Any:
    if not isinstance(value, kind):
        raise _Wrong(f"{key} is missing or no {_KINDS[kind]}")
    return value


def _unsigned(value: object, key: str, limit: int) -> int:
    if type(value) is not int or not 0 <= value < limit:
        raise _Wrong(f"{key} is missing or no unsigned integer below {limit}")
    return value


def _last_line(text: object) -> str:
    """What a traceback ends with: the exception and its text."""
    lines = text.strip().splitlines() if isinstance(text, str) else []
    return _shown(lines[-1] if lines else text)


def _shown(value: object) -> str:
    return repr(_plain(value))[:_SHOWN]


def _plain(value: Any) -> Any:
    """``value`` as JSON can hold it; what no document of this protocol holds is named by its kind."""
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
    raise ValueError("references are not on this wire")
