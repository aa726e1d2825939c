"""Page one of a report, the certificate: what was calibrated, by whom, with what equipment, how, and the result.

It fits on a sheet of A4. Items that do not fit (many sessions, many sensors) are counted, and listed on the following
pages.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from truearm.estimate.gain import gain_of
from truearm.report.page_tables import fact_list
from truearm.report.page_text import size
from truearm.report.result_words import before_words
from truearm.results import Estimate, Gain, HeldOut, PredictedError
from truearm.text import counted, outcome
from truearm.units import DEGC, US

K = 2.0  # coverage factor: 95 % of a normal error
MOST = 6  # sessions, sensors and files listed on page one


@dataclass(frozen=True)
class Sensor:
    """A calibrated channel of a box, as reported by the box."""

    name: str
    serial: str
    date: str
    temperature: str


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
    """The content of page one. ``files``: role, name and SHA-256 of what was read; ``method``: label and value."""

    name: str
    robot: str
    serial: str
    operator: str
    software: str
    recordings: tuple[Recording, ...]
    files: tuple[tuple[str, str, str], ...]
    method: tuple[tuple[str, str], ...]


def facts_of(recordings: Sequence[Recording]) -> tuple[tuple[str, str], ...]:
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


def certificate_section(
    certificate: Certificate,
    e: Estimate,
    judged: HeldOut | None,
    predicted: PredictedError | None,
    simulated: bool = False,
) -> str:
    """Return page one as HTML."""
    robot = certificate.robot + (f", serial {certificate.serial}" if certificate.serial else "")
    what = [
        ("calibrated", certificate.name or robot),
        *([("robot", robot)] if certificate.name else []),
        ("operator", certificate.operator or "not given"),
        ("recorded", _recorded(certificate.recordings)),
        ("software", certificate.software),
    ]
    groups = [
        ("What", what),
        ("Result", _result(e, judged, predicted)),
        ("Method", list(certificate.method)),
        ("Conditions", _conditions(certificate.recordings)),
        ("Sensors", _sensors(certificate.recordings)),
        (
            "Files read",
            [(f"{role}: {name}", f"SHA-256 {digest}") for role, name, digest in certificate.files[:MOST]]
            + _more(len(certificate.files)),
        ),
    ]
    body = "".join(f"<h3>{title}</h3>{fact_list(pairs)}" for title, pairs in groups if pairs)
    return f'<section class="certificate"><h2>Certificate of {"a simulated " * simulated}calibration</h2>{body}</section>\n'


def _conditions(recordings: Sequence[Recording]) -> list[tuple[str, str]]:
    if not recordings:
        return [("recording", "tables, which do not say how they were recorded")]
    if len(recordings) == 1:
        return list(facts_of(recordings))
    dwells, rejected = sum(one.dwells for one in recordings), sum(n for one in recordings for _, n in one.rejected)
    passes = sum(one.passes for one in recordings)
    bounds = [one.bound for one in recordings]
    read: dict[str, list[tuple[float, float]]] = {}
    for name, low, high in (degc for one in recordings for degc in one.temperatures):
        read.setdefault(name, []).append((low, high))
    worst = None if None in bounds else max(filter(None, bounds), default=None)
    return [
        ("sessions", str(len(recordings))),
        ("boxes", ", ".join(dict.fromkeys(f"{one.uid}, firmware {one.firmware}" for one in recordings))),
        *([("dwells", f"{dwells}, of these rejected: {rejected}")] if dwells or not passes else []),
        *([("passes along lines", str(passes))] if passes else []),
        ("samples lost", f"{sum(one.samples_lost for one in recordings):,}"),
        ("error of the box's clock, at most", "not known" if worst is None else US.text(worst, ".0f")),
        *(
            (f"temperature of the {name}", _between(min(low for low, _ in of), max(high for _, high in of)))
            for name, of in read.items()
        ),
    ]


def _between(least: float, most: float) -> str:
    return f"{DEGC.of(least):.1f} to {DEGC.text(most, '.1f')}"


def _recorded(recordings: Sequence[Recording]) -> str:
    days = sorted({one.begun[:10] for one in recordings if one.begun})
    if not days:
        return "not known"
    return days[0] if len(days) == 1 else f"{days[0]} to {days[-1]}"


def _result(e: Estimate, judged: HeldOut | None, predicted: PredictedError | None) -> list[tuple[str, str]]:
    pairs = []
    for si, after in e.rms_after.items():
        parts = e.parts.get(si)
        pairs.append((f"RMS before{before_words(e, ', ')}", size(e.rms_before[si], si)))
        pairs.append(("RMS after", size(after, si)))
        if parts is not None:
            pairs.append(("part of it that the declared noise does not explain", size(parts.unexplained, si)))
        if judged and si in judged.figures:
            error = judged.figures[si]
            pairs.append(("RMS held out", f"{size(error.rms, si)}, largest {size(error.max, si)}"))
    if predicted and (not e.unexplained or predicted.exceeds(e.unexplained)):
        pairs.append(
            (
                f"expanded uncertainty of the tool, from the parameters (k = {K:g})",
                f"{size(K * predicted.rms, 'm')} where measured",
            )
        )
    else:
        pairs.append(
            (
                f"expanded uncertainty of the tool (k = {K:g})",
                "does not follow from the parameters: see the error on held-out rows",
            )
        )
    if e.unusable and e.status == "converged":
        return [*pairs, ("fit", f"NOT USABLE: {e.unusable}")]
    if gain_of(e.mean_change) is Gain.NONE:
        return [*pairs, ("fit", "converged, but NO BETTER than the nominal robot")]
    pairs.append(("fit", "converged" if e.status == "converged" else f"NOT USABLE: {outcome(e.status)}"))
    return pairs


def _sensors(recordings: Sequence[Recording]) -> list[tuple[str, str]]:
    distinct = dict.fromkeys(sensor for one in recordings for sensor in one.sensors)
    pairs = [
        (
            sensor.name,
            ", ".join(
                filter(
                    None,
                    (
                        f"serial {sensor.serial}" * bool(sensor.serial),
                        f"calibrated {sensor.date or 'on an unknown date'}",
                        sensor.temperature,
                    ),
                )
            ),
        )
        for sensor in list(distinct)[:MOST]
    ]
    return pairs + _more(len(distinct))


def _more(count: int) -> list[tuple[str, str]]:
    return [("more", counted(count - MOST, "entry", "entries"))] if count > MOST else []
