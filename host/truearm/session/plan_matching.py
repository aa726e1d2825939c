"""Assign bar, chuck and sphere to each dwell, by the plan or by what was said to be mounted; lines to legs likewise.

A robot follows its plan in order. A pose may be left out, visited twice or stopped at in between, and the program may
begin again. The assignment is a path through the plan: (dwell, pose) pairs that are near in joint space. Each pair
gains 1. Staying at the previous pose costs REPEAT, going back costs BACK: one stop near an earlier pose is no restart,
two in a row are. Among paths of equal value, the nearer one is chosen.

A plan may contain the same pose with different fittings. A dwell to which paths of the highest value assign different
fittings is **ambiguous**. Distances do not decide here.
"""

from __future__ import annotations

import math
from bisect import bisect_right, insort
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import groupby, pairwise
from operator import itemgetter
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import msgspec
import numpy as np
from msgspec import Meta, Struct

from truearm.disk import read_text, sha256, write_atomic
from truearm.errors import Argument, RigError, SessionError
from truearm.schema import NAME
from truearm.session.dwells import POSE_TOLERANCE, Dwell
from truearm.session.joint_format import Joints
from truearm.session.line_passes import LONGEST_S, Leg, LinePass
from truearm.text import number_or_null, strict_json
from truearm.types import BAR_MOUNTED, LINE_MOUNTED, MOUNTED, MOUNTING, DwellLabel, Floats, Move, Plan, Rig

FITTINGS = (*MOUNTED, "shell")
MAX_NAME = 64
MAX_KINDS = 100  # of events
REPEAT = 0.25
BACK = 1.125


@dataclass(frozen=True)
class PlannedPoses:
    """The poses at which the ball-bar is read, or the ends of lines, in order.

    ``q`` (p, j), of a line the joints at both ends. ``mounted``: what is mounted at each. ``rows``: its row in the
    plan.
    """

    q: Floats
    mounted: tuple[dict[str, str], ...]
    rows: tuple[int, ...] = ()


class PlanRow(NamedTuple):
    """A row of the plan as in ``/plan`` (``types.Plan``).

    ``number``: its place, also behind rows that cannot be used.
    """

    number: int
    q: list[float]
    mounted: dict[str, str]  # of FITTINGS
    move: str


_NAMES = [(key, str | None, None) for key in FITTINGS]
_ROW: Any = msgspec.defstruct("_Row", [("q", Joints), ("move", Move, Move.DWELL), *_NAMES])
_EVENT: Any = msgspec.defstruct("_Event", [("kind", str), *_NAMES])


def read_mark(topic: str, data: bytes) -> Any | None:
    """Return a row of the plan or an event, with FITTINGS; None if it is malformed."""
    try:
        return msgspec.json.decode(data.decode(), type=_ROW if topic == "/plan" else _EVENT)
    except (ValueError, RecursionError):
        return None


