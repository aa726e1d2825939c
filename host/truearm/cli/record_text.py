"""What ``truearm record`` prints when a recording has ended, as JSON and as findings."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

from truearm.findings import Finding, entries
from truearm.record.status import Counters
from truearm.text import counted
from truearm.workflows.record import Recorded

DISTURBANCES = {  # counters of what a recording survives
    "restarts": ("restart of the box", "restarts of the box"),
    "link_losses": ("loss of the link to the box", "losses of the link to the box"),
    "robot_losses": ("loss of the robot", "losses of the robot"),
    "robot_other_joints": ("reading of another number of joints", "readings of another number of joints"),
    "robot_foreign": ("datagram from another address, not stored", "datagrams from other addresses, not stored"),
    "held_up": ("delay of the storing", "delays of the storing"),
}


def document(recorded: Recorded) -> dict[str, Any]:
    """Return a recording as JSON; ``dwells`` is None where it has no robot or no rig with a ball-bar."""
    summary = recorded.summary
    return {
        "out": str(recorded.out) if recorded.kept else None,
        "duration_s": summary.duration_s,
        "ended": summary.reason,
        "why": summary.text,
        "counters": asdict(summary.counters),
        "faults": summary.faults,
        "dwells": None if recorded.dwells is None else asdict(recorded.dwells),
        "missing": recorded.missing,
        "findings": entries(_findings(recorded)) if recorded.kept else [],
    }


def _findings(recorded: Recorded) -> Iterator[Finding]:
    """Return what is in the file and why the recording ended, then what it survived."""
    summary, dwells = recorded.summary, recorded.dwells
    values: dict[str, Any] = {
        "file": str(recorded.out),
        "duration": {"s": summary.duration_s},
        "samples": summary.counters.samples,
        "lost": summary.counters.lost_frames,
        "readings": summary.counters.robot_lines,
        "dwells": dwells.dwells if dwells else 0,
        "ended": summary.reason,
        "why": summary.text if summary.reason == "robot closed" else "",
    }
    if dwells:
        unusable = [f"{n} {reason}" for reason, n in dwells.unusable.items()]
        values |= {"usable": str(dwells.usable), "need_decision": dwells.need_decision, "unusable": unusable}
    yield Finding("recorded", values)
    events = [*_events(summary.counters), *summary.faults]
    if events:
        counts = {name: getattr(summary.counters, name) for name in DISTURBANCES}
        yield Finding("recording-disturbed", {"events": events, **counts})


def _events(counters: Counters) -> Iterator[str]:
    for name, words in DISTURBANCES.items():
        if n := getattr(counters, name):
            yield counted(n, *words)
    if counters.robot_missing or counters.robot_dropped or counters.robot_unstored:
        yield "the robot sent more than could be stored"
    elif counters.robot_held_up:
        yield "the robot sent faster than could be stored for a time; no reading is missing"
