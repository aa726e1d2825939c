"""Which bar, chuck and sphere a dwell belongs to: by the plan, or by what was said to be mounted (hop 5).

A robot follows its plan in order, but a pose may be left out, visited twice, or stopped at in between, and the program may be
stopped and begun again. The pairing is therefore a way through the plan: (dwell, pose) pairs that are near in joint space,
each dwell in one of them. It gains 1 for every pair and pays REPEAT for standing at the pose before once more and BACK for
going back in the plan; of ways that are worth the same, the one with the smaller distances. Going on costs nothing, however
many poses are left out. So one stop that happens to lie near an earlier pose is no restart, two in a row are. The best way
is found dwell by dwell, the best that ends before a pose by a Fenwick tree: O(k log k) for k near pairs.

A plan may hold the same joint pose twice with different fittings. Where dwells are missing, several ways are then worth the
same, and nothing says which of them the robot took: a dwell to which such ways give different bars, chucks or spheres
is **ambiguous**. A pair lies on a best way exactly if the best way that ends at it and the best that begins at it, less the
pair that they share, are worth that much. Distances do not decide here: a robot that misses its poses by a little more on one
side would be given another bar.

Lines: which leg was which line: by the plan, or by what was said to be mounted (hop 5).
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np

from truearm.errors import RigError
from truearm.session.joint_readings import MAX_JOINTS
from truearm.session.line_passes import LONGEST_S, Leg, Pass
from truearm.types import BAR_MOUNTED, LINE_MOUNTED, Floats, Move, Rig

NAMED = (*BAR_MOUNTED, *LINE_MOUNTED)
FITTINGS = (*NAMED, "shell")
MAX_NAME = 64
REPEAT = 0.25
BACK = 1.125
WIDER = 1.0 + 1e-9  # than the tolerance: rounding must not cost a pose that is just within it


@dataclass(frozen=True)
class Plan:
    """The poses at which the ball-bar is read, or the ends of lines, in their order: q (p, j) and what is mounted at each."""

    q: Floats
    mounted: tuple[dict[str, str], ...]


class Row(NamedTuple):
    """A row of the plan as ``/plan`` has it (``types.Plan``)."""

    q: list[float]
    mounted: dict[str, str]  # of FITTINGS
    move: str


@dataclass
class Marks:
    """Gathers what ``/plan`` and ``/events`` say."""

    rows: list[Row] = field(default_factory=list)
    mountings: list[tuple[int, dict[str, str]]] = field(default_factory=list)  # (t_host_ns, what)
    kinds: dict[str, int] = field(default_factory=dict)
    malformed: int = 0

    def feed(self, topic: str, t_host_ns: int, data: bytes) -> None:
        """Take one message of either topic; others are ignored."""
        if topic not in ("/plan", "/events"):
            return
        document = _document(data)
        if document is None:
            self.malformed += 1
        elif topic == "/plan":
            self._plan(document)
        else:
            kind = document.get("kind")
            if isinstance(kind, str) and (kind in self.kinds or len(self.kinds) < 100):
                self.kinds[kind] = self.kinds.get(kind, 0) + 1
            if kind == "mounted":
                self.mountings.append((t_host_ns, _fittings(document)))

    def _plan(self, document: Mapping[str, Any]) -> None:
        q = document.get("q")
        numbers = isinstance(q, list) and 1 <= len(q) <= MAX_JOINTS
        numbers = numbers and all(type(value) in (int, float) and abs(value) < 1e6 for value in q or [])
        move = document.get("move", Move.DWELL)
        if not numbers or move not in tuple(Move) or (self.rows and len(self.rows[0].q) != len(q or [])):
            self.malformed += 1
            return
        self.rows.append(Row([float(value) for value in q or []], _fittings(document), move))

    @property
    def dwells(self) -> list[int]:
        """The rows at which the ball-bar is read."""
        return [number for number, row in enumerate(self.rows) if row.move == Move.DWELL]

    def plan(self) -> Plan | None:
        """The poses of ``dwells``, None without any."""
        poses = [self.rows[number] for number in self.dwells]
        if not poses:
            return None
        return Plan(np.array([row.q for row in poses]), tuple(row.mounted for row in poses))

    @property
    def names_lines(self) -> bool:
        """Whether a line was planned or said to be mounted."""
        return any(row.move == Move.LINE for row in self.rows) or any("line" in said for _, said in self.mountings)

    def mounted_at(self, t_host_ns: int) -> dict[str, str]:
        """What was said to be mounted at a time; empty before the first word."""
        times = [t for t, _ in self.mountings]
        index = int(np.searchsorted(np.array(times, dtype=np.int64), t_host_ns, side="right"))
        return self.mountings[index - 1][1] if index else {}


@dataclass(frozen=True)
class Matches:
    """The planned pose of each dwell, None where there is none, and the fittings ("b46 c1 s1") that suit a dwell equally
    well where they differ."""

    poses: tuple[int | None, ...]
    ambiguous: Mapping[int, tuple[str, ...]]


class _Pair(NamedTuple):
    """A dwell near a planned pose; ``closeness`` is 0 to 1, and so small that all of them together are less than REPEAT."""

    dwell: int
    pose: int
    closeness: float


def match_plan(q: Floats, plan: Plan, tolerance: float, said: Sequence[Mapping[str, str]]) -> Matches:
    """Which planned pose each dwell is.

    ``q`` (d, j): mean readings in order; ``tolerance`` [rad or m] holds for every joint; ``said``: what events said to be
    mounted at each dwell, which a pose must not contradict.
    """
    pairs = _near_pairs(q, plan, tolerance, said)
    matched: list[int | None] = [None] * len(q)
    worth, before = _ways(pairs, [pair.closeness for pair in pairs], len(plan.q))
    k = max(range(len(pairs)), key=worth.__getitem__, default=-1)
    while k >= 0:
        matched[pairs[k].dwell] = pairs[k].pose
        k = before[k]
    return Matches(tuple(matched), _ambiguous(pairs, plan))


def nearest_pose(q: Floats, plan: Plan) -> tuple[int, float]:
    """The planned pose nearest to one mean reading (j,), and its distance in the joint that is furthest off."""
    if q.shape[0] != plan.q.shape[1]:
        return -1, float("nan")
    distance = np.max(np.abs(plan.q - q), axis=1)
    return int(np.argmin(distance)), float(np.min(distance))


def _near_pairs(q: Floats, plan: Plan, tolerance: float, said: Sequence[Mapping[str, str]]) -> list[_Pair]:
    """Near pairs by dwell, then by pose."""
    if not len(q) or q.shape[1] != plan.q.shape[1]:
        return []
    order = np.argsort(plan.q[:, 0])
    first, last = (
        np.searchsorted(plan.q[order, 0], q[:, 0] + side) for side in (-WIDER * tolerance, WIDER * tolerance)
    )
    scale = REPEAT / (tolerance * (len(q) + 1))
    pairs = []
    for dwell in range(len(q)):
        poses = np.sort(order[first[dwell] : last[dwell]])
        away = np.max(np.abs(plan.q[poses] - q[dwell]), axis=1, initial=0.0)
        for pose, distance in zip(poses.tolist(), away.tolist(), strict=True):
            if distance <= tolerance and not contradict(said[dwell], plan.mounted[pose]):
                pairs.append(_Pair(dwell, pose, scale * (tolerance - distance)))
    return pairs


def contradict(said: Mapping[str, str], planned: Mapping[str, str]) -> bool:
    """Whether what was said to be mounted is not what the plan has."""
    return any(said.get(key) and planned.get(key) and said[key] != planned[key] for key in NAMED)


def _ways(pairs: Sequence[_Pair], closeness: Sequence[float], poses: int) -> tuple[list[float], list[int]]:
    """What the best way that ends at each pair is worth, and the pair before it on that way, -1 for none."""
    nothing = (0.0, -1)
    tree = [nothing] * (poses + 1)  # of the best ways that end before a pose
    at: dict[int, tuple[float, int]] = {}  # the best way that ends at a pose
    best = nothing
    worth: list[float] = []
    before: list[int] = []
    for _, group in groupby(enumerate(pairs), key=lambda numbered: numbered[1].dwell):
        of_dwell = [(k, pair.pose) for k, pair in group]
        for k, pose in of_dwell:
            coming, i = nothing, pose
            while i > 0:
                coming, i = max(coming, tree[i]), i & (i - 1)
            again = at.get(pose, nothing)
            coming = max(coming, (again[0] - REPEAT, again[1]), (best[0] - BACK, best[1]))
            worth.append(coming[0] + 1.0 + closeness[k])
            before.append(coming[1])
        for k, pose in of_dwell:  # only now: a dwell is in one pair
            way = (worth[k], k)
            best, at[pose] = max(best, way), max(at.get(pose, nothing), way)
            i = pose + 1
            while i <= poses:
                tree[i], i = max(tree[i], way), i + (i & -i)
    return worth, before


def _ambiguous(pairs: list[_Pair], plan: Plan) -> dict[int, tuple[str, ...]]:
    """The dwells to which ways of the greatest worth give different fittings, and those."""
    poses = len(plan.q)
    exact = [0.0] * len(pairs)  # eighths: sums of them are exact
    ending, _ = _ways(pairs, exact, poses)
    backward = [_Pair(pair.dwell, poses - 1 - pair.pose, 0.0) for pair in reversed(pairs)]
    beginning = _ways(backward, exact, poses)[0][::-1]
    greatest = max(ending, default=0.0)
    keys = [key for key in NAMED if any(mounted.get(key) for mounted in plan.mounted)]
    suits: dict[int, dict[str, None]] = {}
    for pair, end, begin in zip(pairs, ending, beginning, strict=True):
        if end + begin - 1.0 == greatest:
            fittings = " ".join(plan.mounted[pair.pose].get(key) or "?" for key in keys)
            suits.setdefault(pair.dwell, {})[fittings] = None
    return {dwell: tuple(fittings) for dwell, fittings in suits.items() if len(fittings) > 1}


def _document(data: bytes) -> dict[str, Any] | None:
    try:
        document = json.loads(data)
    except (ValueError, RecursionError):
        return None
    return document if isinstance(document, dict) else None


def _fittings(document: Mapping[str, Any]) -> dict[str, str]:
    named = {key: document.get(key) for key in FITTINGS}
    return {key: str(value)[:MAX_NAME] for key, value in named.items() if isinstance(value, str) and value}


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
