"""The numbers of a program to correct: those that determine the goal of each move.

A move's goal is a product of poses (``values.Pose``). One literal of it receives the correction: the last one, which is
the taught point if the others are features and offsets, unless another move needs that literal alone. Two moves that
require different values of one literal are rejected with both lines. With ``split`` the later move gets separate
numbers, written in place of its argument.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple, assert_never

import numpy as np

from truearm.collector import uncollected
from truearm.errors import ProgramError
from truearm.files.programs.motions import Motion
from truearm.files.programs.program import Program, Refused, refused_at
from truearm.files.programs.syntax import Form, Taught
from truearm.files.programs.target_poses import PoseTarget, literals_of, values_of
from truearm.files.programs.values import EVERY, UNIT_QUATERNION, Factor, Goal, Pose, Value, literals_in, plain_literal
from truearm.files.target_table import MAX_TARGETS
from truearm.units import DEG, MM, UNITS


class Line(NamedTuple):
    """A straight move: its place, its start and its goal pose. A start is a pose, or joint readings."""

    at: int
    start: int | Taught  # a pose's index among the targets' poses
    end: int


class Revisit(NamedTuple):
    """A further path to a pose (by its index): with another qnear, or from elsewhere.

    The arm may arrive in another configuration, which requires another correction.
    """

    pose: int
    goal: Goal
    origin: int | Taught | None
    moves: dict[int, None]  # their places


class ProgramTargets(NamedTuple):
    """What is to be corrected: poses, and joint readings as literals; and the moves that cannot be corrected.

    ``lines`` are the straight moves; those in ``loose`` (by place) may also begin elsewhere. ``origins``: the robot's
    position before it first goes to each pose, given as another pose by its index or joint readings, None if the
    program does not determine it. ``revisits``: the further paths to them. ``indices``: the pose of each goal, None if it
    is not corrected.
    """

    poses: tuple[PoseTarget, ...]
    joints: tuple[tuple[Taught, int], ...]
    refused: tuple[Refused, ...]
    lines: tuple[Line, ...]
    loose: tuple[int, ...]
    origins: tuple[int | Taught | None, ...]
    revisits: tuple[Revisit, ...]
    indices: Mapping[Goal, int | None]


Refuse = Callable[[Motion, str, str], None]


@uncollected()
def targets_of(program: Program, joint_moves: bool, split: bool) -> ProgramTargets:
    """Return which literals receive the corrections. ``joint_moves``: joint readings are corrected too; otherwise they
    are kept.

    Raises ProgramError if there are too many targets.
    """
    refused: dict[Refused, None] = {}
    read = _read_by(program)
    users: dict[Goal, Motion] = {}
    joints: dict[Taught, int] = {}

    def refuse(motion: Motion, why: str, remedy: str) -> None:
        refused[refused_at(program, motion.start, why, remedy)] = None

    for motion in program.motions:
        for why, remedy in motion.problems:
            refuse(motion, why, remedy)
        for goal in motion.goals:
            if isinstance(goal.target, Pose):
                users.setdefault(goal, motion)
            elif joint_moves and goal.target.form is Form.COMPUTED:
                refuse(motion, "its joint readings are computed, not written as six plain numbers", "")
            elif joint_moves and goal.target.start in read:
                refuse(motion, _why_read(program, read[goal.target.start]), "")
            elif joint_moves:
                joints.setdefault(goal.target, motion.start)
    if len(users) + len(joints) > MAX_TARGETS:
        raise ProgramError(
            f"{program.source.name}: has {len(users) + len(joints)} targets, the maximum is {MAX_TARGETS}; split it"
        )
    poses, index = _assigned(program, users, read, split, refuse)
    literals = literals_of(poses)
    for literal in _suspects([*literals.values(), *joints]):
        if (absurd := _absurd(literal)) is not None:
            raise program.source.wrong(literal.start, absurd)
    index_of = dict(zip(users, index, strict=True))
    legs = _legs_of(program, index_of)
    origins, revisits = _ways(poses, legs, users, index)
    lines, loose = _straight_ways(legs)
    return ProgramTargets(
        poses, tuple(joints.items()), tuple(sorted(refused)), lines, loose, origins, revisits, index_of
    )


class _Leg(NamedTuple):
    """A way of a move: the known places where it begins, and the corrected poses to which it goes, with the goals.

    ``certain``: all its places are known, though not all may be corrected.
    """

    motion: Motion
    places: list[int | Taught]
    ends: list[tuple[int, Goal]]
    certain: bool


def _legs_of(program: Program, index: Mapping[Goal, int | None]) -> list[_Leg]:
    legs = []
    for motion in program.motions:
        for starts, ends in motion.legs:
            places = [place for start in starts if (place := _origin(start, index)) is not None]
            known = [(to, end) for end in ends if isinstance(end, Goal) and (to := index.get(end)) is not None]
            found = len(places) + len(known) == len(starts) + len(ends)
            certain = found or all(isinstance(one, Goal) for one in (*starts, *ends))
            legs.append(_Leg(motion, places, known, certain))
    return legs


def _straight_ways(legs: Sequence[_Leg]) -> tuple[tuple[Line, ...], tuple[int, ...]]:
    """Return the straight moves from known places to corrected poses, and those that may also begin elsewhere."""
    lines: dict[Line, None] = {}
    loose: dict[int, None] = {}
    for motion, places, ends, certain in legs:
        if motion.straight:
            for begin in places:
                for to, _ in ends:
                    lines[Line(motion.start, begin, to)] = None
            if not certain:
                loose[motion.start] = None
    return tuple(lines), tuple(loose)


def _ways(
    poses: Sequence[PoseTarget], legs: Sequence[_Leg], users: Mapping[Goal, Motion], index: Sequence[int | None]
) -> tuple[tuple[int | Taught | None, ...], tuple[Revisit, ...]]:
    """Return the robot's position before it first goes to each pose, and the further paths to it.

    ``users`` are the goals with the first move to each, ``index`` their poses.
    """
    origins: dict[int, int | Taught] = {}
    further: dict[tuple[object, ...], Revisit] = {}
    arrived: set[tuple[object, ...]] = set()  # poses whose path is known, and whether the target's own data count
    for motion, places, ends, _ in legs:
        if not places:
            continue
        for to, end in ends:
            first = origins.get(to)
            if first is None:
                first = origins[to] = next((one for one in places if one != to), places[0])
            if end.near is None:
                chooses = _chooses(end)
                arrived.add((to, chooses))
                same = chooses == _chooses(poses[to].goal)
                for place in places:
                    if place != to and not (same and place == first):
                        further.setdefault((to, chooses, place), Revisit(to, end, place, {})).moves[motion.start] = None
    for (goal, motion), of in zip(users.items(), index, strict=True):
        if of is None or goal is (first_goal := poses[of].goal):
            continue
        chooses = _chooses(goal)
        if chooses != _chooses(first_goal) and not (_by_origin(goal) and (of, chooses) in arrived):
            further.setdefault((of, chooses), Revisit(of, goal, None, {})).moves[motion.start] = None
    return tuple(origins.get(i) for i in range(len(poses))), tuple(further.values())


def _chooses(goal: Goal) -> tuple[float, ...] | bool:
    """Return what selects a goal's arm configuration other than the robot's previous position.

    These are joint readings, or whether the target's own data count.
    """
    if goal.near is None:
        return isinstance(goal.target, Pose) and goal.target.free
    return goal.near.values if isinstance(goal.near, Taught) else goal.near


def _by_origin(goal: Goal) -> bool:
    """Return whether the robot's previous position alone selects a goal's arm configuration."""
    return goal.near is None and isinstance(goal.target, Pose) and (goal.target.free or goal.target.like is None)


def _origin(start: Value, index: Mapping[Goal, int | None]) -> int | Taught | None:
    if not isinstance(start, Goal):
        return None
    return start.target if isinstance(start.target, Taught) else index.get(start)


def _assigned(
    program: Program, users: Mapping[Goal, Motion], read: Mapping[int, int], split: bool, refuse: Refuse
) -> tuple[tuple[PoseTarget, ...], list[int | None]]:
    """Return the targets, with a literal for each goal (those with one candidate first), and each goal's target.

    ``read``: the literals whose numbers something else depends on, and its place.
    """
    goals, motions = list(users), list(users.values())
    fixtures = {literal.start for goal in goals for pose in goal[1:3] if pose.factors for literal in literals_in(pose)}
    fixtures |= read.keys()
    candidates = [_candidates(goal, fixtures, motion) for goal, motion in zip(goals, motions, strict=True)]
    holders: dict[int, int] = {}
    chosen: list[PoseTarget | None] = [None] * len(goals)
    for i in sorted(range(len(goals)), key=lambda k: len(candidates[k])):
        goal, motion = goals[i], motions[i]
        taken: int | None = None
        for literal in candidates[i]:
            holder = holders.setdefault(literal.start, i)
            if holder == i or _same(goals[holder], goal):
                chosen[i] = PoseTarget(goal, literal, motion.start)
                break
            taken = holder if taken is None else taken
        else:
            own = _split(goal, motion)
            chosen[i] = own if split else None
            if chosen[i] is None and (taken is not None or not motion.problems):
                assert isinstance(goal.target, Pose)
                places = [read[one.start] for one in literals_in(goal.target) if one.start in read]
                why = "its target is not written as plain numbers in one place"
                if places:
                    why = _why_read(program, places[0])
                if taken is not None:
                    line = program.source.line
                    shared, other = line(candidates[i][0].start), line(motions[taken].start)
                    why = f"it shares the target of line {shared} with the move of line {other}, but needs different numbers there"
                    if motions[taken] is motion:
                        why = f"its tool, frame or offset depends on how the program reaches this move, and each case needs different numbers in the target of line {shared}"
                if own is None and goal.start >= 0 > goal.end:
                    why += "; the call that gives its target may do more, so it is not replaced"
                elif own is None and (n := _goals_at(goal, motion)) > 1:
                    why += (
                        f"; it goes to {n} poses: pass each as an argument of its own, or write the move out for each"
                    )
                refuse(motion, why, "" if own is None else "split")
    unique: dict[object, int] = {}
    index: list[int | None] = []
    poses: list[PoseTarget] = []
    for one in chosen:
        if one is None:
            index.append(None)
            continue
        key = one.goal._replace(near=None) if one.literal is None else one.literal.start
        at = unique.setdefault(key, len(poses))
        index.append(at)
        if at == len(poses):
            poses.append(one)
    return tuple(poses), index


def _read_by(program: Program) -> dict[int, int]:
    """Return the places of the literals whose numbers something else depends on, each with the place of the first."""
    read = dict(program.judged)
    goals = [(goal, motion) for motion in program.motions for goal in motion.goals]
    for goal, motion in goals:
        if goal.tool.origin or goal.frame.origin or (isinstance(goal.target, Pose) and goal.target.origin):
            for one in _computed_from(goal):
                read.setdefault(one.start, motion.start)
    if (place := read.get(EVERY.start)) is not None:
        for goal, _ in goals:
            for one in literals_in(goal.target) if isinstance(goal.target, Pose) else (goal.target,):
                read.setdefault(one.start, place)
    return read


def _computed_from(goal: Goal) -> Iterator[Taught]:
    """Yield the literals from whose numbers a tool, a frame or an offset of a goal is computed.

    A goal that is computed as a whole can only get numbers of its own, so what it is computed from may change.
    """
    for pose in (goal.tool, goal.frame, goal.target):
        if isinstance(pose, Pose) and (pose is not goal.target or next(literals_in(pose), None) is not None):
            yield from pose.origin


def _why_read(program: Program, place: int) -> str:
    """Return why a literal cannot be corrected on whose numbers something else depends."""
    line = program.source.line(place)
    if place in program.motion_at:
        return f"the move in line {line} computes its tool, frame or offset from the numbers of its target"
    return f"a decision in line {line} depends on the numbers of its target, and could change with corrected numbers"


def _split(goal: Goal, motion: Motion) -> PoseTarget | None:
    """Return the goal written into its move, if the argument is used nowhere else and goes to nothing else."""
    alone = _goals_at(goal, motion) == 1
    return PoseTarget(goal, None, motion.start) if alone and goal.end >= 0 and not motion.problems else None


def _goals_at(goal: Goal, motion: Motion) -> int:
    """Return the number of goals of a move that its argument for this goal gives."""
    return sum(1 for other in motion.goals if (other.start, other.end) == (goal.start, goal.end))


def _same(a: Goal, b: Goal) -> bool:
    """Return whether two goals require the same of a literal."""
    assert isinstance(a.target, Pose)
    assert isinstance(b.target, Pose)
    return a.target.factors == b.target.factors and _alike(a.tool, b.tool) and _alike(a.frame, b.frame)


def _alike(a: Pose, b: Pose) -> bool:
    """Return whether two tools or frames are the same, though perhaps written in several places.

    Neither is corrected.
    """
    if a is b:
        return True
    parts = zip(a.factors, b.factors, strict=False)
    return len(a.factors) == len(b.factors) and all(
        one.inverse == other.inverse and _numbers(one) == _numbers(other) for one, other in parts
    )


def _numbers(factor: Factor) -> tuple[object, ...]:
    of = factor.pose
    return (of.form, *of.values) if isinstance(of, Taught) else of.rows


def _candidates(goal: Goal, fixtures: set[int], motion: Motion) -> list[Taught]:
    """Return the literals that may receive a goal's correction, the best first.

    A move that may also go elsewhere is not corrected, so only a literal that is the whole goal is: a step from one goal
    to the next stays.
    """
    assert isinstance(goal.target, Pose)
    if motion.problems and plain_literal(goal.target) is None:
        return []
    found = list(literals_in(goal.target))
    if len(found) == 1:
        return found if found[0].start not in fixtures else []
    starts = [one.start for one in found]
    return [one for one in reversed(found) if starts.count(one.start) == 1 and one.start not in fixtures]


def _suspects(literals: Sequence[Taught]) -> Iterator[Taught]:
    """Yield the literals with a number so large, or a quaternion so far from a unit one, that they may be invalid."""
    for form in Form:
        mine = [one for one in literals if one.form is form]
        if mine:
            values, odd = values_of(mine), np.zeros(len(mine), dtype=bool)
            if form is Form.ROBTARGET:
                odd = ~(np.abs(np.linalg.norm(values[:, 3:7], axis=1) - 1.0) <= UNIT_QUATERNION)
            odd |= ~(np.abs(values[:, :6]) <= _plain(form)).all(axis=1)
            yield from (mine[i] for i in np.flatnonzero(odd))


def _plain(form: Form) -> float:
    """Return an upper limit for lengths and angles of a literal that a robot can reach, in the literal's units."""
    metres, radians = UNITS["m"].largest, UNITS["rad"].largest
    match form:
        case Form.POSE | Form.JOINTS | Form.COMPUTED:
            return min(metres, radians)
        case Form.ROBTARGET:
            return float(MM.of(metres))
        case Form.JOINTTARGET:
            return float(DEG.of(radians))
        case _:
            assert_never(form)


