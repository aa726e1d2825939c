"""Facts about how a session was recorded, for reports."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from truearm.report.certificate import Facts, Recording, between
from truearm.text import one_line
from truearm.units import NS, UM, US

if TYPE_CHECKING:
    from truearm.session.observations import SyncResult
    from truearm.session.session_file import Session
    from truearm.workflows.inputs import DwellCount


def recording_of(session: Session, result: SyncResult, count: DwellCount) -> Recording:
    """Return the facts of one session; ``count`` has its dwells."""
    idents, losses, reports = list(result.survey.idents.values()), result.losses, result.clock_reports
    uid = ", ".join(dict.fromkeys(one_line(str(ident.document.get("uid", ""))[:32]) for ident in idents))
    firmware = ", ".join(dict.fromkeys(one_line(ident.firmware[:32]) for ident in idents))
    begun = _utc(session.metadata.get("session", {}).get("utc_ns", ""))
    lost = losses.samples_lost + losses.samples_overrun
    facts = [("begun", begun or "not known"), ("box", f"{uid or 'without a uid'}, firmware {firmware or 'not known'}")]
    if count.with_bar or not count.lines:  # otherwise the dwells are stops between lines
        rejected = ", ".join(f"{n} {reason}" for reason, n in count.rejected.items()) or "none"
        facts.append(("dwells", f"{count.dwells}, of these rejected: {rejected}"))
        facts += [("stops for mounting", str(count.mountings))] if count.mountings else []
    facts += [("passes along lines", str(count.lines))] if count.lines else []
    facts.append(("samples", f"{result.samples_seen:,} received, {lost:,} lost; {losses.frames_lost:,} frames lost"))
    bound = US.text(max(NS.to_si(report.bound_ns) for report in reports), ".0f") if reports else "not known"
    facts.append(("error of the box's clock, at most", bound))
    read = [(one_line(name) or "unnamed", one.extremes) for name, one in result.survey.thermometers.items()]
    temperatures = tuple((name, *degc) for name, degc in read if degc is not None)
    facts += [(f"temperature of the {name}", between(*degc)) for name, *degc in temperatures]
    sensors = tuple(dict.fromkeys(sensor for ident in idents for sensor in sensors_of(ident.document)))
    return Recording(one_line(session.path.name), begun, tuple(facts), sensors, lost, temperatures)


def _utc(nanoseconds: str) -> str:
    """Format a time as text; "" for none."""
    if not nanoseconds.isdecimal() or len(nanoseconds) > 19:
        return ""
    return datetime.fromtimestamp(NS.to_si(int(nanoseconds)), UTC).strftime("%Y-%m-%d %H:%M UTC")


def sensors_of(document: Mapping[str, Any]) -> Facts:
    """Return the calibrated channels named by a box, each with its calibration."""
    streams = (stream for stream in document.get("streams") or [] if isinstance(stream, dict))
    channels = (channel for stream in streams for channel in stream.get("channels") or [])
    calibrated = (channel for channel in channels if isinstance(channel, dict) and channel.get("calibration"))
    return tuple(_sensor(channel) for channel in calibrated if isinstance(channel["calibration"], dict))


def _sensor(channel: Mapping[str, Any]) -> tuple[str, str]:
    calibration = channel["calibration"]
    serial, date, reference = (
        one_line(str(calibration.get(key) or "")[:80]) for key in ("serial", "date", "reference")
    )
    degc = calibration.get("temperature_mdegc")
    sigma, reference_sigma = (_sigma(calibration, key) for key in ("sigma", "reference_sigma"))
    words = (
        f"serial {serial}" * bool(serial),
        f"calibrated {date or 'on an unknown date'}",
        f"at {degc // 100 / 10:.1f} °C" if type(degc) is int else "",
        "" if sigma is None else f"residuals of {UM.text(sigma, '.1f')}",
        f"against {reference or 'a reference that is not named'}",
        "of unknown uncertainty" if reference_sigma is None else f"± {UM.text(2.0 * reference_sigma, '.1f')} (k = 2)",
    )
    return f"sensor {one_line(str(channel.get('name', ''))[:40])}", ", ".join(filter(None, words))


def _sigma(calibration: Mapping[str, Any], key: str) -> float | None:
    """Return a standard deviation [m] of a calibration; None if the box does not report it as a length."""
    pair = calibration.get(key)
    if calibration.get("unit") != "m" or not (isinstance(pair, list) and len(pair) == 2):
        return None
    mantissa, exponent = pair
    known = type(mantissa) is int and type(exponent) is int and abs(exponent) < 30
    return float(mantissa * 10.0**exponent) if known else None
