"""A program's files with new numbers. Every byte that is not part of a corrected number stays as it is."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple, assert_never

import numpy as np

from truearm.correct.programs.census import Census
from truearm.correct.programs.poses import plain, texts_of_poses, texts_of_readings
from truearm.correct.programs.program import Form, Goal, Literal, Program
from truearm.correct.programs.reasons import reason_text
from truearm.types import Floats

CONFIGURED = (0, 3, 5)  # axes whose quarter turns cf1, cf4 and cf6 of a robtarget give
COMMENTS = {"rapid": "!", "urscript": "#", "krl": ";", "ls": "!"}


class Change(NamedTuple):
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
    census: Census, wanted: Mapping[Goal, Floats], joints: Mapping[Goal, Joints], correct_joints: bool
) -> list[Change]:
    """Return the changes of the text that a census settled on.

    ``wanted``: the poses (4, 4) in their frames of goals that are poses. ``correct_joints``: joint readings change too.
    """
    changes: dict[tuple[int, int], Change] = {}
    goals = [goal for goal, _ in census.poses.values()]
    literals = [goal.target.literal for goal in goals]
    texts = texts_of_poses(literals, np.array([pose for _, pose in census.poses.values()]).reshape(-1, 4, 4))
    numbers = [(goal, literal, text) for goal, literal, text in zip(goals, literals, texts, strict=True)]
    for goal, literal, text in numbers:
        new_numbers = [*text, *configuration_texts(goal, joints.get(goal))]
        _add(changes, literal, new_numbers)
    for move in census.program.moves:
        for goal in move.goals if move.reason is None else ():
            literal = goal.target.literal
            if literal.form.is_joints and not correct_joints:
                continue
            if move in census.own:
                assert goal.argument is not None
                change = Change(move.place.file, *goal.argument, _literal_text(census.program, goal, wanted, joints))
                changes[change.file, change.start] = change
            elif literal.form.is_joints:
                _add(changes, literal, texts_of_readings(literal, joints[goal].after))
    return sorted(changes.values())


def _add(changes: dict[tuple[int, int], Change], literal: Literal, texts: Sequence[str]) -> None:
    for (start, end), text in zip(literal.spans, texts, strict=False):
        changes[literal.place.file, start] = Change(literal.place.file, start, end, text)


def configuration_texts(goal: Goal, joints: Joints | None) -> list[str]:
    """Return the configuration data of a literal, with the quarter turns or signs that the correction crosses."""
    literal = goal.target.literal
    if joints is None or len(joints.after) != 6:
        return []
    if literal.form is Form.ROBTARGET:
        data = list(literal.numbers[7:11])
        for index, axis in enumerate(CONFIGURED):
            old, new = (math.floor(q[axis] / (0.5 * math.pi)) for q in joints)
            if old == data[index]:  # data that are wrong by this model stay as they are
                data[index] = new
        return [plain(number, 0) for number in data] if tuple(data) != literal.numbers[7:11] else []
    if goal.turns is None:
        return []
    old_bits, new_bits = (sum(1 << axis for axis, reading in enumerate(q) if reading < 0.0) for q in joints)
    turns = goal.turns ^ old_bits ^ new_bits
    return [str(turns)] if turns != goal.turns else []


def _literal_text(program: Program, goal: Goal, wanted: Mapping[Goal, Floats], joints: Mapping[Goal, Joints]) -> str:
    """Return a literal with numbers of its own, which replaces the argument of a move."""
    literal = goal.target.literal
    if literal.form.is_joints:
        texts = texts_of_readings(literal, joints[goal].after)
    else:
        texts = [*texts_of_poses([literal], wanted[goal][None])[0], *configuration_texts(goal, joints.get(goal))]
    data = program.files[literal.place.file].data
    texts += [data[start:end].decode("latin-1") for start, end in literal.spans[len(texts) :]]
    match literal.form:
        case Form.VECTOR:
            return f"p[{', '.join(texts)}]"
        case Form.RADIANS:
            return f"[{', '.join(texts)}]"
        case Form.ROBTARGET:
            sizes: tuple[int, ...] = 3, 4, 4, 6
        case Form.DEGREES:
            sizes = 6, 6
        case Form.ANGLES:
            raise AssertionError("a pose of KRL or LS has no numbers of its own")
        case _:
            assert_never(literal.form)
    groups, first = [], 0
    for size in sizes:
        groups.append(f"[{','.join(texts[first : first + size])}]")
        first += size
    return f"[{','.join(groups)}]"


def marks_of(program: Program) -> list[Change]:
    """Return a comment at the end of each line with a move that is not corrected."""
    reasons: dict[tuple[int, int], list[str]] = {}
    for move in program.moves:
        if move.reason is not None:
            end = program.files[move.place.file].line_end(move.end)
            reasons.setdefault((move.place.file, end), []).append(reason_text(move.reason))
    sign = COMMENTS[program.language]
    return [
        Change(file, end, end, f" {sign} truearm: not corrected: {'; '.join(dict.fromkeys(texts))}")
        for (file, end), texts in reasons.items()
    ]


def changed_files(program: Program, changes: Iterable[Change]) -> list[bytes]:
    """Return the files of a program with changes of their text. Raises ValueError if two of them overlap."""
    pieces: list[list[bytes]] = [[] for _ in program.files]
    offsets = [0] * len(program.files)
    for change in sorted(changes):
        if change.start < offsets[change.file]:
            raise ValueError("two corrections of one place")
        data = program.files[change.file].data
        pieces[change.file] += [data[offsets[change.file] : change.start], change.text.encode()]
        offsets[change.file] = change.end
    for source, offset, written in zip(program.files, offsets, pieces, strict=True):
        written.append(source.data[offset:])
    return [b"".join(written) for written in pieces]
