"""What a box says about itself: its description, whether it can measure what a session needs, and its self-test.

The box applies its own limits to its self-test (protocol/SPEC.md §5). A value within but close to a limit is a warning
here: a sagging rail, a doubled noise or a lost stop pulse indicates a coming failure.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from typing import Any

from truearm.errors import InputError
from truearm.findings import Finding, option, worded
from truearm.session.frames import Channel, Ident, Stream, find_channels
from truearm.text import one_line
from truearm.units import MM, MS, NS, UM, US, length, micro

LVDT = "lvdt"
BAR = "bar"  # name of the bar's thermometer
LINE_CHANNELS = ("magnetostrictive", "transverse_a", "transverse_b")
OLD_DAYS = 365
FAR = 2.0  # K: 12 µm for a steel bar of half a metre
STEEL = 11.5e-6  # 1/K, for a bar without a declared expansion
LVDT_DRIFT = 1e-4  # 1/K, of an LVDT's gain (docs/how-to/hardware.md), if not declared
USUAL_BAR, USUAL_TRAVEL = 0.5, 0.075  # m, if the rig does not specify them
PASS, WARN, FAIL = "pass", "warn", "fail"
MAX_RESULTS = 64


@dataclass(frozen=True)
class Purpose:
    """What is to be measured.

    ``osr`` is the requested one, None: as set in the box; ``device`` is the box's port, for the commands in messages.
    """

    ball_bar: bool = False
    line: bool = False
    osr: int | None = None
    device: str = "DEVICE"


def check_box(ident: Ident, purpose: Purpose, today: date) -> Iterator[Finding]:
    """Return findings about channels and rates.

    Missing, incorrectly described and uncalibrated channels make a session worthless. Long-uncalibrated ones, and rates
    other than requested, are warnings.
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
    """Return the stream with a channel, and the channel's index.

    Raises InputError if there is none that can be used.
    """
    place = find_channels(ident, name)
    if place is None:
        names = [channel.name for stream in ident.streams.values() for channel in stream.channels]
        is_head = name == LINE_CHANNELS[0]
        raise InputError("no-channel", channel=name[:40], names=names, switch=is_head, device=[device])
    stream, (index,) = place
    if fault := stream.channels[index].fault:
        raise InputError("unusable-channel", channel=name, fault=fault, device=[device])
    return stream, index


def ident_lines(ident: Ident) -> list[str]:
    """Describe everything about a box that may be of interest to the operator."""
    document = ident.document
    rows = [
        ("firmware", f"{ident.firmware or 'unknown'} on {document.get('board', 'an unknown board')}"),
        ("protocol", ".".join(map(str, document.get("protocol", [])))),
        ("uid", str(document.get("uid", ""))),
        ("boot", f"{ident.boot_id:08x}"),
    ]
    lines = [f"{name:<10}{one_line(value)}" for name, value in rows]
    for stream in ident.streams.values():
        lines += ["", f"stream {stream.name}: {_rate(stream)}"]
        described = zip(stream.channels, described_channels(ident, stream), strict=True)
        lines += [f"  {_channel(channel, entry)}" for channel, entry in described]
    for fault in ident.faults:
        lines += ["", Finding("box-fault", {"fault": fault}).text()]
    if isinstance(document.get("last_error"), str):
        lines += ["", Finding("box-traceback").text() + ":"]
        lines += ["  " + one_line(line) for line in document["last_error"].splitlines()]
    return lines


def _rate(stream: Stream) -> str:
    rate = f"{NS.factor / stream.period_ns:.2f} samples per second" if stream.period_ns else "no fixed rate"
    if stream.shortest_period_ns:
        rate += f" (at most {NS.factor / stream.shortest_period_ns:.2f} without loss)"
    osr = f", osr {stream.osr}" if stream.osr else ""
    return f"{rate}{osr}, group delay {MS.text(NS.to_si(stream.group_delay_ns), '.3f')}"


def _channel(channel: Channel, entry: Any) -> str:
    if channel.fault:
        return f"{one_line(channel.name):<18}cannot be used: {channel.fault}"
    gain = entry.get("gain", 1)
    text = f"{one_line(channel.name):<18}{channel.scale:.6g} {one_line(channel.unit)} per count, gain {gain!s:.6}"
    if not channel.poly:
        return text + ", not calibrated"
    calibration = entry.get("calibration", {})
    origin = " ".join(one_line(str(calibration[key])) for key in ("serial", "date") if calibration.get(key))
    return f"{text}, calibrated to {one_line(channel.calibrated_unit)} by {len(channel.poly)} coefficients ({origin or 'no serial, no date'})"


