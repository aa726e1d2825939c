"""The findings of a session, from the content of ``truearm inspect --json``: whether it is usable, and what went wrong."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from truearm.findings import Finding, ordered
from truearm.text import counted, faster, one_line
from truearm.types import MOUNTING, NEED_DECISION
from truearm.units import NS, UM, US

Document = Mapping[str, Any]

LOSSES = {  # the counters of a finding
    "lost-in-box": ("samples_overrun", "overruns", "dropped"),
    "box-faults": ("converter_faults", "crc_errors", "converter_resets", "thermometer_errors", "restarts"),
    "missing-stop-pulses": ("missing_stops",),
}
RECEIVED = ("frames", "samples", "blocks")
REJECTED = {  # the reasons of a finding
    "rejected-unsettled": ("too short", "still moving", "ringing", "drift"),
    "rejected-sensor": ("gap", "rail", "noisy", "no samples"),
    "rejected-out-of-range": ("out of travel", "out of range", "no stop pulses"),
    "rejected-clock": ("no clock", "clock"),
    "rejected-unlabelled": ("no plan match", "ambiguous"),
    "rejected-line": ("too long", "not along the line"),
}
UNUSED_EDGES = ("unseen", "unclear", "rejected", "stray")


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
        return Finding("session-usable", values | {"both": bool(dwells["observations"] and passes["points"])})
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
    robot, bounds = document["robot"], [report["bound_ns"] for report in document["clock"]]
    return Finding(
        "recording",
        {
            "file": document["file"],
            "duration": {"s": document["duration_s"]},
            "streams": [
                f"{counted(stream['samples'], 'sample')} of {stream['name']}" for stream in document["streams"]
            ],
            "readings": robot["readings"],
            "clock": _us(max(bounds, default=None)),
        },
    )


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
    counters = {**losses["box"], **losses}
    names = {"lost-on-link": ("frames_lost", "samples_lost"), **LOSSES}
    values: dict[str, dict[str, Any]] = {code: {name: counters.get(name, 0) for name in names[code]} for code in names}
    missing = losses["samples_missing"]
    periods = [f"{gap['from_s']:.1f} to {gap['to_s']:.1f} s" for gap in losses["silences"] if missing]
    values["lost-on-link"] |= {"periods": periods, "missing": missing}
    findings = [Finding(code, counts) for code, counts in values.items() if any(counts.values())]
    yield from findings
    named = {name for counts in values.values() for name in counts} | {"samples_missing", *RECEIVED}
    further_counts = [
        f"{count} {name.replace('_', ' ')}"
        for name, count in counters.items()
        if name not in named and isinstance(count, int) and count
    ]
    received = {name: losses[name] for name in RECEIVED}
    yield Finding("received", {**received, "complete": not findings, "counts": further_counts})


def _clock(reports: Iterable[Document]) -> Iterator[Finding]:
    for report in reports:
        yield Finding(
            "box-clock",
            {
                "segment": report["segment"],
                "offset": NS.to_si(report["offset_ns"]),
                "rate": faster(report["rate_ppm"], 3),
                **{name: _us(report[f"{name}_ns"]) for name in ("bound", "half_asymmetry", "rtt_min", "rtt_median")},
                **{name: report[name] for name in ("exchanges", "rejected")},
            },
        )
        for change in report["changes"]:
            begin, end = (US.to_si(stamp) for stamp in change["device_us"])
            yield Finding("clock-stepped", {"change": _us(change["by_ns"]), "begin": begin, "end": end})


def _robot(document: Document) -> Iterator[Finding]:
    robot = document["robot"]
    if not robot["readings"]:
        return
    names = ("readings", "joints", "rate_hz", "lost", "gaps", "late", "duplicated", "malformed", "restarts")
    values = {name: robot[name] for name in names}
    is_bad = any(robot[name] for name in ("lost", "gaps", "malformed", "restarts"))
    yield Finding("joint-readings-lost" if is_bad else "joint-readings", values)
    for report in () if document["metadata"]["joints-added"] else robot["clock"]:
        if report["edges"] is not None:
            yield from _edges(report["edges"])
        yield Finding("robot-clock", {"rate": faster(report["rate_ppm"], 3), "jitter": _us(report["jitter_ns"])})


def _edges(edges: Document) -> Iterator[Finding]:
    names = ("edges", "used", "input", "in_use", "inverted", *UNUSED_EDGES)
    values: dict[str, Any] = {name: edges[name] for name in names}
    if not edges["used"]:
        yield Finding("trigger-unseen", values)
        return
    low, high = edges["falling_later_ns"]
    values |= {name: _us(edges[f"{name}_ns"]) for name in ("to_box", "bound", "shortest_latency")}
    values |= {"least": _us(low), "most": _us(high), "arrivals": not edges["in_use"]}
    yield Finding("trigger", values)


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


def _us(time_ns: float | None) -> dict[str, float] | None:
    return None if time_ns is None else {"us": US.of(NS.to_si(time_ns))}
