"""What a box says of itself (protocol/SPEC.md §5): its streams, their channels, scales and calibrations.

A scale or coefficient travels as ``[mantissa, exponent]`` and stands for mantissa · 10^exponent. 10^exponent has no
exact binary form for negative exponents, so the product of two rounded numbers could be an ulp off; reading the decimal
number as a whole rounds once and correctly.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from truearm.errors import SessionError

MAX_CHANNELS = 62  # SPEC §1: a payload of 250 bytes holds no more int32
MAX_COEFFICIENTS = 16
MAX_EXPONENT = 300


@dataclass(frozen=True)
class Channel:
    """A channel of a stream: volts (or whatever ``unit`` says) = counts · scale.

    ``poly``: value in ``calibrated_unit`` = Σ poly[k] · (counts · scale)^k; empty without a calibration.
    """

    name: str
    unit: str
    scale: float
    calibrated_unit: str = ""
    poly: tuple[float, ...] = ()


@dataclass(frozen=True)
class Stream:
    """A stream of samples; the signal lies ``group_delay_ns`` before the stamp of its sample."""

    id: int
    name: str
    period_ns: int
    group_delay_ns: int
    channels: tuple[Channel, ...]


@dataclass(frozen=True)
class Ident:
    """The ident document of a box."""

    firmware: str
    boot_id: int
    streams: Mapping[int, Stream]


def parse_ident(document: object) -> Ident:
    """An ident document, decoded from CBOR or JSON. Raises SessionError that names the key that is wrong."""
    table = _typed(document, dict, "document")
    streams = [_stream(_typed(entry, dict, "streams")) for entry in _typed(table.get("streams"), list, "streams")]
    return Ident(
        firmware=_typed(table.get("firmware", ""), str, "firmware"),
        boot_id=_unsigned(table.get("boot_id"), "boot_id", 2**32),
        streams={stream.id: stream for stream in streams},
    )


def parse_ident_json(text: str) -> Ident:
    """The ident document as a session's metadata hold it. Raises SessionError where it is none."""
    try:
        return parse_ident(json.loads(text))
    except (ValueError, RecursionError) as exc:
        raise SessionError("the box's ident in the session's metadata is no JSON") from exc


def find_channel(ident: Ident, name: str) -> tuple[Stream, int] | None:
    """The stream that has a channel of this name, and the channel's index; None where there is none."""
    for stream in ident.streams.values():
        for index, channel in enumerate(stream.channels):
            if channel.name == name:
                return stream, index
    return None


def decimal(value: object, key: str) -> float:
    """The float nearest to ``[mantissa, exponent]``. Raises SessionError where it is no such pair."""
    pair = _typed(value, list, key)
    if len(pair) != 2 or any(type(part) is not int for part in pair):
        raise SessionError(f"the box's ident: {key} must be [mantissa, exponent]")
    mantissa, exponent = pair
    if abs(mantissa) >= 2**64 or abs(exponent) > MAX_EXPONENT:
        raise SessionError(f"the box's ident: {key} is out of range")
    return float(f"{mantissa}e{exponent}")


def _stream(entry: dict[str, Any]) -> Stream:
    channels = _typed(entry.get("channels"), list, "channels")
    if not 1 <= len(channels) <= MAX_CHANNELS:
        raise SessionError(f"the box's ident: a stream has {len(channels)} channels, 1 to {MAX_CHANNELS} are possible")
    return Stream(
        id=_unsigned(entry.get("id"), "id", 2**31),
        name=_typed(entry.get("name"), str, "name"),
        period_ns=_unsigned(entry.get("period_ns"), "period_ns", 2**32),
        group_delay_ns=_unsigned(entry.get("group_delay_ns", 0), "group_delay_ns", 2**40),
        channels=tuple(_channel(_typed(channel, dict, "channels")) for channel in channels),
    )


def _channel(entry: dict[str, Any]) -> Channel:
    calibration = _typed(entry.get("calibration") or {}, dict, "calibration")
    poly = _typed(calibration.get("poly", []), list, "poly")
    if len(poly) > MAX_COEFFICIENTS:
        raise SessionError(
            f"the box's ident: a calibration of {len(poly)} coefficients; {MAX_COEFFICIENTS} are allowed"
        )
    return Channel(
        name=_typed(entry.get("name"), str, "name"),
        unit=_typed(entry.get("unit", ""), str, "unit"),
        scale=decimal(entry.get("scale"), "scale"),
        calibrated_unit=_typed(calibration.get("unit", ""), str, "unit"),
        poly=tuple(decimal(coefficient, "poly") for coefficient in poly),
    )


def _typed(value: object, kind: type, key: str) -> Any:
    if not isinstance(value, kind):
        raise SessionError(f"the box's ident: {key} is missing or no {kind.__name__}")
    return value


def _unsigned(value: object, key: str, limit: int) -> int:
    if type(value) is not int or not 0 <= value < limit:
        raise SessionError(f"the box's ident: {key} is missing or no unsigned integer below {limit}")
    return value
