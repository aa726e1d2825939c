"""A session's messages → observations (hops 4 and 5), in two passes whose memory does not grow with the samples.

The first pass (``survey``) accounts for every frame, gathers the clock exchanges and what the robot said, and finds the dwells.
The second (``observations``) takes the samples of one dwell after another. A dwell gives one observation or says why not.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from itertools import chain, islice

import numpy as np

from truearm.errors import RigError
from truearm.sensors.ident import Ident
from truearm.sync.blocks import Block, BoxReader
from truearm.sync.clock import ClockReport, fit_clock
from truearm.sync.device_clock import DeviceClock
from truearm.sync.dwell import Dwell, DwellRules, find_dwells
from truearm.sync.gather import gather
from truearm.sync.joints import JointReader, JointStream
from truearm.sync.losses import Losses
from truearm.sync.measure import LEARNT, Sensing, measured, usual_noise, without_noisy
from truearm.sync.pairing import REQUIRED, Marks, Plan, match_plan, nearest_pose
from truearm.sync.streams import StreamReport
from truearm.types import Message, ObservationTable, Rig

Messages = Callable[[Collection[str] | None], Iterator[Message]]


@dataclass(frozen=True)
class Survey:
    """What the first pass says. ``idents``: of each segment that has one; ``clocks``: of each segment with exchanges."""

    losses: Losses
    streams: tuple[StreamReport, ...]
    idents: dict[int, Ident]
    boot_ids: tuple[int | None, ...]
    clocks: dict[int, DeviceClock]
    clock_reports: tuple[ClockReport, ...]
    joints: JointStream
    dwells: tuple[Dwell, ...]
    marks: Marks
    box_topics: frozenset[str]


@dataclass(frozen=True)
class SyncResult:
    """Observations and how they came about. The table's rows are the dwells without a reason, in order."""

    table: ObservationTable
    dwells: tuple[Dwell, ...]
    survey: Survey
    samples_seen: int
    samples_used: int

    @property
    def losses(self) -> Losses:
        """The exact account of what did not arrive."""
        return self.survey.losses

    @property
    def clock_reports(self) -> tuple[ClockReport, ...]:
        """Device to host, a report a segment."""
        return self.survey.clock_reports

    @property
    def reasons(self) -> dict[str, int]:
        """How many dwells were rejected, by reason."""
        return dict(Counter(dwell.reason for dwell in self.dwells if dwell.reason))


def survey(messages: Messages, ident: Ident | None = None, rules: DwellRules | None = None) -> Survey:
    """One pass over all messages. ``ident`` (of the session's metadata) serves until the box itself says its own."""
    box, robot, marks, topics = BoxReader(ident), JointReader(), Marks(), set[str]()
    for message in messages(None):
        if message.topic == "/robot/joints":
            robot.feed(message)
        elif message.topic.startswith("/box/"):
            topics.add(message.topic)
            box.feed(message)
        elif message.topic == "/sync":
            box.feed(message)
        else:
            robot.feed(message)  # an event may say that its link was lost
            marks.feed(message.topic, message.t_host_ns, message.data)
    fits = {s.index: fit for s in box.segments if (fit := fit_clock(s.index, s.exchanges)) is not None}
    joints = robot.finish()
    return Survey(
        losses=box.losses(),
        streams=box.streams(),
        idents={s.index: s.ident for s in box.segments if s.ident is not None},
        boot_ids=tuple(s.boot_id for s in box.segments),
        clocks={index: clock for index, (clock, _) in fits.items()},
        clock_reports=tuple(report for _, report in fits.values()),
        joints=joints,
        dwells=tuple(_on_host(dwell, joints) for dwell in find_dwells(joints, rules or DwellRules())),
        marks=marks,
        box_topics=frozenset(topics),
    )


def observations(
    messages: Messages,
    rig: Rig,
    ident: Ident | None = None,
    rules: DwellRules | None = None,
    name: str = "session",
    channel: str = "lvdt",
    found: Survey | None = None,
) -> SyncResult:
    """Observations of the ball-bar on ``channel``; ``messages`` is called twice, once if ``found`` is its survey.

    ``name`` stands for the session in the table's ``source``. Raises RigError where a dwell's bar, chuck or sphere is
    not in the rig, SessionError where the box has no such channel or no calibration of it.
    """
    rules = rules or DwellRules()
    found = found or survey(messages, ident, rules)
    dwells = _pair(found, rig, rules)
    good = sorted((d.start_host_ns, d.end_host_ns, i) for i, d in enumerate(dwells) if not d.reason)
    intervals = _disjoint([(i, start, end) for start, end, i in good])
    several = gather(_blocks(messages, found.box_topics, ident), found.clocks, intervals, channel)
    first = list(islice(several, LEARNT))
    sensing = Sensing(rules, found.joints, bool(found.clocks), usual_noise(first))
    for taken in chain(first, several):
        dwell = dwells[taken.dwell]
        dwells[taken.dwell] = measured(dwell, taken, rig.bars[dwell.mounted["bar"]], sensing)
    dwells = without_noisy(dwells)
    used = sum(dwell.n_samples for dwell in dwells if not dwell.reason)
    return SyncResult(_table(dwells, found.joints, name), tuple(dwells), found, found.losses.samples, used)