@dataclass
class Marks:
    """Collects the contents of ``/plan`` and ``/events``. ``malformed``: messages that cannot be used."""

    rows: list[PlanRow] = field(default_factory=list)
    planned: int = 0  # rows of the plan so far, with malformed ones
    mountings: list[tuple[int, dict[str, str]]] = field(default_factory=list)  # (t_host_ns, what)
    kinds: Counter[str] = field(default_factory=Counter)
    malformed: int = 0

    def feed(self, topic: str, t_host_ns: int, data: bytes) -> None:
        """Take one message of either topic."""
        mark, number = read_mark(topic, data), self.planned
        self.planned += topic == "/plan"
        if mark is None or (topic == "/plan" and len(mark.q) != len((self.rows or [mark])[0].q)):
            self.malformed += 1
        elif topic == "/plan":
            self.rows.append(PlanRow(number, mark.q, _fittings(mark), mark.move))
        else:
            if mark.kind in self.kinds or len(self.kinds) < MAX_KINDS:
                self.kinds[mark.kind] += 1
            if mark.kind == "mounted":
                insort(self.mountings, (t_host_ns, _fittings(mark)), key=itemgetter(0))

    def with_plan(self, plan: Plan) -> Marks:
        """Return the same with the rows of another plan."""
        names = [{key: str(getattr(plan, key)[row]) for key in plan.IDS} for row in range(len(plan))]
        mounted = [{key: name for key, name in named.items() if name} for named in names]
        rows = zip(range(len(plan)), plan.q.tolist(), mounted, plan.move.tolist(), strict=True)
        return replace(self, rows=list(map(PlanRow._make, rows)))

    @property
    def dwells(self) -> tuple[int, ...]:
        """Return the numbers of the rows at which the ball-bar is read."""
        return tuple(row.number for row in self.rows if row.move == Move.DWELL)

    def plan(self) -> PlannedPoses | None:
        """Return the poses of ``dwells``; None if there are none."""
        poses = [row for row in self.rows if row.move == Move.DWELL]
        q = np.array([row.q for row in poses], order="F")
        return PlannedPoses(q, tuple(row.mounted for row in poses), self.dwells) if poses else None

    def lines(self) -> PlannedPoses | None:
        """Return the lines of the plan; None if there are none."""
        driven = [
            (start, end)
            for start, end in pairwise(self.rows)
            if end.move == Move.LINE and "line" in end.mounted and end.number == start.number + 1
        ]
        ends = np.array([start.q + end.q for start, end in driven])
        mounted = tuple({key: end.mounted.get(key, "") for key in LINE_MOUNTED} for _, end in driven)
        return PlannedPoses(ends, mounted, tuple(end.number for _, end in driven)) if driven else None

    @property
    def names_lines(self) -> bool:
        """Return whether a line was planned or said to be mounted."""
        return any(row.move == Move.LINE for row in self.rows) or any(
            "line" in mounted for _, mounted in self.mountings
        )

    def mounted_at(self, t_host_ns: int) -> dict[str, str]:
        """Return what was said to be mounted at a time; empty before the first statement."""
        index = bisect_right(self.mountings, t_host_ns, key=lambda mounting: mounting[0])
        return self.mountings[index - 1][1] if index else {}


# The planned pose of each dwell, None if there is none, and the possible fittings ("b46 c1 s1") of ambiguous dwells
Matches = tuple[list[int | None], dict[int, tuple[str, ...]]]


def match_plan(q: Floats, plan: PlannedPoses, confirmed: Sequence[Mapping[str, str]]) -> Matches:
    """Assign a planned pose to each dwell.

    ``q`` (d, j): mean readings in order. ``confirmed``: what events said to be mounted at each dwell; the pose must not
    contradict it.
    """
    scale = REPEAT / (POSE_TOLERANCE * (len(q) + 1))
    pairs: list[tuple[int, int]] = []  # (dwell, pose) that are near, by dwell, then by pose
    closeness: list[float] = []  # of each; the sum over all pairs is less than REPEAT
    for dwell, reading in enumerate(q):
        distance = distances(reading, plan)
        for pose in np.flatnonzero(distance <= POSE_TOLERANCE).tolist():
            if not contradict(confirmed[dwell], plan.mounted[pose]):
                pairs.append((dwell, pose))
                closeness.append(scale * (POSE_TOLERANCE - float(distance[pose])))
    matched: list[int | None] = [None] * len(q)
    worth, previous = _paths(pairs, closeness, len(plan.q))
    k = max(range(len(pairs)), key=worth.__getitem__, default=-1)
    while k >= 0:
        dwell, matched[dwell] = pairs[k]
        k = previous[k]
    return matched, _ambiguous(pairs, plan)


