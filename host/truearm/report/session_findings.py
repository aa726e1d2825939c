"""The findings of a session, from ``truearm inspect --json``: whether it is usable, and what went wrong."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from truearm.findings import Finding, ordered, stated
from truearm.text import counted, faster, one_line
from truearm.types import MOUNTING, NEED_DECISION
from truearm.units import NS, UM, US

Document = Mapping[str, Any]

LOSSES = {  # the counters of a finding
    "lost-on-link": ("frames_lost", "samples_lost"),
    "lost-in-box": ("samples_overrun", "overruns", "dropped"),
    "box-faults": ("converter_faults", "crc_errors", "converter_resets", "thermometer_errors", "restarts"),
    "missing-stop-pulses": ("missing_stops",),
    "malformed-plan": ("plan_events_malformed",),
}
RECEIVED = ("frames", "samples", "blocks", "samples_missing")
REJECTED = {  # the reasons of a finding
    "rejected-unsettled": ("too short", "still moving", "ringing", "drift"),
    "rejected-sensor": ("gap", "rail", "noisy", "no samples"),
    "rejected-out-of-range": ("out of travel", "out of range", "no stop pulses"),
    "rejected-clock": ("no clock", "clock"),
    "rejected-unlabelled": ("no plan match", "ambiguous"),
    "rejected-line": ("too long", "not along the line"),
}


def session_findings(document: Document) -> list[Finding]:
    """Return the findings: the verdict, what is in the session, warnings, notes."""
    return ordered(
        [
            _verdict(document),
            _recording(document),
            *_file(document),
            *_losses(document["losses"]),
            *_clock(document["clock"]),
            *_robot(document),
            *_rejected(document),
            *_passes(document["passes"]),
            *_notes(document),
        ],
        document["simulated"],
    )


def _verdict(document: Document) -> Finding:
    """Return whether the session gives observations, or why not."""
    dwells, passes = document["dwells"], document["passes"]
    robot = document["robot"]
    n_dwells = dwells["found"] - dwells["mountings"]
    values = {
        "observations": dwells["observations"],
        "dwells": n_dwells,
        "planned": document["plan_poses"],
        "points": passes["points"],
        "passes": passes["found"],
        "planned_passes": passes["planned"],
    }
    if dwells["observations"] or passes["points"]:
        return Finding("session-usable", values)
    if not document["streams"]:
        return Finding("no-box-data", {"problem": "sent no sample"})
    if not robot["readings"]:
        return Finding("no-joint-readings", {"bytes": robot["console_bytes"]})
    if not document["clock"]:
        return Finding("no-box-data", {"problem": "answered no clock request, so its samples have no time"})
    if not n_dwells and not passes["planned"]:
        return Finding("no-stops")
    if dwells["not_paired"]:
        return Finding("session-not-evaluated", {"dwells": n_dwells, "reason": dwells["not_paired"]})
    return Finding("no-observations", values)


def _recording(document: Document) -> Finding:
    streams = [f"{counted(stream['samples'], 'sample')} of {stream['name']}" for stream in document["streams"]]
    bounds = [report["bound_ns"] for report in document["clock"]]
    clock = _us(max(bounds, default=None))
    return stated("recording", document, document["robot"], streams=streams, clock=clock)


def _file(document: Document) -> Iterator[Finding]:
    """Return what is missing in the file, and where it comes from."""
    if document["truncated"]:
        yield Finding("session-incomplete")
    for damage in document["damage"]:
        yield damage_finding(damage)
    foreign = int(document["metadata"]["session-end"].get("robot_foreign", "0"))
    if foreign:
        yield Finding("foreign-datagrams", {"n": foreign})


def damage_finding(damage: Mapping[str, Any]) -> Finding:
    """Return a damaged place of a session file, which may be byte 0."""
    return Finding("session-damaged", {**damage, "headers": damage["at"] is None})


def _losses(losses: Document) -> Iterator[Finding]:
    """Return what did not arrive, by what to do about it, and all other counters."""
    counters, missing = {**losses["box"], **losses}, losses["samples_missing"]
    periods = [f"{gap['from_s']:.1f} to {gap['to_s']:.1f} s" for gap in losses["silences"] if missing]
    lost = []
    for code, names in LOSSES.items():
        counts: dict[str, Any] = {name: counters.pop(name, 0) for name in names}
        counts |= {"periods": periods, "missing": missing} if code == "lost-on-link" else {}
        lost += [Finding(code, counts)] if any(counts.values()) else []
    yield from lost
    further = {name: n for name, n in counters.items() if isinstance(n, int) and n and name not in RECEIVED}
    texts = [f"{n} {name.replace('_', ' ')}" for name, n in further.items()]
    yield stated("received", losses, complete=not lost, counts=texts)


def _clock(reports: Iterable[Document]) -> Iterator[Finding]:
    for report in reports:
        offset, rate = NS.to_si(report["offset_ns"]), faster(report["rate_ppm"], 3)
        yield stated("box-clock", _in_us(report), offset=offset, rate=rate)
        for change in report["changes"]:
            begin, end = (US.to_si(stamp) for stamp in change["device_us"])
            yield Finding("clock-stepped", {"change": _us(change["by_ns"]), "begin": begin, "end": end})


def _robot(document: Document) -> Iterator[Finding]:
    robot = document["robot"]
    if not robot["readings"]:
        return
    counts = {name: robot[name] for name in ("lost", "gaps", "malformed", "restarts")}
    code = "joint-readings-lost" if any(counts.values()) else "joint-readings"
    yield stated(code, robot, **counts, rate_hz=robot["rate_hz"])
    for report in () if document["metadata"]["joints-added"] else robot["clock"]:
        if report["edges"] is not None:
            yield _edges(report["edges"])
        yield stated("robot-clock", _in_us(report), rate=faster(report["rate_ppm"], 3))


def _edges(edges: Document) -> Finding:
    if not edges["used"]:
        return Finding("trigger-unseen", {name: value for name, value in edges.items() if not name.endswith("_ns")})
    least, most = map(_us, edges["falling_later_ns"])
    return stated("trigger", _in_us(edges), least=least, most=most, arrivals=not edges["in_use"])


def _rejected(document: Document) -> Iterator[Finding]:
    """Return which dwells and passes were rejected, by reason."""
    dwells, passes = dict(document["dwells"]["rejected"]), document["passes"]["rejected"]
    dwells.pop(MOUNTING, None)
    needed = sum(dwells.pop(reason, 0) for reason in NEED_DECISION)
    if needed:
        session, n_dwells = document["file"], document["dwells"]["found"]
        yield Finding("doubtful-dwells", {"session": session, "n": needed, "dwells": n_dwells, "path": [session]})
    if document["plan_poses"] and (off_plan := dwells.pop("no plan match", 0)):
        yield Finding("rejected-off-plan", {"rejected": counted(off_plan, "dwell")})
    for code, reasons in REJECTED.items():
        rejected = [f"{counted(dwells[reason], 'dwell')} ({reason})" for reason in reasons if reason in dwells]
        rejected += [
            f"{counted(passes[reason], 'pass', 'passes')} ({reason})" for reason in reasons if reason in passes
        ]
        if rejected:
            yield Finding(code, {"rejected": rejected})


def _passes(passes: Document) -> Iterator[Finding]:
    good = [row for row in passes["table"] if not row["reason"]]
    if good:
        late_s = max(row["time_sigma_s"] for row in good)
        values = {
            "window": {"s": max(row["window_s"] for row in good)},
            "time": {"us": US.of(late_s)},
            "distance": {"um": UM.of(max(row["time_sigma_s"] * row["speed_m_s"] for row in good))},
        }
        yield Finding("pass-timing", values)


def _notes(document: Document) -> Iterator[Finding]:
    """Return what made the session, what it holds besides, and the temperature."""
    metadata, dwells = document["metadata"], document["dwells"]
    degc = document["temperature_degc"]
    read = [("box", degc["box"]), *((one_line(name) or "unnamed", ends) for name, ends in degc["thermometers"].items())]
    ranges = [f"{name} {ends[0]:.1f} to {ends[1]:.1f} °C" for name, ends in read if ends is not None]
    session, recovered, added = metadata["session"], metadata["recovered"] or {}, metadata["joints-added"] or {}
    values = {
        "version": session.get("version"),
        "clock": session.get("clock"),
        "firmware": document["firmware"],
        "attached": document["attachments"],
        "recovered": recovered.get("source"),
        "lost": recovered.get("messages_lost", "?"),
        "joints": added.get("source"),
        "time": added.get("time", "?"),
        "ranges": ranges,
    }
    yield Finding("session-made", values)
    settling = sorted(row["settling_s"] for row in dwells["table"] if not row["reason"])
    values = {"stops": dwells["mountings"], "events": [f"{n} {kind}" for kind, n in document["events"].items()]}
    if settling:
        values |= {"median": {"s": settling[len(settling) // 2]}, "longest": {"s": settling[-1]}}
    yield Finding("stops", {"median": None, **values})


def _in_us(entry: Document) -> dict[str, Any]:
    """Return an entry with its times in µs instead of ns."""
    times = [name for name, time in entry.items() if name.endswith("_ns") and isinstance(time, float | int)]
    converted = {f"{name[:-2]}us": US.of(NS.to_si(entry[name])) for name in times}
    return converted | {name: value for name, value in entry.items() if name not in times}


def _us(time_ns: float | None) -> dict[str, float] | None:
    return None if time_ns is None else {"us": US.of(NS.to_si(time_ns))}
