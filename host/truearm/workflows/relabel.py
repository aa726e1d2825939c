"""Settle what was mounted at each dwell of a session (``truearm session relabel``), by plan, operator and readings.

``identify`` leaves out labels that the readings refute.
"""

from __future__ import annotations

import re
from bisect import bisect_right
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.errors import Argument, InputError, RigError, SessionError
from truearm.estimate.mounted_pairings import SURE, MountingChances, Readings, Words, mountings
from truearm.findings import Finding, entries, stated
from truearm.live.state import check_mounted
from truearm.model.robot import Robot
from truearm.progress import step
from truearm.session.dwells import POSE_TOLERANCE, Dwell
from truearm.session.observations import Survey, SyncResult, observations
from truearm.session.plan_matching import Pairing, distances, labels_path, match_plan, pairing_of, write_labels
from truearm.types import BAR_MOUNTED, DwellLabel, Rig
from truearm.workflows.recorded_session import open_finished, recorded_rig, session_parts, surveyed


@step("examining the session")
def relabel(
    session: Path, robot: Robot | None, trust: str | None, mounted: Sequence[str] = (), rig: Rig | None = None
) -> dict[str, Any]:
    """Settle what was mounted at the dwells of a session and its further parts, and return the output.

    Where plan, operator and readings differ, ``trust`` decides: plan, typed or evidence. ``mounted`` names what was
    mounted at some dwells, as 12:14=BAR,CHUCK,SPHERE. All others are left out. The labels are saved next to each file
    if one of the two is given. Raises InputError; SessionError for a session that is incomplete or still being written.
    """
    if trust == "evidence" and robot is None:
        raise InputError("needs-option", place=Argument("trust"), needed=Argument("robot"))
    paths, stops = session_parts(session), list[Stop]()
    for path in paths:
        opened = open_finished(path)
        rig = rig or recorded_rig(opened, path)
        if not (rig.bars and rig.chucks and rig.spheres):
            raise RigError(f"{path}: its rig has no ball-bar, chuck or sphere; there is nothing to relabel")
        stops += stops_of(path, rig, surveyed(opened))
    if rig is None or not stops:
        raise SessionError(f"{session}: the robot never stood still long enough; see truearm inspect {session}")
    named = dict(pair for text in mounted for pair in _named(text, rig, stops).items())
    chances = None if robot is None else chances_of(robot, rig, stops)
    likely = [(None, 0.0) if chances is None else chances.likeliest(k) for k in range(len(stops))]
    labelled = [
        (stop, _label(stop, trust, named.get(stop.place), *pair)) for stop, pair in zip(stops, likely, strict=True)
    ]
    left_out = [
        {"session": stop.place[0].name, "dwell": stop.place[1], "detail": label.detail}
        for stop, label in labelled
        if not (label.mounted or stop.dwell.reason)
    ]
    saved = paths if trust or mounted else []
    for path in saved:
        labels = [label for stop, label in labelled if stop.place[0] == path]
        write_labels(path, labels, trust or "named", "" if robot is None else robot.chain.name)
    document = {
        "sessions": [path.name for path in paths],
        "saved": [str(labels_path(path)) for path in saved],
        "dwells": len(stops),
        "with_reading": sum(not stop.dwell.reason for stop in stops),
        "left_out": left_out,
    }
    open_dwells = [Finding("dwell-left-out", row) for row in left_out]
    following = Finding("labels-written" if saved else "labels-next")
    return {**document, "findings": entries([stated("labels", document), following, *open_dwells])}


def _label(stop: Stop, trust: str | None, named: Pairing | None, likely: Pairing | None, p: float) -> DwellLabel:
    """Return the label of a dwell, without a pairing if nothing settles it.

    ``likely``: by evidence, with probability ``p``.
    """
    planned, typed = stop.planned, stop.confirmed
    plan = planned[0] if planned and (len(planned) == 1 or stop.dwell.reason) else None
    sure = likely if p >= SURE else None
    agreed = plan if {typed, sure} <= {None, plan} else None
    pairing = named or {None: agreed, "plan": plan, "typed": typed, "evidence": sure}[trust]
    pairing = pairing or (plan if stop.dwell.reason else None)  # then it gives no observation
    statements = {
        "planned": " or ".join(map(" ".join, planned)),
        "confirmed": " ".join(typed or ()),
        f"evidence ({p:.2%}; {SURE:.2%} is needed)": p and " ".join(likely or ("nothing of the rig",)),
    }
    detail = "; ".join(f"{source} {words}" for source, words in statements.items() if words)
    rows = sorted(stop.rows, key=lambda row: pairing_of(row[1]) != pairing)  # one that was planned with this pairing
    row, mounted = rows[0] if rows else (None, dict[str, str]())
    if pairing is None or pairing_of(mounted) != pairing:
        mounted = dict(zip(BAR_MOUNTED, pairing or (), strict=False))
    label = DwellLabel(stop.dwell.start_host_ns, stop.dwell.end_host_ns, mounted, row, detail="" if pairing else detail)
    return label._replace(probability=p) if pairing and pairing == likely else label


