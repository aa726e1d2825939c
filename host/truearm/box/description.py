"""Format the output of ``truearm box``: a box, its ports, its self-test."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from truearm.box.readiness import described_channels
from truearm.findings import Finding
from truearm.session.box_ident import Channel, Ident, Stream
from truearm.text import one_line
from truearm.units import MM, MS, NS, UM, US, length, micro


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
