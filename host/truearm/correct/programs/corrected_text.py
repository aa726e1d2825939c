"""A program's files with new numbers, and their comparison with what was wanted when they are read again.

Every byte that is not part of a corrected number stays as it is. The comparison finds mistakes between the targets and
the text: numbers in a wrong place or rounded wrongly, a literal that two moves share, a move that was lost
(docs/decisions/0031).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from truearm.correct.configurations import EDGE, SAME
from truearm.correct.programs.census import Census
from truearm.correct.programs.program import Form, Goal, Move, Place, Program
from truearm.correct.programs.reading import plain, poses_of, readings_of, texts_of_poses, texts_of_readings
from truearm.findings import option
from truearm.model.transforms import apart
from truearm.types import Floats

CONFIGURED = (0, 3, 5)  # axes whose quarter turns cf1, cf4 and cf6 of a robtarget give
BYTES = ("utf-8", "surrogateescape")  # bytes that are no UTF-8 stay as they are
COMMENTS = {"rapid": "!", "urscript": "#", "krl": ";"}  # Fanuc's LS has none beside statements
CLOSE = 1e-6  # m, rad: below a controller's resolution, above the rounding of the numbers that are written


class Replacement(NamedTuple):
    """Text that replaces the bytes from ``start`` to ``end`` of a file."""

    file: int
    start: int
    end: int
    text: str


class Joints(NamedTuple):
    """Joint readings (j,) [rad] with which the controller reaches a goal before and after the correction."""

    before: Floats
    after: Floats


def changes_of(
    census: Census, goal_poses: Mapping[Goal, Floats], joints: Mapping[Goal, Joints], correct_joints: bool
) -> list[Replacement]:
    """Return the changes of the text that a census settled on.

    ``goal_poses``: the poses (4, 4) in their frames of goals that are poses. ``correct_joints``: joint readings change
    too.
    """
    due = due_numbers(census, goal_poses, correct_joints)
    posed = [(goal.target.literal, pose) for goal, pose, _ in due.values() if pose is not None]
    pose_texts = iter(texts_of_poses([literal for literal, _ in posed], np.array([pose for _, pose in posed])))
    changes: list[Replacement] = []
    for place, (goal, pose, is_own) in due.items():
        literal = goal.target.literal
        if pose is None:
            texts = texts_of_readings(literal, joints[goal].after)
        else:
            texts = [*next(pose_texts), *configuration_texts(goal, joints.get(goal))]
        numbers = [(start, end, text) for (start, end), text in zip(literal.spans, texts, strict=False)]
        if not is_own:
            changes += [Replacement(place.file, *number) for number in numbers]
        elif goal.argument is not None:
            first = literal.place.offset
            data = census.program.files[literal.place.file].data[first : literal.end]
            text = _replaced(data, [(start - first, end - first, text) for start, end, text in numbers]).decode(*BYTES)
            changes.append(Replacement(place.file, *goal.argument, text))
    return sorted(changes)


Due = dict[Place, tuple[Goal, Floats | None, bool]]


def due_numbers(census: Census, goal_poses: Mapping[Goal, Floats], correct_joints: bool) -> Due:
    """Return which numbers change, by the place of the literal, or of the argument that numbers of a move replace.

    Each for a goal, with the pose (4, 4) to write, None for joint readings, and whether they are the move's own.
    """
    due: Due = {place: (goal, pose, False) for place, (goal, pose) in census.poses.items()}
    for move in census.program.moves:
        for goal in move.goals if move.reason is None else ():
            argument = goal.argument if move in census.replaced else None
            place = goal.target.literal.place if argument is None else Place(move.place.file, argument[0])
            if correct_joints if goal.is_joints else argument is not None and goal in goal_poses:
                due.setdefault(place, (goal, goal_poses.get(goal), argument is not None))
    return due


def configuration_texts(goal: Goal, joints: Joints | None) -> list[str]:
    """Return the configuration data of a literal, with the quarter turns or signs that the correction crosses."""
    literal = goal.target.literal
    if joints is None or len(joints.after) != 6:
        return []
    if literal.form is Form.ROBTARGET:
        data = list(literal.numbers[7:11])
        for index, axis in enumerate(CONFIGURED):
            beyond = [abs(q[axis] - 0.5 * math.pi * (data[index] + 0.5)) - 0.25 * math.pi for q in joints]
            if beyond[0] <= EDGE and beyond[1] > SAME:  # data that are wrong by this model stay as they are
                data[index] = math.floor(joints.after[axis] / (0.5 * math.pi))
        return [plain(number, 0) for number in data] if tuple(data) != literal.numbers[7:11] else []
    if goal.turns is None:
        return []
    turns = goal.turns
    for axis, (old, new) in enumerate(zip(*joints, strict=True)):
        bit = 1 << axis
        fits = abs(old) <= EDGE or (old < 0.0) == bool(turns & bit)  # data that are wrong by this model stay
        if fits and abs(new) > SAME:
            turns = turns | bit if new < 0.0 else turns & ~bit
    return [str(turns)] if turns != goal.turns else []


def marks_of(program: Program) -> list[Replacement]:
    """Return a comment at the end of each line with a move that is not corrected; options as on the command line."""
    reasons: dict[tuple[int, int], list[str]] = {}
    for move in program.moves:
        if move.reason is not None:
            end = program.files[move.place.file].line_end(move.end)
            reasons.setdefault((move.place.file, end), []).append(move.reason.text(option))
    sign = COMMENTS[program.language]
    return [
        Replacement(file, end, end, f" {sign} truearm: not corrected: {'; '.join(dict.fromkeys(texts))}")
        for (file, end), texts in reasons.items()
    ]


def remarks_of(program: Program, changes: Iterable[Replacement], remark: str) -> list[Replacement]:
    """Return a comment at the end of each changed file, if its language has comments there."""
    remarks = []
    for file in sorted({change.file for change in changes} if program.language in COMMENTS else ()):
        data = program.files[file].data
        newline = "\r\n" if b"\r\n" in data else "\n"
        separator = "" if data.endswith(b"\n") else newline
        text = f"{separator}{COMMENTS[program.language]} truearm: {remark}{newline}"
        remarks.append(Replacement(file, len(data), len(data), text))
    return remarks


def changed_files(program: Program, changes: Iterable[Replacement]) -> list[bytes]:
    """Return the files of a program with changes of their text. Raises ValueError if two of them overlap."""
    by_file: list[list[tuple[int, int, str]]] = [[] for _ in program.files]
    for file, start, end, text in changes:
        by_file[file].append((start, end, text))
    return [_replaced(source.data, texts) for source, texts in zip(program.files, by_file, strict=True)]


def _replaced(data: bytes, texts: Iterable[tuple[int, int, str]]) -> bytes:
    """Return data with texts in place of the bytes from a start to an end. Raises ValueError if two overlap."""
    pieces, offset = [], 0
    for start, end, text in sorted(texts):
        if start < offset:
            raise ValueError("two corrections of one place")
        pieces += [data[offset:start], text.encode(*BYTES)]
        offset = end
    return b"".join([*pieces, data[offset:]])


def target_poses(goals: Sequence[Goal]) -> Floats:
    """Return the targets (n, 4, 4) of goals that are poses, in their frames."""
    targets = [goal.target for goal in goals]
    left, right = (
        np.array(sides).reshape(-1, 4, 4) for sides in ([t.left for t in targets], [t.right for t in targets])
    )
    return np.asarray(left @ poses_of([target.literal for target in targets]) @ right)


def difference(
    original: Program,
    corrected: Program,
    goal_poses: Mapping[Goal, Floats],
    joints: Mapping[Goal, Joints],
    joints_change: bool,
) -> str:
    """Return how the moves of a corrected program differ from what is wanted, with file and line; "" if they do not."""
    if len(original.moves) != len(corrected.moves):
        return "the corrected program has another number of moves"
    pairs: list[tuple[Move, Goal, Goal]] = []
    for old, new in zip(original.moves, corrected.moves, strict=True):
        uncertain = bool(old.reason and not old.goals)
        forms = [[goal.target.literal.form for goal in move.goals] for move in (old, new)]
        if old.name != new.name or forms[0] != forms[1] or uncertain != (new.reason is not None):
            return f"{original.where(old.place)}: the corrected move has other targets"
        pairs += [(old, first, second) for first, second in zip(old.goals, new.goals, strict=True)]
    posed = [pair for pair in pairs if not pair[1].is_joints]
    due, actual = target_poses([goal for _, goal, _ in posed]), target_poses([goal for _, _, goal in posed])
    for row, (move, goal, _) in enumerate(posed):
        if move.reason is None:
            due[row] = goal_poses[goal]
    misses = (
        dict(zip((goal for _, goal, _ in posed), np.abs(apart(actual, due)).max(axis=1), strict=True)) if posed else {}
    )
    for move, goal, again in pairs:
        if goal.is_joints:
            is_changed = joints_change and move.reason is None
            readings = joints[goal].after if is_changed else readings_of(goal.target.literal)
            misses[goal] = np.abs(readings_of(again.target.literal) - readings).max()
        is_same = np.array_equal(goal.tool, again.tool) and np.array_equal(goal.frame, again.frame)
        if not misses[goal] <= CLOSE or not is_same:
            return f"{original.where(move.place)}: the corrected move misses its target by {misses[goal]:.3g} m or rad"
    return ""
