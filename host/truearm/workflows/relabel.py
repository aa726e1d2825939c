"""Settle what was mounted at each dwell of a session, based on a trusted source (``truearm session relabel``)."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, assert_never

import numpy as np
from numpy.typing import NDArray

from truearm.errors import Argument, InputError, RigError, SessionError
from truearm.estimate.mounted_pairings import FITS, SURE, MountingChances, Readings, Words, label_support, mountings
from truearm.files.labels_file import Decision, no_labels, read_labels, with_decision, write_labels
from truearm.files.rig_file import read_rig
from truearm.files.robot_file import RobotChoice
from truearm.files.strict_json import number_or_null
from truearm.progress import step
from truearm.session.dwell_labels import Pairing, Said, label_of, may_be_dwells, pairing_of, said_of_dwells
from truearm.types import BAR_MOUNTED, DwellLabel, Rig
from truearm.workflows.session_observations import recorded_rig
from truearm.workflows.session_parts import open_finished, session_parts

if TYPE_CHECKING:
    from truearm.model.robot import Robot
    from truearm.session.dwells import Dwell
    from truearm.session.observations import Survey, SyncResult

AT_ONCE = 1000  # dwells
LEAST_DWELLS = 3  # fewer cannot support one another


class Trust(StrEnum):
    """Which source decides if plan, operator and readings differ."""

    PLAN = "plan"
    TYPED = "typed"
    EVIDENCE = "evidence"


@dataclass(frozen=True)
class Run:
    """Neighbouring dwells with the same statements and the same findings, numbered from 1. ``probability``: the least
    of ``found``.
    """

    part: Path
    first: int
    last: int
    planned: tuple[Pairing, ...]
    confirmed: Pairing | None
    found: Pairing | None
    probability: float


Answer = Callable[[Run], Pairing | None]  # what was mounted; None: leave these dwells out


class StopAsking(Exception):
    """Raised by an ``Answer`` if the operator ends the questions: the answers so far are kept."""


class Chosen(NamedTuple):
    """The pairing of each dwell, None to leave it out; and the dwells for which the operator gave no answer."""

    pairings: list[Pairing | None]
    unanswered: frozenset[int] = frozenset()


@dataclass(frozen=True)
class RelabelOptions:
    """If ``trust`` is None, ``ask`` is called for every run for which plan, operator and readings differ."""

    robot: RobotChoice
    rig: Path | None = None
    trust: Trust | None = None
    ask: Answer | None = None


@dataclass(frozen=True)
class RelabelledPart:
    """One file of the session: all of its stops, and the statements about the ``good`` ones, which may be dwells."""

    path: Path
    found: Survey
    good: tuple[int, ...]
    said: tuple[Said, ...]

    def dwell(self, k: int) -> Dwell:
        """Return the k-th good dwell."""
        return self.found.dwells[self.good[k]]


def relabel(session: Path, options: RelabelOptions) -> dict[str, Any]:
    """Settle what was mounted at the dwells of a session and its further parts, save it next to them, and return the
    output.

    If the operator ends the questions (``StopAsking``), the dwells without an answer are left out; without any answer
    nothing is saved. Raises InputError, SessionError for a session that is incomplete or still being written, StopAsking.
    """
    paths = session_parts(session)
    with step("examining the session"):  # ends before the operator is asked
        parts, rig, readings = _read(paths, options.rig)
        said = [one for part in parts for one in part.said]
        choice = options.robot
        robot = None if choice.robot is None else choice.load()
        with step(f"estimating what was mounted at {len(said)} dwells"):
            found = None if robot is None else _evidence(robot, rig, readings, said)
    if options.trust is Trust.EVIDENCE and found is None:
        raise InputError("needs-option", place=Argument("trust"), needed=Argument("robot"))
    settled_by = _chosen(parts, said, found, options)
    chosen = [
        one if one is not None or read or not words.planned else words.planned[0]  # no reading: it gives no observation
        for one, read, words in zip(settled_by.pairings, readings.read, said, strict=True)
    ]
    before = [read_labels(path) or no_labels(path) for path in paths]  # all of them, before anything is written
    rows, at = list[dict[str, Any]](), 0
    for part, labels in zip(parts, before, strict=True):
        settled = [
            _label(
                part, k, chosen[at + k], found, at + k, _why_left_out(options.trust, at + k in settled_by.unanswered)
            )
            for k in range(len(part.good))
        ]
        trust = "asked" if options.trust is None else options.trust.value
        decision = Decision(trust, tuple(settled), "" if robot is None else robot.chain.name)
        write_labels(part.path, with_decision(labels, decision))
        rows += [_row(part, k, label, readings, at + k) for k, label in enumerate(settled)]
        at += len(part.good)
    usable = sum(row["bar"] is not None and row["reading"] for row in rows)
    return {
        "sessions": [path.name for path in paths],
        "trust": options.trust and options.trust.value,
        "dwells": len(rows),
        "with_reading": sum(row["reading"] for row in rows),
        "usable": usable,
        "otherwise_than_planned": sum(row["bar"] is not None and row["otherwise"] for row in rows),
        "unanswered": len(settled_by.unanswered),
        "table": rows,
    }


def undo(session: Path) -> dict[str, Any]:
    """Undo the last decision about a session and its further parts. Raises InputError if there is none."""
    paths = session_parts(session)
    before = {path: labels for path in paths if (labels := read_labels(path)) is not None}
    if not before:
        raise InputError("no-effect", place=Argument("undo"), reason=f"nothing of {session} was relabelled")
    for path, labels in before.items():
        write_labels(path, replace(labels, decisions=labels.decisions[:-1]))
    return {
        "sessions": [path.name for path in paths],
        "decisions_left": max(len(b.decisions) - 1 for b in before.values()),
    }


@step("reading the session")
def _read(paths: Sequence[Path], rig_file: Path | None) -> tuple[list[RelabelledPart], Rig, Readings]:
    """Return the files, their common rig, and the readings of all good stops."""
    from truearm.session.box_ident import recorded_ident
    from truearm.session.device_clock import recorded_wander
    from truearm.session.observations import survey
    from truearm.session.session_file import open_session

    parts, readings = list[RelabelledPart](), list[Readings]()
    rig = None if rig_file is None else read_rig(rig_file)
    for path in paths:
        session = open_finished(path, allow_damaged=True)
        if session.truncated:
            raise SessionError("incomplete-session", place=path)
        session = open_session(path)
        rig = rig or recorded_rig(session, path)
        if not (rig.bars and rig.chucks and rig.spheres):
            raise RigError(f"{path}: its rig has no ball-bar, chuck or sphere; there is nothing to relabel")
        found = survey(session.batches, recorded_ident(session), wander=recorded_wander(session))
        good, said, of_part = _of_survey(rig, found)
        parts.append(RelabelledPart(path, found, good, said))
        readings.append(of_part)
    assert rig is not None
    if not any(part.good for part in parts):
        raise SessionError(f"{paths[0]}: the robot never stood still long enough; see truearm inspect {paths[0]}")
    some = [one for one in readings if len(one.q)]
    if len({one.q.shape[1] for one in some}) > 1:
        raise SessionError(
            f"{paths[0]}: its parts are of robots with different numbers of joints; give parts of one robot"
        )
    return parts, rig, Readings(*map(np.concatenate, zip(*((r.q, r.extension, r.beyond) for r in some), strict=True)))


def _of_survey(
    rig: Rig, found: Survey, parts: Sequence[range] | None = None
) -> tuple[tuple[int, ...], tuple[Said, ...], Readings]:
    """Return the stops that may be dwells of the plan, the statements about each, and the sensor readings.

    ``parts``: only of stops with these numbers. Each is measured as if one bar had been mounted all the time: the sensor
    readings do not depend on it.
    """
    from truearm.session.dwells import DwellRules
    from truearm.session.observations import observations

    tolerance = DwellRules().pose_tolerance
    every = may_be_dwells(found.dwells, found.marks, tolerance)
    of_every = said_of_dwells([found.dwells[i] for i in every], found.marks, tolerance)
    some = [k for k, i in enumerate(every) if parts is None or any(i in part for part in parts)]
    good, said = tuple(every[k] for k in some), tuple(of_every[k] for k in some)
    longest = max(rig.bars.values(), key=lambda bar: bar.travel).name
    mounted = dict(zip(BAR_MOUNTED, (longest, next(iter(rig.chucks)), next(iter(rig.spheres))), strict=True))
    labels = [DwellLabel(found.dwells[i].start_host_ns, found.dwells[i].end_host_ns, mounted) for i in good]
    measured = observations(lambda: iter(()), rig, found=found, labels=labels)
    return good, said, readings_of(rig, [measured.dwells[i] for i in good])


def readings_of(rig: Rig, dwells: Sequence[Dwell]) -> Readings:
    """Return the sensor readings at measured dwells, as extensions of their bars."""
    extension = np.full(len(dwells), np.nan)
    for i, dwell in enumerate(dwells):
        if not dwell.reason:
            bar = rig.bars[dwell.mounted["bar"]]
            extension[i] = (dwell.value - bar.zero) / bar.gain
    beyond = np.array([d.reason == "out of travel" or (d.reason == "rail" and "fault" not in d.detail) for d in dwells])
    return Readings(np.array([dwell.q for dwell in dwells]), extension, beyond.astype(bool))


def _evidence(robot: Robot, rig: Rig, readings: Readings, said: Sequence[Said]) -> MountingChances:
    words = Words([one.planned for one in said], [one.typed for one in said])
    _check_joints(robot, readings)
    return mountings(robot.chain, rig, readings, words, robot.free)


def _check_joints(robot: Robot, readings: Readings) -> None:
    have, wanted = readings.q.shape[1], len(robot.chain.joints)
    if have != wanted:
        raise InputError("joint-count", place="session", joints=have, expected=wanted)


def _chosen(
    parts: Sequence[RelabelledPart], said: Sequence[Said], found: MountingChances | None, options: RelabelOptions
) -> Chosen:
    """Return the pairing of each dwell."""
    sure: list[Pairing | None] = [None] * len(said) if found is None else found.sure()
    match options.trust:
        case Trust.PLAN:
            return Chosen([one.planned[0] if len(one.planned) == 1 else None for one in said])
        case Trust.TYPED:
            return Chosen([one.confirmed for one in said])
        case Trust.EVIDENCE:
            return Chosen(sure)
        case None:
            return _asked(parts, said, sure, found, options.ask)
        case _:
            assert_never(options.trust)


def _asked(
    parts: Sequence[RelabelledPart],
    said: Sequence[Said],
    sure: Sequence[Pairing | None],
    found: MountingChances | None,
    ask: Answer | None,
) -> Chosen:
    if ask is None:
        raise InputError("no-terminal", option=Argument("trust"))
    chosen: list[Pairing | None] = []
    numbers = [(part, k) for part in parts for k in range(len(part.good))]
    runs: dict[int, Run] = {}
    for i, ((part, k), one) in enumerate(zip(numbers, said, strict=True)):
        agreed = one.planned[0] if len(one.planned) == 1 and one.confirmed in (None, one.planned[0]) else None
        chosen.append(agreed if sure[i] is None or sure[i] == agreed else None)
        if chosen[i] is not None:
            continue
        number = part.good[k] + 1
        p = float("nan") if found is None else float(found.probability[i, :-1].max())
        run = Run(part.path, number, number, one.planned, one.confirmed, sure[i], p)
        last = runs.get(i - 1)
        if last is not None and replace(last, first=number, last=number, probability=p) == run:
            runs[i] = replace(last, last=number, probability=min(p, last.probability))
            runs = {j: runs[i] if other is last else other for j, other in runs.items()}
        else:
            runs[i] = run
    answers = dict[Run, Pairing | None]()
    try:
        for run in dict.fromkeys(runs.values()):
            answers[run] = ask(run)
    except StopAsking:
        if not answers:
            raise
    for i, run in runs.items():
        chosen[i] = answers.get(run)
    return Chosen(chosen, frozenset(i for i, run in runs.items() if run not in answers))


def _why_left_out(trust: Trust | None, unanswered: bool) -> str:
    match trust:
        case Trust.PLAN:
            return "the plan has no single pairing for it"
        case Trust.TYPED:
            return "nothing was confirmed for it"
        case Trust.EVIDENCE | None:
            return "not answered" if unanswered else "by your answer" if trust is None else ""
        case _:
            assert_never(trust)


def _label(
    part: RelabelledPart, k: int, pairing: Pairing | None, found: MountingChances | None, at: int, why: str
) -> DwellLabel:
    """Return the label of a dwell. ``why``: it is left out if there is no pairing; "" if too little evidence is the cause."""
    detail = why
    p = float("nan")
    if found is not None:
        best = int(found.probability[at].argmax())
        if pairing is None and why in ("", "not answered"):
            what = " ".join(found.pairings[best]) if best < len(found.pairings) else "nothing that the rig has"
            detail = (
                f"{detail}: " * bool(detail)
                + f"{what} has a probability of {found.probability[at, best]:.2%}; {SURE:.2%} is needed"
            )
        elif pairing in found.pairings:
            p = float(found.probability[at, found.pairings.index(pairing)])
    label = label_of(part.dwell(k), part.said[k], part.found.marks, pairing, "" if pairing else detail)
    return label._replace(probability=p)


def _row(part: RelabelledPart, k: int, label: DwellLabel, readings: Readings, at: int) -> dict[str, Any]:
    said = part.said[k]
    pairing = pairing_of(label.mounted)
    return {
        "session": part.path.name,
        "dwell": part.good[k] + 1,
        "pose": label.pose,
        **{key: label.mounted.get(key) for key in BAR_MOUNTED},
        "probability": number_or_null(label.probability),
        "reading": bool(readings.read[at]),
        "planned": [" ".join(one) for one in said.planned],
        "confirmed": None if said.confirmed is None else " ".join(said.confirmed),
        "otherwise": pairing is not None and pairing not in said.planned,
        "detail": label.detail,
    }


def borne_out_rows(robot: Robot, rig: Rig, result: SyncResult) -> NDArray[np.bool_]:
    """Return the rows (n,) of a session's table with labels that the readings support, given the nominal robot.

    Rows that are not dwells are included. A session is judged AT_ONCE dwells at a time. If all of these fit their labels,
    nothing else is checked. Otherwise all evidence about them must support a label, weighed as in ``relabel``.
    """
    out = np.ones(len(result.table), dtype=bool)
    used = [i for i, dwell in enumerate(result.dwells) if not dwell.reason]
    if len(used) < LEAST_DWELLS or result.dwells[used[0]].q.size != len(robot.chain.joints):
        return out
    dwells = [result.dwells[i] for i in used]
    labels = [(d.mounted["bar"], d.mounted["chuck"], d.mounted["sphere"]) for d in dwells]
    readings, free = readings_of(rig, dwells), robot.free
    doubtful = list[slice]()
    for first in range(0, len(used), AT_ONCE):
        rows = slice(first, min(first + AT_ONCE, len(used)))
        if (label_support(robot.chain, rig, readings.take(rows), labels[rows], free) < FITS).any():
            doubtful.append(rows)
    if not doubtful:
        return out
    spans = [range(used[rows.start], used[rows.stop - 1] + 1) for rows in doubtful]
    good, said, every = _of_survey(rig, result.survey, spans)
    for rows, span in zip(doubtful, spans, strict=True):
        part = slice(bisect_left(good, span.start), bisect_left(good, span.stop))
        found = _evidence(robot, rig, every.take(part), said[part])
        at = {i: k for k, i in enumerate(good[part])}
        out[rows] = [found.supports(at[i], label) for i, label in zip(used[rows], labels[rows], strict=True)]
    return out
