"""Facts about how a session was recorded, for reports."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from truearm.report.certificate import Recording, Sensor
from truearm.text import one_line
from truearm.units import NS

if TYPE_CHECKING:
    from truearm.session.observations import SyncResult
    from truearm.session.session_file import Session
    from truearm.workflows.inputs import DwellCount


def recording_of(session: Session, result: SyncResult, count: DwellCount) -> Recording:
    """Return the facts of one session; ``count`` has its dwells."""
    idents = list(result.survey.idents.values())
    reports = result.clock_reports
    read = [(one_line(name) or "unnamed", one.extremes) for name, one in result.survey.thermometers.items()]
    counts = count.with_bar or not count.lines  # otherwise the dwells are stops between lines
    return Recording(
        name=one_line(session.path.name),
        begun=_utc(session.metadata.get("session", {}).get("utc_ns", "")),
        uid=", ".join(dict.fromkeys(one_line(str(ident.document.get("uid", ""))[:32]) for ident in idents)),
        firmware=", ".join(dict.fromkeys(one_line(ident.firmware[:32]) for ident in idents)),
        sensors=tuple(dict.fromkeys(sensor for ident in idents for sensor in sensors_of(ident.document))),
        dwells=counts * count.dwells,
        mountings=counts * count.mountings,
        rejected=tuple(count.rejected.items()) * counts,
        passes=count.lines,
        samples=result.samples_seen,
        samples_lost=result.losses.samples_lost + result.losses.samples_overrun,
        frames_lost=result.losses.frames_lost,
        bound=max(NS.to_si(report.bound_ns) for report in reports) if reports else None,
        temperatures=tuple((name, *degc) for name, degc in read if degc is not None),
    )


def _utc(nanoseconds: str) -> str:
    """Format a time as text; "" for none."""
    if not nanoseconds.isdecimal() or len(nanoseconds) > 19:
        return ""
    return datetime.fromtimestamp(NS.to_si(int(nanoseconds)), UTC).strftime("%Y-%m-%d %H:%M UTC")


def sensors_of(document: Mapping[str, Any]) -> list[Sensor]:
    """Return the calibrated channels named by a box."""
    found = []
    for stream in document.get("streams") or []:
        for channel in stream.get("channels") or [] if isinstance(stream, dict) else []:
            calibration = channel.get("calibration") if isinstance(channel, dict) else None
            if isinstance(calibration, dict) and calibration:
                serial, date = (one_line(str(calibration.get(key) or "")[:40]) for key in ("serial", "date"))
                temperature = calibration.get("temperature_mdegc")
                name = one_line(str(channel.get("name", ""))[:40])
                degc = f"at {temperature // 100 / 10:.1f} °C" if type(temperature) is int else ""
                reference = one_line(str(calibration.get("reference") or "")[:80])
                sigmas = _sigma(calibration, "sigma"), _sigma(calibration, "reference_sigma")
                found.append(Sensor(name, serial, date, degc, sigmas[0], reference, sigmas[1]))
    return found


def _sigma(calibration: Mapping[str, Any], key: str) -> float | None:
    """Return a standard deviation [m] of a calibration; None if the box does not report it as a length."""
    pair = calibration.get(key)
    if calibration.get("unit") != "m" or not (isinstance(pair, list) and len(pair) == 2):
        return None
    mantissa, exponent = pair
    known = type(mantissa) is int and type(exponent) is int and abs(exponent) < 30
    return float(mantissa * 10.0**exponent) if known else None
