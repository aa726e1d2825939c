"""Which leg was which line: by the plan, or by what was said to be mounted (hop 5)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from truearm.errors import RigError
from truearm.session.dwell_pairing import Marks, Plan, match_plan
from truearm.session.legs import Leg
from truearm.session.line_passes import LONGEST_S, Pass
from truearm.types import LINE_MOUNTED, Move, Rig


def passes_of(legs: Sequence[Leg], marks: Marks, rig: Rig, tolerance: float) -> list[Pass]:
    """The legs that may be lines, in order; what already rules one out is its reason.

    With lines in the plan a leg is one that goes from the row before to the line's own, in the order of the plan; without, one
    during which a line was mounted all the time. Of a leg that is none of the plan's, with a line mounted, the device will
    say whether the magnet moved along it. Raises RigError where a line or target is not in the rig.
    """
    said = [_mounted(marks, leg) for leg in legs]
    plan, rows = planned_lines(marks)
    if plan is None:
        found = [Pass(leg, words) for leg, words in zip(legs, said, strict=True) if "line" in words]
    else:
        found = _matched(legs, plan, rows, tolerance, said)
    for one in found:
        _check_rig(one.mounted, rig)
    return [replace(one, reason="too long") if _too_long(one.leg) else one for one in found]


def planned_lines(marks: Marks) -> tuple[Plan | None, list[int]]:
    """The lines of the plan, q (p, 2j) being the joints at both ends, and their rows; None without any."""
    rows = [k for k, row in enumerate(marks.rows) if row.move == Move.LINE and k > 0 and "line" in row.mounted]
    if not rows:
        return None, rows
    ends = np.array([[*marks.rows[k - 1].q, *marks.rows[k].q] for k in rows])
    return Plan(ends, tuple({key: marks.rows[k].mounted.get(key, "") for key in LINE_MOUNTED} for k in rows)), rows


def _matched(
    legs: Sequence[Leg], plan: Plan, rows: list[int], tolerance: float, said: Sequence[Mapping[str, str]]
) -> list[Pass]:
    ends = np.array([np.concatenate([leg.q_start, leg.q_end]) for leg in legs]).reshape(len(legs), -1)
    matches = match_plan(ends, plan, tolerance, said)
    found = []
    for k, (leg, pose, words) in enumerate(zip(legs, matches.poses, said, strict=True)):
        if pose is not None:
            found.append(Pass(leg, plan.mounted[pose], "ambiguous" * (k in matches.ambiguous), rows[pose]))
        elif "line" in words:
            found.append(Pass(leg, dict(words), "gap" if leg.cut else "no plan match"))
    return found


def _too_long(leg: Leg) -> bool:
    return leg.end_s - leg.start_s > LONGEST_S


def _mounted(marks: Marks, leg: Leg) -> dict[str, str]:
    """What was said to be mounted during all of a leg; empty where that changed."""
    first, last = (marks.mounted_at(t) for t in (leg.start_host_ns, leg.end_host_ns))
    return first if first == last else {}


def _check_rig(mounted: Mapping[str, str], rig: Rig) -> None:
    for key, names in (("line", rig.lines), ("target", rig.targets)):
        as_they_come = key == "line" and not names  # a rig that lists no lines takes any
        if mounted.get(key) and mounted[key] not in names and not as_they_come:
            have = ", ".join(sorted(names)) or "none"
            raise RigError(f"the session names {key} {mounted[key]!r}, which the rig does not have (it has {have})")
