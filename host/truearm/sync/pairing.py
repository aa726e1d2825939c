"""Which bar, chuck and sphere a dwell belongs to: by the plan, or by what was said to be mounted (hop 5).

A robot follows its plan in order, but a pose may be left out, visited twice, or stopped at in between. The pairing is
therefore the longest chain of (dwell, pose) pairs that are near in joint space and ascend in both; of chains as long, the
one with the smaller distances. It is found as a longest increasing subsequence with weights, in O(k log k) for k near pairs.

A plan may hold the same joint pose twice with different fittings. Where dwells are missing, several chains are then as
long, and nothing says which of them the robot took: a dwell to which such chains give different bars, chucks or spheres
is **ambiguous**. A pair lies on a chain of the greatest length exactly if the longest chain that ends at it and the longest
that begins at it, less the pair that they share, make that length. Distances do not decide here: a robot that misses its
poses by a little more on one side would be given another bar.
"""

from __future__ import annotations

import json
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import KDTree

from truearm.sensors.joints import MAX_JOINTS
from truearm.types import Floats
from truearm.types import Plan as PlanFile

FITTINGS = ("bar", "chuck", "sphere", "shell")
REQUIRED = ("bar", "chuck", "sphere")  # what an observation of the ball-bar must name
MOVES = PlanFile.MOVES
MAX_NAME = 64


@dataclass(frozen=True)
class Plan:
    """The poses at which the ball-bar is read, in their order: q (p, j) and what is mounted at each."""

    q: Floats
    mounted: tuple[dict[str, str], ...]


class Row(NamedTuple):
    """A row of the plan as ``/plan`` has it (``types.Plan``)."""

    q: list[float]
    mounted: dict[str, str]  # of FITTINGS
    move: str
    line: str
    target: str


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
        move = document.get("move", "dwell")
        if not numbers or move not in MOVES or (self.rows and len(self.rows[0].q) != len(q or [])):
            self.malformed += 1
            return
        line, target = (_named(document, key) for key in ("line", "target"))
        self.rows.append(Row([float(value) for value in q or []], _fittings(document), move, line, target))

    @property
    def dwells(self) -> list[int]:
        """The rows at which the ball-bar is read."""
        return [number for number, row in enumerate(self.rows) if row.move == "dwell"]

    def plan(self) -> Plan | None:
        """The poses of ``dwells``, None without any."""
        poses = [self.rows[number] for number in self.dwells]
        if not poses:
            return None
        return Plan(np.array([row.q for row in poses]), tuple(row.mounted for row in poses))

    def mounted_at(self, t_host_ns: int) -> dict[str, str]:
        """What was said to be mounted at a time; empty before the first word."""
        times = [t for t, _ in self.mountings]
        index = int(np.searchsorted(np.array(times, dtype=np.int64), t_host_ns, side="right"))
        return self.mountings[index - 1][1] if index else {}


@dataclass(frozen=True)
class Matches:
    """The planned pose of each dwell, None where there is none, and the dwells that different fittings suit as well."""

    poses: tuple[int | None, ...]
    ambiguous: frozenset[int]


def match_plan(q: Floats, plan: Plan, tolerance: float, said: Sequence[Mapping[str, str]]) -> Matches:
    """Which planned pose each dwell is.

    ``q`` (d, j): mean readings in order; ``tolerance`` [rad or m] holds for every joint; ``said``: what events said to be
    mounted at each dwell, which a pose must not contradict.
    """
    pairs = _near_pairs(q, plan, tolerance, said)
    matched: list[int | None] = [None] * len(q)
    for dwell, pose in _best_chain(pairs, len(plan.q)):
        matched[dwell] = pose
    return Matches(tuple(matched), _ambiguous(pairs, plan))


def _near_pairs(
    q: Floats, plan: Plan, tolerance: float, said: Sequence[Mapping[str, str]]
) -> list[tuple[int, int, float]]:
    """(dwell, pose, weight) of near pairs, by dwell; the poses of one dwell descend, so that a chain takes one of them.

    A pair weighs 1 less its distance, scaled so that all distances together are less than one pair.
    """
    if not len(q) or q.shape[1] != plan.q.shape[1]:
        return []
    near = KDTree(plan.q).query_ball_point(q, tolerance, p=np.inf)
    scale = 1.0 / (tolerance * (len(q) + 1))
    return [
        (dwell, pose, 1.0 - scale * float(np.max(np.abs(q[dwell] - plan.q[pose]))))
        for dwell, poses in enumerate(near)
        for pose in sorted(poses, reverse=True)
        if not _contradict(said[dwell], plan.mounted[pose])
    ]


def _contradict(said: Mapping[str, str], planned: Mapping[str, str]) -> bool:
    return any(said.get(key) and planned.get(key) and said[key] != planned[key] for key in REQUIRED)


def _best_chain(pairs: list[tuple[int, int, float]], poses: int) -> list[tuple[int, int]]:
    """The heaviest chain of pairs that ascends in both; a Fenwick tree holds the heaviest that ends at or before a pose."""
    tree = [(0.0, -1)] * (poses + 1)
    weights, before = [], []
    for k, (_, pose, weight) in enumerate(pairs):
        best, i = (0.0, -1), pose
        while i > 0:
            best, i = max(best, tree[i]), i & (i - 1)
        weights.append(best[0] + weight)
        before.append(best[1])
        i = pose + 1
        while i <= poses:
            tree[i], i = max(tree[i], (weights[k], k)), i + (i & -i)
    chain, k = [], max(range(len(pairs)), key=weights.__getitem__, default=-1)
    while k >= 0:
        chain.append(pairs[k][:2])
        k = before[k]
    return chain[::-1]


def _ambiguous(pairs: list[tuple[int, int, float]], plan: Plan) -> frozenset[int]:
    """The dwells to which the longest chains give different fittings."""
    poses = len(plan.q)
    ending = _chain_lengths([pose for _, pose, _ in pairs])
    beginning = _chain_lengths([poses - 1 - pose for _, pose, _ in reversed(pairs)])[::-1]
    longest = max(ending, default=0)
    first: dict[int, tuple[str | None, ...]] = {}
    ambiguous = set()
    for (dwell, pose, _), end, begin in zip(pairs, ending, beginning, strict=True):
        if end + begin - 1 == longest:
            fittings = tuple(plan.mounted[pose].get(key) for key in REQUIRED)
            if first.setdefault(dwell, fittings) != fittings:
                ambiguous.add(dwell)
    return frozenset(ambiguous)


def _chain_lengths(poses: list[int]) -> list[int]:
    """Length of the longest ascending chain that ends at each of these poses (patience sorting)."""
    least: list[int] = []  # least last pose of the chains of length k + 1
    lengths = []
    for pose in poses:
        k = bisect_left(least, pose)
        least[k : k + 1] = [pose]
        lengths.append(k + 1)
    return lengths


def _document(data: bytes) -> dict[str, Any] | None:
    try:
        document = json.loads(data)
    except (ValueError, RecursionError):
        return None
    return document if isinstance(document, dict) else None


def _fittings(document: Mapping[str, Any]) -> dict[str, str]:
    named = {key: _named(document, key) for key in FITTINGS}
    return {key: value for key, value in named.items() if value}


def _named(document: Mapping[str, Any], key: str) -> str:
    value = document.get(key)
    return value[:MAX_NAME] if isinstance(value, str) else ""
