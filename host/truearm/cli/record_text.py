"""What ``truearm record`` prints when a recording has ended."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from truearm.record.status import RecordSummary
from truearm.text import counted
from truearm.units import S
from truearm.workflows.record import Recorded


def lines(recorded: Recorded) -> list[str]:
    """What is in the file, why the recording ended, and what went wrong; nothing where no file was kept."""
    summary, out = recorded.summary, recorded.out
    if not recorded.kept:
        return []
    why = f" ({summary.text})" if summary.reason == "robot closed" else ""
    dwells = [f"{out}: {recorded.dwells.sentence}"] if recorded.dwells is not None and recorded.dwells.dwells else []
    text = [f"{out}: {_totals(summary)}; ended: {summary.reason}{why}"]
    return [*text, *dwells, *(f"{out}: {fault}" for fault in summary.faults)]


def _totals(summary: RecordSummary) -> str:
    counters = summary.counters
    parts = [
        f"{summary.duration_s:.1f} s",
        f"{counted(counters.samples, 'sample')}",
        f"{counted(counters.lost_frames, 'frame')} lost",
    ]
    if counters.robot_lines or counters.robot_console_bytes:
        parts.append(counted(counters.robot_lines, "robot message"))
    if counters.robot_other_joints:
        parts.append(f"{counters.robot_other_joints} malformed (another number of joints than the first)")
    if counters.robot_foreign:
        parts.append(f"{counted(counters.robot_foreign, 'datagram')} from other addresses not stored")
    if counters.restarts:
        parts.append(counted(counters.restarts, "box restart"))
    if counters.link_losses:
        parts.append(f"link lost {counted(counters.link_losses, 'time')}")
    if counters.robot_losses:
        parts.append(f"robot lost {counted(counters.robot_losses, 'time')}")
    if counters.robot_missing or counters.robot_dropped or counters.robot_unstored:
        parts.append("the robot sent more than could be stored")
    elif counters.robot_held_up:
        parts.append(f"the robot's readings came up to {S.text(counters.robot_late_s, '.1f')} late; none is missing")
    if counters.held_up:
        parts.append(f"storing fell behind {counted(counters.held_up, 'time')}")
    return ", ".join(parts)


def document(recorded: Recorded) -> dict[str, Any]:
    """The same as JSON; ``dwells`` is None where the recording has no robot or no rig with a ball-bar."""
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
    }