def _absurd(literal: Taught) -> str | None:
    """Return why a literal cannot be a pose or joint readings of a robot."""
    numbers = literal.values
    match literal.form:
        case Form.POSE | Form.ROBTARGET as form:
            pose = form is Form.POSE
            largest = UNITS["m"].largest if pose else float(MM.of(UNITS["m"].largest))
            if (far := _beyond(numbers[:6] if pose else numbers[:3], largest)) is not None:
                return f"{far:g} is beyond the reach of any robot"
            norm = 1.0 if pose else sum(value * value for value in numbers[3:7]) ** 0.5
            if not abs(norm - 1.0) <= UNIT_QUATERNION:
                return f"the orientation is not a unit quaternion, its norm is {norm:.4g}"
            return None
        case Form.JOINTS | Form.COMPUTED | Form.JOINTTARGET as form:
            largest = UNITS["rad"].largest if form is not Form.JOINTTARGET else float(DEG.of(UNITS["rad"].largest))
            far = _beyond(numbers[:6], largest)
            unit = "deg" if form is Form.JOINTTARGET else "rad"
            return None if far is None else f"{far:g} {unit} is not a reading of a joint"
        case _:
            assert_never(literal.form)


def _beyond(values: Sequence[float], largest: float) -> float | None:
    if max(values) <= largest and min(values) >= -largest:
        return None
    return next((value for value in values if not abs(value) <= largest), None)