def _blocks(messages: Messages, topics: Collection[str], ident: Ident | None) -> Iterator[tuple[Block, Ident]]:
    reader = BoxReader(ident, keep_exchanges=False)
    for message in messages(topics):
        block = reader.feed(message)
        if block is not None and reader.segment.ident is not None:
            yield block, reader.segment.ident


def _on_host(dwell: Dwell, joints: JointStream) -> Dwell:
    start, end = joints.clocks[dwell.segment].to_host_ns(np.array([dwell.start_s, dwell.end_s]))
    return replace(dwell, start_host_ns=int(start), end_host_ns=int(end))


def _disjoint(intervals: list[tuple[int, int, int]]) -> list[tuple[int, int, int]]:
    """Ascending intervals, none begun before the one before it ended: controller segments may overlap in host time."""
    disjoint: list[tuple[int, int, int]] = []
    for dwell, start, end in intervals:
        start = max(start, disjoint[-1][2] + 1) if disjoint else start
        disjoint.append((dwell, start, max(start, end)))
    return disjoint


def _pair(found: Survey, rig: Rig, rules: DwellRules) -> list[Dwell]:
    """The dwells with what was mounted. A dwell that is already rejected takes no pose from its neighbour."""
    dwells = list(found.dwells)
    good = [i for i, dwell in enumerate(dwells) if not dwell.reason]
    said = [found.marks.mounted_at(dwells[i].start_host_ns) for i in good]
    plan, rows = found.marks.plan(), found.marks.dwells
    if plan is None or not good:
        for i, words in zip(good, said, strict=True):
            dwells[i] = _mounted(dwells[i], None, words, rig)
        return dwells
    found_poses = match_plan(np.array([dwells[i].q for i in good]), plan, rules.pose_tolerance, said)
    for k, (i, pose) in enumerate(zip(good, found_poses.poses, strict=True)):
        if k in found_poses.ambiguous:
            dwells[i] = replace(dwells[i], reason="ambiguous", detail=" or ".join(found_poses.ambiguous[k]))
        else:
            row = None if pose is None else rows[pose]
            dwells[i] = _mounted(dwells[i], row, {} if pose is None else plan.mounted[pose], rig)
            if pose is None:
                dwells[i] = replace(dwells[i], detail=_away(dwells[i], plan, rows, rules))
    return dwells


def _away(dwell: Dwell, plan: Plan, rows: list[int], rules: DwellRules) -> str:
    """How far a dwell is from the plan."""
    nearest, distance = nearest_pose(dwell.q, plan)
    if nearest < 0:
        return f"the plan is of {plan.q.shape[1]} joints"
    if distance <= rules.pose_tolerance:
        return f"pose {rows[nearest]} is out of turn, or other fittings are on"
    return f"{distance:.3f} rad from pose {rows[nearest]}"


def _mounted(dwell: Dwell, pose: int | None, mounted: dict[str, str], rig: Rig) -> Dwell:
    """The dwell with its fittings, or with the reason that it lacks some."""
    if any(key not in mounted for key in REQUIRED):
        return replace(dwell, pose=pose, mounted=mounted, reason="no plan match")
    _check_rig(mounted, rig)
    return replace(dwell, pose=pose, mounted=mounted)


def _check_rig(mounted: dict[str, str], rig: Rig) -> None:
    for key, known in (("bar", rig.bars), ("chuck", rig.chucks), ("sphere", rig.spheres)):
        if mounted[key] not in known:
            names = ", ".join(sorted(known)) or "none"
            raise RigError(f"the session names {key} {mounted[key]!r}, which the rig does not have (it has {names})")


def _table(dwells: list[Dwell], joints: JointStream, name: str) -> ObservationTable:
    rows = [(i, dwell) for i, dwell in enumerate(dwells, start=1) if not dwell.reason]
    empty = np.full(len(rows), "", dtype=np.str_)

    def words(key: str) -> np.ndarray[tuple[int, ...], np.dtype[np.str_]]:
        return np.array([dwell.mounted.get(key, "") for _, dwell in rows], dtype=np.str_)

    return ObservationTable(
        q=np.array([dwell.q for _, dwell in rows]).reshape(len(rows), len(joints.step)),
        kind=np.array(["ball_bar"] * len(rows), dtype=np.str_),  # np.full would keep one letter
        value=np.array([dwell.value for _, dwell in rows], dtype=np.float64),
        sigma=np.array([dwell.sigma for _, dwell in rows], dtype=np.float64),
        bar=words("bar"),
        chuck=words("chuck"),
        sphere=words("sphere"),
        socket=empty,
        place=empty,
        shell=words("shell"),
        source=np.array([f"{name} dwell {i}" for i, _ in rows], dtype=np.str_),
    )
