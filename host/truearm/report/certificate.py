"""Page one of a report, the certificate: what was calibrated, against what, the errors, and what they do not include.

It fits on a sheet of A4. Items that do not fit (many sensors, many files) are counted. ``workflows.certificates`` says
what is in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from truearm.findings import Finding, option
from truearm.report.page import escape, fact_list, sentences
from truearm.text import counted
from truearm.units import DEGC

MOST = 4  # sensors, parts of the rig and files listed on page one
Facts = tuple[tuple[str, str], ...]  # labels and values
UNRECORDED = ("temperature", "not recorded")
SIGNATURE = "".join(f"<p>{field}</p>" for field in ("place, date", "name", "signature"))


class Recording(NamedTuple):
    """How a session was recorded: its file, when in UTC, "" if unknown, and the facts about it and about the sensors of its box.

    ``temperatures``: name, lowest and highest reading [°C] of each thermometer.
    """

    name: str
    begun: str
    facts: Facts
    sensors: Facts
    samples_lost: int
    temperatures: tuple[tuple[str, float, float], ...] = ()


@dataclass(frozen=True)
class Certificate:
    """The content of page one: groups of facts, and findings: the decision, then what the error does not include."""

    heading: str
    groups: tuple[tuple[str, Facts], ...]
    findings: tuple[Finding, ...] = ()


def facts_of(recordings: Sequence[Recording]) -> Facts:
    """Return labels and values of how sessions were recorded; of several, labels start with the session's name."""
    are_many = len(recordings) > 1
    return tuple(
        (f"{recording.name}: {label}" if are_many else label, value)
        for recording in recordings
        for label, value in recording.facts
    )


def conditions(recordings: Sequence[Recording]) -> Facts:
    """Return how the rows were recorded; what several sessions have of their own is on a later page."""
    if not recordings:
        return (("recording", "tables, which do not say how they were recorded"), UNRECORDED)
    if len(recordings) == 1:
        return facts_of(recordings)
    readings: dict[str, list[float]] = {}
    for name, *degc in (reading for recording in recordings for reading in recording.temperatures):
        readings.setdefault(name, []).extend(degc)
    temperatures = [(f"temperature of the {name}", between(min(degc), max(degc))) for name, degc in readings.items()]
    return (
        ("sessions", f"{len(recordings)}, listed under The recording"),
        ("samples lost", f"{sum(recording.samples_lost for recording in recordings):,}"),
        *(temperatures or [UNRECORDED]),
    )


def sensor_facts(recordings: Sequence[Recording]) -> Facts:
    """Return the sensors of the boxes with their calibrations."""
    sensors = tuple(dict.fromkeys(sensor for recording in recordings for sensor in recording.sensors))
    return shortened(sensors)


def shortened(facts: Facts) -> Facts:
    """Return at most MOST facts, and how many are not listed."""
    return facts[:MOST] + (("more", counted(len(facts) - MOST, "entry", "entries")),) * (len(facts) > MOST)


def recorded(recordings: Sequence[Recording]) -> str:
    """Return the days on which sessions were recorded."""
    days = sorted({recording.begun[:10] for recording in recordings if recording.begun})
    return " to ".join(dict.fromkeys((days[0], days[-1]))) if days else "not known"


def certificate_section(certificate: Certificate) -> str:
    """Return page one as HTML."""
    body = "".join(f"<h3>{escape(title)}</h3>{fact_list(facts)}" for title, facts in certificate.groups if facts)
    texts = [finding.text(option) for finding in certificate.findings]
    decision = "".join(f'<p class="decision">{escape(text, 400)}</p>' for text in texts[:1])
    excluded = f"<h3>Not included</h3>{sentences(texts[1:], 'excluded')}" if texts else ""
    return (
        f'<section class="certificate"><h2>{certificate.heading}</h2>{decision}{body}{excluded}'
        f'<div class="signature">{SIGNATURE}</div></section>\n'
    )


def between(lowest: float, highest: float) -> str:
    """Return a range of temperatures."""
    return f"{DEGC.of(lowest):.1f} to {DEGC.text(highest, '.1f')}"