def distances(q: Floats, plan: PlannedPoses) -> Floats:
    """Return the distance of one mean reading (j,) to each planned pose: that of the joint that is farthest away.

    It is infinite if the plan has another number of joints.
    """
    if q.shape[0] != plan.q.shape[1]:
        return np.full(len(plan.q), np.inf)
    return np.asarray(np.max(np.abs(plan.q.T - q[:, np.newaxis]), axis=0))  # a long row per joint is faster


def contradict(confirmed: Mapping[str, str], planned: Mapping[str, str]) -> bool:
    """Return whether what was said to be mounted contradicts the plan."""
    return any(confirmed.get(key) and planned.get(key) and confirmed[key] != planned[key] for key in MOUNTED)


def _paths(pairs: Sequence[tuple[int, int]], closeness: Sequence[float], poses: int) -> tuple[list[float], list[int]]:
    """Return the value of the best path that ends at each pair, and the previous pair on that path (-1 for none)."""
    nothing = (0.0, -1)
    value, before = np.zeros(poses + 1), np.full(poses + 1, -1)  # of the best paths that end before a pose
    ending: dict[int, tuple[float, int]] = {}  # the best path that ends at a pose
    best = nothing
    worth: list[float] = []
    previous: list[int] = []
    for _, group in groupby(range(len(pairs)), key=lambda k: pairs[k][0]):
        rows = list(group)
        for k in rows:
            pose = pairs[k][1]
            again = ending.get(pose, nothing)
            coming = (float(value[pose]), int(before[pose]))
            coming = max(coming, (again[0] - REPEAT, again[1]), (best[0] - BACK, best[1]))
            worth.append(coming[0] + 1.0 + closeness[k])
            previous.append(coming[1])
        for k in rows:  # only now: a dwell is in at most one pair
            pose, path = pairs[k][1], (worth[k], k)
            best, ending[pose] = max(best, path), max(ending.get(pose, nothing), path)
            better = value[pose + 1 :] <= worth[k]
            value[pose + 1 :][better], before[pose + 1 :][better] = path
    return worth, previous


def _ambiguous(pairs: Sequence[tuple[int, int]], plan: PlannedPoses) -> dict[int, tuple[str, ...]]:
    """Return the dwells to which paths of the highest value assign different fittings, and these fittings."""
    poses, exact = len(plan.q), [0.0] * len(pairs)  # values are multiples of 1/8: their sums are exact
    ending, _ = _paths(pairs, exact, poses)
    beginning = _paths([(dwell, poses - 1 - pose) for dwell, pose in reversed(pairs)], exact, poses)[0][::-1]
    greatest = max(ending, default=0.0)
    keys = [key for key in MOUNTED if any(mounted.get(key) for mounted in plan.mounted)]
    suits: dict[int, dict[str, None]] = {}
    for (dwell, pose), end, begin in zip(pairs, ending, beginning, strict=True):
        if end + begin - 1.0 == greatest:
            suits.setdefault(dwell, {})[_words(plan.mounted[pose], keys)] = None
    return {dwell: tuple(fittings) for dwell, fittings in suits.items() if len(fittings) > 1}


def _words(mounted: Mapping[str, str], keys: Sequence[str]) -> str:
    return " ".join(mounted.get(key) or "?" for key in keys)


def _fittings(document: Any) -> dict[str, str]:
    """Return what a row or an event names."""
    return {key: name[:MAX_NAME] for key in FITTINGS if (name := getattr(document, key))}