def with_spread(value: float, spread: float, unit: str) -> str:
    """Format a value with its spread: lengths in mm and µm, times in µs, everything else unchanged."""
    if not math.isfinite(value):
        return "–"
    if scale := length(unit):
        return f"{MM.text(scale.to_si(value), '.4f')} ± {UM.text(scale.to_si(spread), '.1f')}"
    if unit == "s":
        return f"{US.text(value, '.4f')} ± {NS.text(spread, '.1f')}"
    return f"{value:.6f} {unit} ± {micro(unit).text(spread, '.1f')}"


def port_lines(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Format a table of ports and what answered there."""
    lines = []
    for row in rows:
        usb = f" ({row['usb']} {row['product']})".replace("( ", "(") if row["usb"] or row["product"] else ""
        lines.append(one_line(f"{row['device']}{usb}: {row['answer']}"))
    return lines


@dataclass(frozen=True)
class Check:
    """A result: the code of its finding unless it passes without a warning, which a value in the range ``inner`` does.

    The displayed unit is the wire's times 1 / ``per``.
    """

    code: str
    title: str
    inner: tuple[float, float]
    unit: str = ""
    per: int = 1
    shown_as: str = "d"

    def scaled(self, value: int) -> str:
        """Return a value in the displayed unit."""
        return format(value if self.per == 1 else value / self.per, self.shown_as)


CHECKS = {
    "converter_id": Check("test-converter", "the converter answers", (0x2400, 0x24FF), shown_as="#x"),
    "excitation": Check(
        "test-excitation", "current of the LVDT's primary, as a voltage", (60_000, 1_100_000), "mV", 1000, ".1f"
    ),
    **{
        f"noise_{i}": Check("test-noise", f"noise of converter input {i}, shorted", (1, 10_000), "µV", 1000, ".2f")
        for i in range(4)
    },
    "stops": Check("test-stops", "stop pulses of 16 interrogations of the magnetostrictive head", (16, 16)),
    "rail_5v": Check("test-supply", "5 V of the USB port", (4_500, 5_400), "V", 1000, ".2f"),
    "temperature": Check("test-temperature", "temperature of the chip", (-10_000, 60_000), "°C", 1000, ".1f"),
    "thermometers_missing": Check("test-thermometers", "thermometers of the configuration that do not answer", (0, 0)),
}
ALWAYS = ("converter_id", "noise_0", "noise_1", "noise_2", "noise_3", "rail_5v", "temperature")


def findings(results: Mapping[str, Any], device: str = "DEVICE") -> dict[str, Finding]:
    """Return the findings by name of the result, in the order of the signal path; unknown names come last, as judged.

    A result that cannot be read is a failure; a missing one of ``ALWAYS`` is a warning. ``device`` is the box's port,
    for the commands in the remedies.
    """
    names = [name for name in CHECKS if name in results or name in ALWAYS]
    names += sorted(set(results) - set(CHECKS))[:MAX_RESULTS]
    return {name: _finding(name, results.get(name), device) for name in names}


def _finding(name: str, result: Any, device: str) -> Finding:
    check = CHECKS.get(name, Check("test-unknown", name[:40], (-(2.0**63), 2.0**63)))
    values: dict[str, Any] = {"verdict": WARN, "title": check.title, "value": "", "near": False, "device": [device]}
    if result is None:
        return Finding(check.code, values)
    value, ok = (result.get("value"), result.get("ok")) if isinstance(result, dict) else (None, None)
    if type(value) is not int or abs(value) >= 2**63 or ok not in (0, 1):
        return Finding("test-unreadable", {**values, "verdict": FAIL})
    unit = check.unit if name in CHECKS else str(result.get("unit", ""))[:10]
    values["value"] = f"{check.scaled(value)} {unit}".strip()
    if not ok:
        limits = [result.get("low"), result.get("high")]
        if all(type(limit) is int and abs(limit) < 2**63 for limit in limits):
            values["value"] += f" (allowed: {' to '.join(map(check.scaled, limits))} {unit}".rstrip() + ")"
        return Finding(check.code, {**values, "verdict": FAIL})
    near = not check.inner[0] <= value <= check.inner[1]
    return (
        Finding(check.code, {**values, "near": True}) if near else Finding("test-passed", {**values, "verdict": PASS})
    )


def entry(name: str, finding: Finding) -> dict[str, Any]:
    """Return a result as JSON."""
    values, remedy = finding.values, finding.statement.remedy
    return {
        "name": name,
        **{key: values[key] for key in ("verdict", "title", "value")},
        "advice": worded(remedy, values, option),
        **finding.entry(),
    }
