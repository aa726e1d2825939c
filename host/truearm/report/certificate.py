"""Page one of a report, the certificate: what was calibrated, against what, the errors, and what they do not include.

It fits on a sheet of A4. Items that do not fit (many sensors, many files) are counted. ``workflows.certificates`` says
what is in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from truearm.report.page_parts import sentences
from truearm.report.page_tables import fact_list
from truearm.report.page_text import escape
from truearm.text import counted
from truearm.units import DEGC, UM, US

MOST = 4  # sensors, parts of the rig and files listed on page one
Facts = tuple[tuple[str, str], ...]  # labels and values
SIGNATURE = "".join(f"<p>{field}</p>" for field in ("place, date", "name", "signature"))


@dataclass(frozen=True)
class Sensor:
    """A calibrated channel of a box, as reported by the box.

    ``sigma`` [m] of its residuals and ``reference_sigma`` [m] of the ``reference`` instrument are None if not reported.
    """

    name: str
    serial: str
    date: str
    temperature: str
    sigma: float | None = None
    reference: str = ""
    reference_sigma: float | None = None


@dataclass(frozen=True)
class Recording:
    """How a session was recorded: times are UTC texts, ``bound`` [s] is of the box's clock, None where unknown.

    ``temperatures``: name, lowest and highest reading [°C] of each thermometer.
    """

    name: str
    begun: str
    uid: str
    firmware: str
    sensors: tuple[Sensor, ...]
    dwells: int  # at poses; stops between lines do not count
    mountings: int  # stops for mounting, which are not dwells
    rejected: tuple[tuple[str, int], ...]  # number by reason
    passes: int
    samples: int
    samples_lost: int
    frames_lost: int
    bound: float | None
    temperatures: tuple[tuple[str, float, float], ...] = ()


@dataclass(frozen=True)
class Certificate:
    """The content of page one: the decision in a sentence, groups of facts, and sentences on what the errors do not include."""

    heading: str
    decision: str
    groups: tuple[tuple[str, Facts], ...]
    excluded: tuple[str, ...] = ()


def facts_of(recordings: Sequence[Recording]) -> Facts:
    """Return labels and values of how sessions were recorded; of several, labels start with the session's name."""
    facts = []
    for one in recordings:
        of = f"{one.name}: " if len(recordings) > 1 else ""
        rejected = ", ".join(f"{n} {reason}" for reason, n in one.rejected) or "none"
        facts += [
            (f"{of}begun", one.begun or "not known"),
            (f"{of}box", f"{one.uid or 'without a uid'}, firmware {one.firmware or 'not known'}"),
            *(
                [(f"{of}dwells", f"{one.dwells}, of these rejected: {rejected}")]
                if one.dwells or not one.passes
                else []
            ),
            *([(f"{of}stops for mounting", str(one.mountings))] if one.mountings else []),
            *([(f"{of}passes along lines", str(one.passes))] if one.passes else []),
            (f"{of}samples", f"{one.samples:,} received, {one.samples_lost:,} lost; {one.frames_lost:,} frames lost"),
            (f"{of}error of the box's clock, at most", "not known" if one.bound is None else US.text(one.bound, ".0f")),
            *((f"{of}temperature of the {name}", _between(*degc)) for name, *degc in one.temperatures),
        ]
    return tuple(facts)


def conditions(recordings: Sequence[Recording]) -> Facts:
    """Return how the rows were recorded; what several sessions have of their own is on a later page."""
    if not recordings:
        return (("recording", "tables, which do not say how they were recorded"), ("temperature", "not recorded"))
    if len(recordings) == 1:
        return facts_of(recordings)
    readings: dict[str, list[float]] = {}
    for name, *degc in (reading for one in recordings for reading in one.temperatures):
        readings.setdefault(name, []).extend(degc)
    return (
        ("sessions", f"{len(recordings)}, listed under The recording"),
        ("samples lost", f"{sum(one.samples_lost for one in recordings):,}"),
        *((f"temperature of the {name}", _between(min(degc), max(degc))) for name, degc in readings.items()),
    )


def sensor_facts(recordings: Sequence[Recording]) -> Facts:
    """Return the sensors of the boxes with their calibrations."""
    sensors = list(dict.fromkeys(sensor for one in recordings for sensor in one.sensors))
    facts = []
    for sensor in sensors[:MOST]:
        words = (
            f"serial {sensor.serial}" * bool(sensor.serial),
            f"calibrated {sensor.date or 'on an unknown date'}",
            sensor.temperature,
            "" if sensor.sigma is None else f"residuals of {UM.text(sensor.sigma, '.1f')}",
            f"against {sensor.reference or 'a reference that is not named'}",
            "of unknown uncertainty"
            if sensor.reference_sigma is None
            else f"± {UM.text(2.0 * sensor.reference_sigma, '.1f')} (k = 2)",
        )
        facts.append((f"sensor {sensor.name}", ", ".join(filter(None, words))))
    return tuple(facts) + more(len(sensors))


def more(count: int) -> Facts:
    """Return how many entries are not listed."""
    return (("more", counted(count - MOST, "entry", "entries")),) if count > MOST else ()


def recorded(recordings: Sequence[Recording]) -> str:
    """Return the days on which sessions were recorded."""
    days = sorted({one.begun[:10] for one in recordings if one.begun})
    return " to ".join(dict.fromkeys((days[0], days[-1]))) if days else "not known"


def certificate_section(certificate: Certificate) -> str:
    """Return page one as HTML."""
    body = "".join(f"<h3>{title}</h3>{fact_list(facts)}" for title, facts in certificate.groups if facts)
    excluded = f"<h3>Not included</h3>{sentences(certificate.excluded, 'excluded')}" * bool(certificate.excluded)
    return (
        f'<section class="certificate"><h2>{certificate.heading}</h2>'
        f'<p class="decision">{escape(certificate.decision)}</p>{body}{excluded}'
        f'<div class="signature">{SIGNATURE}</div></section>\n'
    )


def _between(least: float, most: float) -> str:
    return f"{DEGC.of(least):.1f} to {DEGC.text(most, '.1f')}"