def paired(dwells: Sequence[Dwell], marks: Marks) -> list[Dwell]:
    """Return the dwells with what was mounted. A rejected dwell takes no pose from its neighbour."""
    dwells, plan = list(dwells), marks.plan()
    good = [i for i, dwell in enumerate(dwells) if not dwell.reason]
    confirmed = [marks.mounted_at(dwells[i].start_host_ns) for i in good]
    poses, ambiguous = ([], {}) if plan is None else match_plan(np.array([dwells[i].q for i in good]), plan, confirmed)
    for k, i in enumerate(good):
        dwell, pose, mounted = dwells[i], None, confirmed[k]
        if plan is not None:
            pose = poses[k]
            if k in ambiguous:
                dwells[i] = replace(dwell, reason="ambiguous", detail=" or ".join(ambiguous[k]))
                continue
            if pose is None:
                reason, detail = _unmatched(dwell, plan, mounted)
                dwells[i] = replace(dwell, reason=reason, detail=detail)
                continue
            pose, mounted = plan.rows[pose], plan.mounted[pose]
        reason = "no plan match" if any(key not in mounted for key in BAR_MOUNTED) else ""
        dwells[i] = replace(dwell, pose=pose, mounted=mounted, reason=reason)
    return dwells


def _unmatched(dwell: Dwell, plan: PlannedPoses, confirmed: Mapping[str, str]) -> tuple[str, str]:
    """Return the reason why a dwell is not a pose of the plan, and its distance."""
    distance = distances(dwell.q, plan)
    nearest = int(np.argmin(distance))
    row, planned = plan.rows[nearest], plan.mounted[nearest]
    if np.isinf(distance[nearest]):
        return "no plan match", f"the plan is of {plan.q.shape[1]} joints"
    if distance[nearest] > POSE_TOLERANCE:
        return "no plan match", f"{distance[nearest]:.3f} rad from pose {row}"
    if contradict(confirmed, planned):
        needed, named = (_words(mounted, BAR_MOUNTED) for mounted in (planned, confirmed))
        return "contradiction", f"pose {row} needs {needed}; {named} was confirmed"
    return "no plan match", f"pose {row} is not next in the order of the plan"


def passes_of(legs: Sequence[Leg], marks: Marks, rig: Rig) -> list[LinePass]:
    """Return the legs that may be lines, in order; a leg that is already ruled out carries its reason.

    With lines in the plan, a leg is a motion from the previous row to the line's own row, in the order of the plan.
    Without, it is a motion during which a line was mounted all the time. For a leg outside the plan with a line
    mounted, the device shows whether the magnet moved along it. Raises RigError if a line or target is not in the rig.
    """
    confirmed = [_mounted(marks, leg) for leg in legs]
    plan = marks.lines()
    if plan is None or not legs:
        passes = [LinePass(leg, words) for leg, words in zip(legs, confirmed, strict=True) if "line" in words]
    else:
        passes = _matched(legs, plan, confirmed)
    for k, line_pass in enumerate(passes):
        check_rig(line_pass.mounted, rig)
        if line_pass.leg.end_s - line_pass.leg.start_s > LONGEST_S:
            passes[k] = replace(line_pass, reason="too long")
    return passes


def _matched(legs: Sequence[Leg], plan: PlannedPoses, confirmed: Sequence[Mapping[str, str]]) -> list[LinePass]:
    ends = np.array([np.concatenate([leg.q_start, leg.q_end]) for leg in legs]).reshape(len(legs), -1)
    poses, ambiguous = match_plan(ends, plan, confirmed)
    passes = []
    for k, (leg, pose, words) in enumerate(zip(legs, poses, confirmed, strict=True)):
        if pose is not None:
            passes.append(LinePass(leg, plan.mounted[pose], "ambiguous" * (k in ambiguous), plan.rows[pose]))
        elif "line" in words:
            passes.append(LinePass(leg, dict(words), "gap" if leg.cut else "no plan match"))
    return passes


def _mounted(marks: Marks, leg: Leg) -> dict[str, str]:
    """Return what was said to be mounted during all of a leg; empty if that changed."""
    first, last = (marks.mounted_at(t) for t in (leg.start_host_ns, leg.end_host_ns))
    return first if first == last else {}


def check_rig(mounted: Mapping[str, str], rig: Rig) -> None:
    """Raise RigError if the rig does not have what a session names; a rig that lists no lines accepts any."""
    for key, names in rig.mounted().items():
        name = mounted.get(key)
        if name and name not in names and (names or key != "line"):
            have = ", ".join(sorted(names)) or "none"
            raise RigError(
                f"the session names {key} {name!r}, which the rig does not have (it has {have}); add it to the rig, or give the right rig as ",
                Argument("rig"),
            )


