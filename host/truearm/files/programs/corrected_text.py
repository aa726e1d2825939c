"""A program's text with new numbers for its targets. Every byte that is not a number of a target is unchanged."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from itertools import chain
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from truearm.collector import uncollected
from truearm.files.programs.program import Program, Refused
from truearm.files.programs.syntax import NUMBERS, Form, Taught
from truearm.files.programs.target_poses import LiteralPoses, PoseTarget, literal_poses, matrix_of, values_of
from truearm.files.programs.values import Factor, Goal, Pose, literals_in, plain_literal
from truearm.types import Floats
from truearm.units import DEG, MM

BATCH = 10_000  # literals that are written at a time


class SolvedLiterals(NamedTuple):
    """New poses of the literals, and the targets that depend on each other in a circle."""

    literals: LiteralPoses
    circular: tuple[PoseTarget, ...]


def solved(targets: Sequence[PoseTarget], told: Floats, known: LiteralPoses | None = None) -> SolvedLiterals:
    """Return the literals for which every target has the commanded pose ``told`` (n, 4, 4), each in its frame.

    ``known`` are the original ``literal_poses``.
    """
    known = known or literal_poses(targets)
    literals = LiteralPoses(known.rows, known.matrices.copy())
    plain_of, plain_to = list[int](), list[int]()  # targets that are one literal, and its row
    left: list[tuple[PoseTarget, Taught, Pose, int]] = []
    for i, one in enumerate(targets):
        pose = one.goal.target
        if one.literal is None or not isinstance(pose, Pose):
            continue
        if plain_literal(pose) is not None:
            plain_of.append(i)
            plain_to.append(literals.rows[one.literal.start])
        else:
            left.append((one, one.literal, pose, i))
    literals.matrices[plain_to] = told[plain_of]
    waiting = {literal.start for _, literal, _, _ in left}
    while left:
        ready = [not ({o.start for o in literals_in(pose)} - {literal.start}) & waiting for _, literal, pose, _ in left]
        if not any(ready):
            return SolvedLiterals(literals, tuple(one for one, _, _, _ in left))
        for (_, literal, pose, i), now in zip(left, ready, strict=True):
            if now:
                literals.matrices[literals.rows[literal.start]] = _solved(pose.factors, literal, told[i], literals)
        left = [entry for entry, now in zip(left, ready, strict=True) if not now]
        waiting = {literal.start for _, literal, _, _ in left}
    return SolvedLiterals(literals, ())


def _solved(factors: Sequence[Factor], literal: Taught, goal: Floats, literals: LiteralPoses) -> Floats:
    """Return the literal's matrix for which the product of the factors is the goal (4, 4)."""
    k = next(i for i, factor in enumerate(factors) if factor.pose == literal)
    before, after = (matrix_of(Pose(tuple(part)), literals) for part in (factors[:k], factors[k + 1 :]))
    here = np.linalg.inv(before) @ goal @ np.linalg.inv(after)
    return np.asarray(np.linalg.inv(here) if factors[k].inverse else here)


class Change(NamedTuple):
    """Text that replaces the range from ``start`` to ``end``."""

    start: int
    end: int
    text: str


@uncollected()
def changes_of(program: Program, targets: Sequence[PoseTarget], told: Floats, new: SolvedLiterals) -> list[Change]:
    """Return the changes of the text that give every target its commanded pose."""
    seen = list({one.literal.start: one.literal for one in targets if one.literal is not None}.values())
    out = list[Change]()
    for at in range(0, len(seen), BATCH):
        some = seen[at : at + BATCH]
        poses = new.literals.matrices[[new.literals.rows[literal.start] for literal in some]]
        out += map(_renumbered, some, _pose_texts(some, poses))
    for one, goal in zip(targets, told, strict=True):
        if one.literal is None:
            out.append(Change(one.goal.start, one.goal.end, _written(program, one.goal, goal, new.literals)))
    return list(dict.fromkeys(out))


def joint_changes(literals: Sequence[Taught], q: Floats) -> list[Change]:
    """Return the changes of the text that replace joint readings of literals by q (n, j) [rad]."""
    out = []
    for literal, readings in zip(literals, q, strict=True):
        values, digits = (readings, 10) if literal.form is Form.JOINTS else (DEG.of(readings), 8)
        out.append(_renumbered(literal, [plain(float(value), digits) for value in values]))
    return out