def _named(text: str, rig: Rig, stops: Sequence[Stop]) -> dict[tuple[Path, int], Pairing]:
    """Parse what was mounted at some dwells: ``12:14=BAR,CHUCK,SPHERE``; of a further part, ``s.2.mcap 12=…``."""
    match = re.fullmatch(r"(?:(.+) )?([0-9]{1,9})(?::([0-9]{1,9}))?=([^,]+),([^,]+),([^,]+)", text)
    file, first, last, bar, chuck, sphere = match.groups() if match else ("", "0", "0", "", "", "")
    file, dwells = file or stops[0].place[0].name, range(int(first), int(last or first) + 1)
    places = [stop.place for stop in stops if stop.place[0].name == file and stop.place[1] in dwells]
    if not places:
        form = "FIRST:LAST=BAR,CHUCK,SPHERE with numbers of dwells, such as 12:14=bar46,c1,s2"
        raise InputError("wrong-value", place=Argument("mounted"), value=text[:60], form=form)
    check_mounted(dict(zip(BAR_MOUNTED, (bar, chuck, sphere), strict=True)), rig)
    return dict.fromkeys(places, (bar, chuck, sphere))


LEAST_DWELLS = 3  # fewer cannot support one another


class Stop(NamedTuple):
    """A stop that may be a dwell, with its file and its number there, from 1, and what plan and operator say about it.

    ``rows``: the rows of the plan that it may be, likeliest first, with what is mounted there. ``planned``: the
    pairings planned for it; () if it is out of order or not in the plan. ``typed``: the pairings typed since the
    previous stop. ``confirmed``: the last confirmed pairing.
    """

    place: tuple[Path, int]
    dwell: Dwell
    rows: list[tuple[int, dict[str, str]]]
    planned: tuple[Pairing, ...]
    typed: tuple[Pairing, ...]
    confirmed: Pairing | None


def stops_of(path: Path, rig: Rig, survey: Survey) -> list[Stop]:
    """Return the stops of a session that may be dwells of its plan.

    They are measured as if one bar had been mounted all the time: the sensor's readings do not depend on it.
    """
    dwells, plan = survey.dwells, survey.marks.plan()
    bar = max(rig.bars.values(), key=lambda bar: bar.travel).name
    mounted = dict(zip(BAR_MOUNTED, (bar, next(iter(rig.chucks)), next(iter(rig.spheres))), strict=True))
    labels = [DwellLabel(dwell.start_host_ns, dwell.end_host_ns, mounted) for dwell in dwells]
    measured = observations(survey, rig, labels=labels).dwells
    numbers = [i for i, dwell in enumerate(dwells) if not dwell.reason]
    if plan is not None:
        numbers = [i for i in numbers if distances(dwells[i].q, plan).min() <= POSE_TOLERANCE]
        q = np.array([dwells[i].q for i in numbers])
        matched, ambiguous = match_plan(q, plan, [{}] * len(numbers))
    times = [t for t, _ in survey.marks.mountings]
    words = [pairing_of(pairing) for _, pairing in survey.marks.mountings]
    stops, begin = list[Stop](), 0
    for k, i in enumerate(numbers):
        rows, pairings = list[tuple[int, dict[str, str]]](), dict[Pairing, None]()
        end = bisect_right(times, dwells[i].start_host_ns)
        if plan is not None:
            distance, pose = distances(dwells[i].q, plan), matched[k]
            poses = np.argsort(distance, kind="stable")[: np.count_nonzero(distance <= POSE_TOLERANCE)].tolist()
            rows = [(plan.rows[p], plan.mounted[p]) for p in sorted(poses, key=lambda p: p != pose)]
            planned = [] if pose is None else poses if k in ambiguous else [pose]
            pairings = dict.fromkeys(filter(None, (pairing_of(plan.mounted[p]) for p in planned)))
        typed, confirmed = tuple(filter(None, words[begin:end])), words[end - 1] if end else None
        stops.append(Stop((path, i + 1), measured[i], rows, tuple(pairings), typed, confirmed))
        begin = end
    return stops


def chances_of(robot: Robot, rig: Rig, stops: Sequence[Stop]) -> MountingChances:
    """Return the probability of what was mounted at each stop, by all evidence. Raises InputError."""
    dwells, n_joints = [stop.dwell for stop in stops], len(robot.chain.joints)
    for joints in {dwell.q.size for dwell in dwells} - {n_joints, len(robot.chain.motors)}:
        raise InputError("other-robot", place="session", joints=joints, expected=n_joints)
    extension, beyond = np.full(len(dwells), np.nan), np.zeros(len(dwells), dtype=bool)
    for i, dwell in enumerate(dwells):
        if not dwell.reason:
            bar = rig.bars[dwell.mounted["bar"]]
            extension[i] = (dwell.value - bar.zero) / bar.gain
        beyond[i] = dwell.reason == "out of travel" or (dwell.reason == "rail" and "fault" not in dwell.detail)
    words = Words([stop.planned for stop in stops], [stop.typed for stop in stops])
    readings = Readings(robot.chain.completed(np.array([dwell.q for dwell in dwells])), extension, beyond)
    return mountings(robot.chain, rig, readings, words, robot.free)


def borne_out_rows(robot: Robot, rig: Rig, result: SyncResult) -> NDArray[np.bool_]:
    """Return the rows (n,) of a session's table that are no dwells, or have labels that the readings support."""
    out = np.ones(len(result.table), dtype=bool)
    labels = {i + 1: pairing_of(dwell.mounted) for i, dwell in enumerate(result.dwells) if not dwell.reason}
    if len(labels) >= LEAST_DWELLS and result.table.q.shape[1] == len(robot.chain.joints):
        stops = stops_of(Path(), rig, result.survey)
        number, chances = {stop.place[1]: k for k, stop in enumerate(stops)}, chances_of(robot, rig, stops)
        out[: len(labels)] = [chances.supports(number[place], label) for place, label in labels.items()]
    return out