Pairing = tuple[str, str, str]  # bar, chuck, sphere


def pairing_of(mounted: Mapping[str, str]) -> Pairing | None:
    """Return bar, chuck and sphere; None if one of them is not named."""
    if not all(mounted.get(key) for key in BAR_MOUNTED):
        return None
    return mounted["bar"], mounted["chuck"], mounted["sphere"]


def labelled(dwells: Sequence[Dwell], labels: Sequence[DwellLabel]) -> list[Dwell]:
    """Return the dwells with the settled labels; a label applies to the dwells that overlap its time."""
    order = sorted(labels, key=lambda label: label.begin_ns)
    begins = [label.begin_ns for label in order]
    settled = []
    for dwell in dwells:
        if not dwell.reason:
            index = bisect_right(begins, (dwell.start_host_ns + dwell.end_host_ns) // 2) - 1
            label = order[index] if index >= 0 and order[index].end_ns >= dwell.start_host_ns else None
            if label is None:
                dwell = replace(dwell, reason="no plan match", detail="it has no label")
            elif pairing_of(label.mounted) is None:
                dwell = replace(dwell, pose=label.pose, reason="ambiguous", detail=label.detail)
            else:
                dwell = replace(dwell, pose=label.pose, mounted=dict(label.mounted))
        settled.append(dwell)
    return settled


def with_mountings(dwells: Sequence[Dwell], marks: Marks) -> list[Dwell]:
    """Return the dwells, with the stops for mounting marked as such.

    These are stops near no pose of the plan, either before the first matched pose or between two matched poses with
    different pairings or a new confirmation in between.
    """
    plan = marks.plan()
    if plan is None:
        return list(dwells)
    times = [t for t, _ in marks.mountings]
    matched = [i for i, dwell in enumerate(dwells) if dwell.pose is not None]
    marked = list(dwells)
    for i, dwell in enumerate(dwells):
        if dwell.reason != "no plan match" or not POSE_TOLERANCE < distances(dwell.q, plan).min() < np.inf:
            continue
        following = bisect_right(matched, i)
        if following == len(matched):
            continue
        dwell_after, preceding = dwells[matched[following]], dwells[matched[following - 1]] if following else None
        if (
            preceding is None
            or pairing_of(preceding.mounted) != pairing_of(dwell_after.mounted)
            or bisect_right(times, preceding.end_host_ns) < bisect_right(times, dwell_after.start_host_ns)
        ):
            marked[i] = replace(dwell, reason=MOUNTING, detail="")
    return marked


# --------------------------------------------------------------------------------------- labels that were settled later

LABELS_SUFFIX = ".labels.json"
FORMAT_VERSION: Literal[1] = 1
MAX_LABELS_BYTES = 64 << 20
LABELLED = (*BAR_MOUNTED, "shell")

_Time = Annotated[int, Meta(ge=-(2**62), le=2**62)]
_Name = Annotated[str, Meta(pattern=rf"^(?:{NAME.pattern})\Z")]
_Text = Annotated[str, Meta(max_length=500, pattern=r"^[^\x00-\x1f\x7f]*\Z")]


class LabelledDwell(Struct, frozen=True, omit_defaults=True, forbid_unknown_fields=True):
    """A label; without ``bar``, ``chuck`` and ``sphere``, it is unknown what was mounted."""

    begin_ns: _Time
    end_ns: _Time
    bar: _Name = ""
    chuck: _Name = ""
    sphere: _Name = ""
    shell: _Name = ""
    pose: Annotated[int, Meta(ge=0, le=10**9)] | None = None
    probability: Annotated[float, Meta(ge=0.0, le=1.0)] | None = None
    detail: _Text = ""

    def __post_init__(self) -> None:
        if any(self.mounted.values()) and not all(getattr(self, name) for name in BAR_MOUNTED):
            raise ValueError("names only some of bar, chuck and sphere; give all three or none")

    @property
    def mounted(self) -> dict[str, str]:
        """Return what was mounted, by column."""
        return {name: getattr(self, name) for name in LABELLED if getattr(self, name)}

    @property
    def label(self) -> DwellLabel:
        """Return the label of a dwell."""
        probability = math.nan if self.probability is None else self.probability
        return DwellLabel(self.begin_ns, self.end_ns, self.mounted, self.pose, probability, self.detail)


class Decision(Struct, frozen=True, omit_defaults=True, forbid_unknown_fields=True):
    """Labels settled at one time. ``trust``: what was assumed correct; ``robot``: its nominal model, or ""."""

    trust: _Text
    dwells: Annotated[tuple[LabelledDwell, ...], Meta(max_length=100_000)]
    robot: _Text = ""


class _LabelsHeader(Struct):
    format_version: int = 0


class Labels(Struct, frozen=True, forbid_unknown_fields=True):
    """All decisions about the session with this SHA-256, the earliest first."""

    format: Literal["truearm-labels"]
    format_version: Literal[1]
    session: _Text
    sha256: _Text
    decisions: Annotated[tuple[Decision, ...], Meta(min_length=1, max_length=1000)]


def labels_path(session: Path) -> Path:
    """Return the path of the labels of a session."""
    return session.with_name(session.stem + LABELS_SUFFIX)


def read_labels(session: Path) -> tuple[DwellLabel, ...] | None:
    """Return the labels of the last decision about a session, or None (docs/reference/session-format.md).

    ``truearm session relabel`` writes SESSION.labels.json next to the session, which is never modified, and identifies
    it by its SHA-256. If there are several decisions, the last one counts.

    Raises SessionError, also for labels that belong to another session.
    """
    path = labels_path(session)
    if not path.exists():
        return None
    try:
        labels = msgspec.json.decode(_labels_text(path), type=Labels)
    except (msgspec.MsgspecError, RecursionError) as exc:
        raise SessionError(f"{path}: {exc}; label the dwells again with truearm session relabel") from exc
    if labels.sha256 != sha256(session):
        raise SessionError(
            f"{path}: was made for another session named {session.name}; remove it, and label the dwells again with truearm session relabel"
        )
    return tuple(dwell.label for dwell in labels.decisions[-1].dwells)


def _labels_text(path: Path) -> str:
    """Return the text of a file of labels. Raises SessionError for a later version, MsgspecError for other content."""
    text = read_text(path, MAX_LABELS_BYTES, SessionError)
    version = msgspec.json.decode(text, type=_LabelsHeader).format_version
    if version > FORMAT_VERSION:
        raise SessionError(f"{path}: has format version {version}, this truearm reads {FORMAT_VERSION}; update truearm")
    return text


def write_labels(session: Path, labels: Sequence[DwellLabel], trust: str, robot: str) -> None:
    """Write the labels of a session atomically; ``trust`` and ``robot`` as in ``Decision``.

    Raises InputError, and SessionError if a later version of truearm wrote labels, which would be lost.
    """
    path = labels_path(session)
    if path.exists():
        with suppress(msgspec.MsgspecError, RecursionError):  # what cannot be read may be written anew
            _labels_text(path)
    dwells = tuple(
        LabelledDwell(start, end, **mounted, pose=pose, probability=number_or_null(probability), detail=detail)
        for start, end, mounted, pose, probability, detail in labels
    )
    name = session.name.encode(errors="backslashreplace").decode()
    document = Labels("truearm-labels", FORMAT_VERSION, name, sha256(session), (Decision(trust, dwells, robot),))
    write_atomic(path, strict_json(msgspec.to_builtins(document)) + "\n")
