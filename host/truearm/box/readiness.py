"""Whether a box can measure what a session is for, by what it says of itself; asked before it is started."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import date
from typing import TYPE_CHECKING, Any

from truearm.text import one_line

if TYPE_CHECKING:
    from truearm.session.box_ident import Ident, Stream

LVDT = "lvdt"
LINE_CHANNELS = ("magnetostrictive", "transverse_a", "transverse_b")
OLD_DAYS = 365


@dataclass(frozen=True)
class Purpose:
    """What is to be measured; ``osr`` is what was asked for, None: whatever the box has."""

    ball_bar: bool = False
    line: bool = False
    osr: int | None = None


@dataclass(frozen=True)
class Verdict:
    """Sentences. With ``refused`` the session would be worth nothing; ``warned`` is what the operator should know."""

    refused: tuple[str, ...] = ()
    warned: tuple[str, ...] = ()


def check_box(ident: Ident, purpose: Purpose, today: date) -> Verdict:
    """Channels that are missing, described wrongly, not calibrated or long ago, and rates that are not as asked for."""
    refused: list[str] = []
    warned: list[str] = []
    names = ((LVDT,) if purpose.ball_bar else ()) + (LINE_CHANNELS if purpose.line else ())
    for name in names:
        wrong, old = _channel(ident, name, today)
        refused += wrong
        warned += old
    if not names and (text := _uncalibrated(ident)):
        warned.append(text)
    for stream in ident.streams.values():
        if purpose.osr is not None and stream.osr not in (0, purpose.osr):
            warned.append(f"stream {stream.name} samples at osr {stream.osr}, not {purpose.osr} as asked for")
    return Verdict(tuple(refused), tuple(warned))


def _channel(ident: Ident, name: str, today: date) -> tuple[list[str], list[str]]:
    from truearm.session.box_ident import find_channel

    found = find_channel(ident, name)
    if found is None:
        known = ", ".join(one_line(c.name) for s in ident.streams.values() for c in s.channels)
        advice = (
            "switch it on with truearm box config set magnetostrictive.period_us=983.04"
            if name == LINE_CHANNELS[0]
            else "name it with truearm box config set"
        )
        return [f"the box has no channel {name} (it has {known}); {advice}"], []
    stream, index = found
    channel = stream.channels[index]
    if channel.fault:
        return [f"channel {name} cannot be used: {channel.fault}; correct it with truearm box config set"], []
    if channel.length_unit is None:
        return [f"channel {name} is not calibrated to a length; calibrate it with truearm box gauge {name}"], []
    return [], _old(name, _described(ident, stream, index), today)


def _old(name: str, described: Mapping[str, Any], today: date) -> list[str]:
    calibration = described.get("calibration")
    made = calibration.get("date") if isinstance(calibration, dict) else None
    try:
        days = (today - date.fromisoformat(str(made))).days
    except ValueError:
        return []
    if days < 0:
        return [f"channel {name} was calibrated on {made}, which is still to come; is this computer's date right?"]
    return [f"channel {name} was calibrated {days} days ago, on {made}"] if days > OLD_DAYS else []


def _described(ident: Ident, stream: Stream, index: int) -> Mapping[str, Any]:
    entry = ident.document["streams"][list(ident.streams).index(stream.id)]["channels"][index]
    return entry if isinstance(entry, dict) else {}


def _uncalibrated(ident: Ident) -> str:
    channels = [c for s in ident.streams.values() for c in s.channels]
    if any(c.length_unit is not None for c in channels):
        return ""
    return "no channel of the box is calibrated to a length; truearm identify will not take this session"
