"""Collect what plan and operator state about each dwell, and what was settled afterwards (``truearm session relabel``)."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from truearm.session.dwells import MOUNTING, Dwell
from truearm.session.plan_matching import Marks, PlannedPoses, distances, match_plan
from truearm.types import BAR_MOUNTED, DwellLabel

Pairing = tuple[str, str, str]  # bar, chuck, sphere


@dataclass(frozen=True)
class Said:
    """Statements about one dwell.

    ``rows``: the plan rows that it may be, likeliest first. ``planned``: the pairings planned for it; () if it is out
    of order or not in the plan. ``typed``: the pairings typed since the previous dwell. ``confirmed``: the last
    confirmed pairing.
    """

    rows: tuple[int, ...]
    planned: tuple[Pairing, ...]
    typed: tuple[Pairing, ...]
    confirmed: Pairing | None


def pairing_of(mounted: Mapping[str, str]) -> Pairing | None:
    """Return bar, chuck and sphere; None if one of them is not named."""
    if not all(mounted.get(key) for key in BAR_MOUNTED):
        return None
    return mounted["bar"], mounted["chuck"], mounted["sphere"]


def may_be_dwells(dwells: Sequence[Dwell], marks: Marks, tolerance: float) -> tuple[int, ...]:
    """Return the numbers of the stops that are complete and, if there is a plan, at one of its poses."""
    plan = marks.plan()
    whole = [i for i, dwell in enumerate(dwells) if not dwell.reason]
    if plan is None or not whole:
        return tuple(whole)
    return tuple(i for i in whole if distances(dwells[i].q, plan).min() <= tolerance)


def said_of_dwells(dwells: Sequence[Dwell], marks: Marks, tolerance: float) -> list[Said]:
    """Return the statements of plan and operator about dwells in order of time; the two are independent."""
    plan, rows = marks.plan(), marks.dwells
    near, planned = _of_plan(dwells, plan, tolerance)
    times = [t for t, _ in marks.mountings]
    ends = [bisect_right(times, dwell.start_host_ns) for dwell in dwells]
    words = [pairing_of(mounted) for _, mounted in marks.mountings]
    said = []
    for k, end in enumerate(ends):
        since = words[ends[k - 1] if k else 0 : end]
        typed = tuple(pairing for pairing in since if pairing is not None)
        confirmed = words[end - 1] if end else None
        said.append(Said(tuple(rows[pose] for pose in near[k]), planned[k], typed, confirmed))
    return said


def _of_plan(
    dwells: Sequence[Dwell], plan: PlannedPoses | None, tolerance: float
) -> tuple[list[list[int]], list[tuple[Pairing, ...]]]:
    """Return the poses near each dwell, the matched one first, and the pairings planned for it."""
    nothing: list[tuple[Pairing, ...]] = [()] * len(dwells)
    if plan is None or not dwells or dwells[0].q.size != plan.q.shape[1]:
        return [[] for _ in dwells], nothing
    q = np.array([dwell.q for dwell in dwells])
    matches = match_plan(q, plan, tolerance, [{}] * len(dwells))
    near, planned = [], nothing
    for k, pose in enumerate(matches.poses):
        away = distances(q[k], plan)
        poses: list[int] = np.argsort(away, kind="stable")[: np.count_nonzero(away <= tolerance)].tolist()
        near.append(sorted(poses, key=lambda p: p != pose))
        if pose is not None:
            alike = poses if k in matches.ambiguous else [pose]
            found = (pairing_of(plan.mounted[p]) for p in alike)
            planned[k] = tuple(dict.fromkeys(pairing for pairing in found if pairing is not None))
    return near, planned


def label_of(dwell: Dwell, said: Said, marks: Marks, pairing: Pairing | None, detail: str = "") -> DwellLabel:
    """Return the label of a dwell measured with ``pairing``; None leaves the dwell out.

    The pose is one that was planned with this pairing, if there is one.
    """
    rows = sorted(said.rows, key=lambda row: pairing_of(marks.rows[row].mounted) != pairing)
    row = rows[0] if rows else None
    mounted = {} if pairing is None else dict(zip(BAR_MOUNTED, pairing, strict=True))
    if pairing is not None and row is not None and pairing_of(marks.rows[row].mounted) == pairing:
        mounted = dict(marks.rows[row].mounted)
    return DwellLabel(dwell.start_host_ns, dwell.end_host_ns, mounted, row, detail=detail)


def labelled(dwells: Sequence[Dwell], labels: Sequence[DwellLabel]) -> list[Dwell]:
    """Return the dwells with the settled labels; a label applies to the dwells that overlap its time."""
    order = sorted(labels, key=lambda label: label.begin_ns)
    begins = [label.begin_ns for label in order]
    found = []
    for dwell in dwells:
        if dwell.reason:
            found.append(dwell)
            continue
        at = bisect_right(begins, (dwell.start_host_ns + dwell.end_host_ns) // 2) - 1
        label = order[at] if at >= 0 and order[at].end_ns >= dwell.start_host_ns else None
        if label is None:
            found.append(replace(dwell, reason="no plan match", detail="it has no label"))
        elif pairing_of(label.mounted) is None:
            found.append(replace(dwell, pose=label.pose, reason="ambiguous", detail=label.detail))
        else:
            found.append(replace(dwell, pose=label.pose, mounted=dict(label.mounted)))
    return found


def with_mountings(dwells: Sequence[Dwell], marks: Marks, tolerance: float) -> list[Dwell]:
    """Return the dwells, with the stops for mounting marked as such.

    These are stops near no pose of the plan, either before the first matched pose or between two matched poses with
    different pairings or a new confirmation in between.
    """
    plan = marks.plan()
    if plan is None:
        return list(dwells)
    times = [t for t, _ in marks.mountings]
    matched = [i for i, dwell in enumerate(dwells) if dwell.pose is not None]
    found = list(dwells)
    for i, dwell in enumerate(dwells):
        if dwell.reason != "no plan match" or not tolerance < distances(dwell.q, plan).min() < np.inf:
            continue
        at = bisect_right(matched, i)
        if at == len(matched):
            continue
        after, before = dwells[matched[at]], dwells[matched[at - 1]] if at else None
        if (
            before is None
            or pairing_of(before.mounted) != pairing_of(after.mounted)
            or bisect_right(times, before.end_host_ns) < bisect_right(times, after.start_host_ns)
        ):
            found[i] = replace(dwell, reason=MOUNTING, detail="")
    return found