def _renumbered(literal: Taught, texts: Sequence[str]) -> Change:
    """Return a literal with other first numbers."""
    *before, rest = NUMBERS.split(literal.text, len(texts))
    return Change(literal.start, literal.end, "".join([*chain.from_iterable(zip(before, texts, strict=True)), rest]))


def changed_text(program: Program, changes: Iterable[Change]) -> bytes:
    """Return the program with changes of its text; every other byte is unchanged."""
    pieces, at = [], 0
    for change in sorted(changes):
        pieces += [program.source.text[at : change.start], change.text]
        at = change.end
    return "".join([*pieces, program.source.text[at:]]).encode("latin-1")


def marks_of(program: Program, refused: Sequence[Refused]) -> list[Change]:
    """Return a comment at the end of each line whose move is not corrected."""
    sign = "#" if program.language == "urscript" else "!"
    whys: dict[int, list[str]] = {}
    for one in refused:
        whys.setdefault(one.line, []).append(one.why)
    ends = [match.start() for match in re.finditer(r"\r\n|\n|\r|\Z", program.source.text)]
    return [
        Change(
            ends[line - 1],
            ends[line - 1],
            f" {sign} truearm: not corrected: {'; '.join(why)}".encode().decode("latin-1"),
        )
        for line, why in whys.items()
    ]


def _pose_texts(literals: Sequence[Taught], poses: Floats) -> list[list[str]]:
    """Return the numbers of literals as text: 10 nm and 1e-9 of a rotation, finer than a controller's arithmetic."""
    if not literals:
        return []
    rotation = Rotation.from_matrix(poses[:, :3, :3])
    if literals[0].form is Form.POSE:
        old = values_of(literals)[:, 3:]
        six = np.concatenate([poses[:, :3, 3], _near(rotation.as_rotvec(), old)], axis=1)
        return [[plain(value, 9) for value in row] for row in six.tolist()]
    quaternion = rotation.as_quat()[:, [3, 0, 1, 2]]
    old = values_of(literals)[:, 3:7]
    quaternion *= np.where((quaternion * old).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]  # q and −q are the same rotation
    places = [[plain(value, 5) for value in row] for row in MM.of(poses[:, :3, 3]).tolist()]
    return [[*place, *(plain(v, 10) for v in turn)] for place, turn in zip(places, quaternion.tolist(), strict=True)]


def _written(program: Program, goal: Goal, pose: Floats, literals: LiteralPoses) -> str:
    """Return a separate target that replaces an argument."""
    if program.language == "urscript":
        given = goal.near.values if isinstance(goal.near, Taught) else goal.near
        near = f", qnear=[{', '.join(plain(value, 10) for value in given)}]" if given else ""
        tool = f", tcp={_six(matrix_of(goal.tool, literals))}" if goal.own_tool else ""
        return f"get_inverse_kin({_six(pose)}{near}{tool})" if near or tool else _six(pose)
    rotation = Rotation.from_matrix(pose[:3, :3])
    place = ",".join(plain(value, 5) for value in MM.of(pose[:3, 3]))
    turn = ",".join(plain(value, 10) for value in rotation.as_quat()[[3, 0, 1, 2]])
    like = goal.target.like if isinstance(goal.target, Pose) else None
    rest = NUMBERS.findall(like.text)[7:] if like else ["0"] * 4 + ["9E9"] * 6
    return f"[[{place}],[{turn}],[{','.join(rest[:4])}],[{','.join(rest[4:])}]]"


def _six(pose: Floats) -> str:
    """Return a pose (4, 4) as p[…]."""
    turn = Rotation.from_matrix(pose[:3, :3]).as_rotvec()
    return f"p[{', '.join(plain(value, 9) for value in (*pose[:3, 3], *turn))}]"


def _near(turn: Floats, old: Floats) -> Floats:
    """Return rotation vectors with full turns added to be near the old ones: p[…, 0, 3.2, 0] does not become −3.083."""
    angle = np.linalg.norm(turn, axis=1, keepdims=True)
    axis = turn / np.maximum(angle, 1e-12)
    choices = np.stack([axis * (angle + 2.0 * math.pi * k) for k in (-2, -1, 0, 1, 2)])
    best = np.linalg.norm(choices - old, axis=2).argmin(axis=0)
    near = choices[best, np.arange(len(turn))]
    return np.asarray(np.where(angle < 1e-9, turn, near))


def plain(value: float, decimals: int) -> str:
    """Return a number without an exponent, trailing zeros or a negative zero."""
    text = f"{value:.{decimals}f}".rstrip("0").rstrip(".")
    return "0" if text in ("-0", "") else text
