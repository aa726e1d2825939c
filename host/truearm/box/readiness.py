"""Check before the start whether a box can measure what a session needs, from its description of itself."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import date
from typing import Any

from truearm.errors import InputError
from truearm.findings import Finding
from truearm.session.box_ident import Ident, Stream, find_channels
from truearm.units import MM

LVDT = "lvdt"
BAR = "bar"  # name of the bar's thermometer
LINE_CHANNELS = ("magnetostrictive", "transverse_a", "transverse_b")
OLD_DAYS = 365
FAR = 2.0  # K: 12 µm for a steel bar of half a metre
STEEL = 11.5e-6  # 1/K, for a bar without a declared expansion
LVDT_DRIFT = 1e-4  # 1/K, of an LVDT's gain (docs/how-to/hardware.md), if not declared
USUAL_BAR, USUAL_TRAVEL = 0.5, 0.075  # m, if the rig does not specify them


@dataclass(frozen=True)
class Purpose:
    """What is to be measured; ``osr`` is the requested one, None: as set in the box; ``device`` is the box's port, for
    the commands in messages.
    """

    ball_bar: bool = False
    line: bool = False
    osr: int | None = None
    device: str = "DEVICE"


def check_box(ident: Ident, purpose: Purpose, today: date) -> Iterator[Finding]:
    """Return missing, incorrectly described and uncalibrated channels, which make a session worthless, and as warnings
    long-uncalibrated ones, and rates other than requested.
    """
    device = [purpose.device]
    names = ((LVDT,) if purpose.ball_bar else ()) + (LINE_CHANNELS if purpose.line else ())
    for name in names:
        try:
            stream, index = usable_channel(ident, name, purpose.device)
        except InputError as exc:
            yield exc.finding
            continue
        if stream.channels[index].length_unit is None:
            yield Finding("uncalibrated-channel", {"channel": name, "device": device})
        else:
            yield from _old(name, described_channels(ident, stream)[index], today, device)
    channels = [channel for stream in ident.streams.values() for channel in stream.channels]
    if not names and all(channel.length_unit is None for channel in channels):
        yield Finding("nothing-calibrated", {"device": device})
    for stream in ident.streams.values():
        if purpose.osr is not None and stream.osr not in (0, purpose.osr):
            yield Finding("other-rate", {"stream": stream.name, "osr": stream.osr, "requested": purpose.osr})


def described_channels(ident: Ident, stream: Stream) -> Sequence[Any]:
    """Return the channels of a stream as the box describes them."""
    channels: Sequence[Any] = ident.document["streams"][list(ident.streams).index(stream.id)]["channels"]
    return channels


def _old(name: str, described: Any, today: date, device: list[str]) -> list[Finding]:
    """Return a warning of a calibration that is old."""
    calibration = described.get("calibration") if isinstance(described, dict) else None
    calibrated_on = calibration.get("date") if isinstance(calibration, dict) else None
    try:
        days = (today - date.fromisoformat(str(calibrated_on))).days
    except ValueError:
        return []
    values = {"channel": name, "days": days, "date": str(calibrated_on), "device": device}
    code = "future-calibration" if days < 0 else "old-calibration"
    return [Finding(code, values)] if days < 0 or days > OLD_DAYS else []


def far_from_calibration(ident: Ident, channel: str, degc: float) -> Finding | None:
    """Warn if the box, now at ``degc`` [°C], is FAR or more from the calibration temperature of ``channel``.

    No warning is given if the box reads a thermometer on the bar: its lengths are corrected.
    """
    place = find_channels(ident, channel)
    if place is None or BAR in ident.thermometers:
        return None
    stream, (index,) = place
    warmer = degc - stream.channels[index].calibrated_degc
    if not abs(warmer) >= FAR:  # also if it is not known
        return None
    error = abs(warmer) * (STEEL * USUAL_BAR + LVDT_DRIFT * 0.5 * USUAL_TRAVEL)
    lengths = {"error": {"mm": MM.of(error)}, "length": {"mm": MM.of(USUAL_BAR)}}
    values = {"channel": channel, "difference": {"degc": abs(warmer)}, "warmer": warmer > 0.0}
    return Finding("box-temperature", {**values, **lengths})


def usable_channel(ident: Ident, name: str, device: str) -> tuple[Stream, int]:
    """Return the stream with a channel, and the channel's index. Raises InputError if there is none that can be used."""
    place = find_channels(ident, name)
    if place is None:
        names = [channel.name for stream in ident.streams.values() for channel in stream.channels]
        is_head = name == LINE_CHANNELS[0]
        raise InputError("no-channel", channel=name[:40], names=names, switch=is_head, device=[device])
    stream, (index,) = place
    if fault := stream.channels[index].fault:
        raise InputError("unusable-channel", channel=name, fault=fault, device=[device])
    return stream, index
