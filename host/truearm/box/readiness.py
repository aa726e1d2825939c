"""Check before the start whether a box can measure what a session needs, from its description of itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date
from typing import Any

from truearm.errors import InputError
from truearm.session.box_ident import Ident, Stream, find_channels
from truearm.text import box_command, one_line
from truearm.units import DEGC, MM

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


@dataclass(frozen=True)
class Verdict:
    """Messages. ``refused``: why the session would be worthless; ``warned``: what the operator should know."""

    refused: tuple[str, ...] = ()
    warned: tuple[str, ...] = ()


def check_box(ident: Ident, purpose: Purpose, today: date) -> Verdict:
    """Check for missing, incorrectly described, uncalibrated or long-uncalibrated channels, and rates other than
    requested.
    """
    refused: list[str] = []
    warned: list[str] = []
    names = ((LVDT,) if purpose.ball_bar else ()) + (LINE_CHANNELS if purpose.line else ())
    for name in names:
        again = box_command(f"gauge {name}", purpose.device)
        try:
            stream, index = usable_channel(ident, name, purpose.device)
        except InputError as exc:
            refused.append(str(exc))
            continue
        if stream.channels[index].length_unit is None:
            refused.append(f"channel {name} is not calibrated to a length; calibrate it with {again}")
        else:
            warned += _old(name, described_channels(ident, stream)[index], today, again)
    channels = [channel for stream in ident.streams.values() for channel in stream.channels]
    if not names and all(channel.length_unit is None for channel in channels):
        warned.append(
            "no channel of the box is calibrated to a length, so truearm identify cannot use this session; calibrate one with "
            f"{box_command('gauge CHANNEL', purpose.device)}"
        )
    for stream in ident.streams.values():
        if purpose.osr is not None and stream.osr not in (0, purpose.osr):
            warned.append(
                f"stream {stream.name} samples at oversampling ratio (osr) {stream.osr}, not {purpose.osr} as requested"
            )
    return Verdict(tuple(refused), tuple(warned))


def described_channels(ident: Ident, stream: Stream) -> Sequence[Any]:
    """Return the channels of a stream as the box describes them."""
    channels: Sequence[Any] = ident.document["streams"][list(ident.streams).index(stream.id)]["channels"]
    return channels


def _old(name: str, described: Any, today: date, again: str) -> list[str]:
    """Return a warning of a calibration that is old; ``again`` calibrates the channel."""
    calibration = described.get("calibration") if isinstance(described, dict) else None
    calibrated_on = calibration.get("date") if isinstance(calibration, dict) else None
    try:
        days = (today - date.fromisoformat(str(calibrated_on))).days
    except ValueError:
        return []
    text = f"channel {name} was calibrated"
    if days < 0:
        return [f"{text} on {calibrated_on}, which is in the future; check the date of this computer"]
    return [f"{text} {days} days ago, on {calibrated_on}; calibrate it again with {again}"] * (days > OLD_DAYS)


def far_from_calibration(ident: Ident, channel: str, degc: float) -> str:
    """Warn if the box, now at ``degc`` [°C], is FAR or more from the calibration temperature of ``channel``, else
    return "".

    No warning is given if the box reads a thermometer on the bar: its lengths are corrected.
    """
    place = find_channels(ident, channel)
    if place is None or BAR in ident.thermometers:
        return ""
    stream, (index,) = place
    warmer = degc - stream.channels[index].calibrated_degc
    if not abs(warmer) >= FAR:  # also if it is not known
        return ""
    error = abs(warmer) * (STEEL * USUAL_BAR + LVDT_DRIFT * 0.5 * USUAL_TRAVEL)
    return (
        f"the box is {DEGC.text(abs(warmer), '.1f')} {'warmer' if warmer > 0.0 else 'colder'} than when {channel} was calibrated, "
        f"and reads no thermometer on the bar: lengths may be off by about {MM.text(error, '.2f')} (a steel bar of {MM.text(USUAL_BAR, '.0f')}); "
        "put a thermometer on the bar, or wait"
    )


def usable_channel(ident: Ident, name: str, device: str) -> tuple[Stream, int]:
    """Return the stream with a channel, and the channel's index. Raises InputError if there is none that can be used."""
    place = find_channels(ident, name)
    if place is None:
        names = ", ".join(one_line(c.name) for s in ident.streams.values() for c in s.channels)
        advice = (
            f"switch it on with {box_command('config set magnetostrictive.period_us=983.04', device)}"
            if name == LINE_CHANNELS[0]
            else f"to rename one, save what {box_command('config get', device)} prints as box.toml, edit it, and run "
            f"{box_command('config set box.toml', device)}"
        )
        raise InputError(f"the box has no channel {one_line(name[:40])} (it has {names}); {advice}")
    stream, (index,) = place
    if fault := stream.channels[index].fault:
        command = box_command(f"config set channel.{name}.KEY=VALUE", device)
        raise InputError(f"channel {name} cannot be used: {fault}; correct it with {command}")
    return stream, index
