"""A robot's program: which numbers of it each move goes to, and the text with other numbers in their place.

A move's goal is a product of poses (``values.Pose``). One literal of it takes up the correction: the last one, which is the taught point where the others are
features and offsets, unless another move needs it for itself. Two moves that would need two values of one literal are refused with both lines; with ``split``
the later one gets numbers of its own, written where its argument stood. Every byte that is no number of a target stays.
"""

from __future__ import annotations

import gc
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple, assert_never

import numpy as np
from scipy.spatial.transform import Rotation

from truearm.errors import ProgramError
from truearm.files.disk import read_bytes
from truearm.files.programs import rapid_meaning, urscript_meaning
from truearm.files.programs.dataflow import Flow, Motion
from truearm.files.programs.rapid import read_rapid
from truearm.files.programs.syntax import Form, Source, Taught
from truearm.files.programs.urscript import read_urscript
from truearm.files.programs.values import (
    UNIT_QUATERNION,
    Factor,
    Goal,
    Pose,
    Unknown,
    matrices_of,
    matrix_of,
    readings_of,
)
from truearm.text import one_line
from truearm.types import Floats
from truearm.units import DEG, MM, UNITS

MAX_BYTES = 64 * 2**20
MAX_TARGETS = 100_000
RAPID_SUFFIXES = (".mod", ".prg", ".modx", ".sys", ".sysx")
SCRIPT_SUFFIXES = (".script", ".urscript")
QUARTERS = (0, 3, 5)  # joints whose quarter turns a robtarget's configuration names: axes 1, 4 and 6

ProgramLanguage = Literal["urscript", "rapid"]


class Surroundings(NamedTuple):
    """What a program leaves to its surroundings.

    ``tool``: the tool in force before a URScript sets one, None where that is not known. ``frames``: tools and work objects of a RAPID program that are
    declared elsewhere, by name. ``harmless``: routines from elsewhere that do not move the robot.
    """

    tool: Pose | None = None
    frames: Mapping[str, Pose] = {}
    harmless: frozenset[str] = frozenset()


@dataclass(frozen=True)
class Program:
    """A program and its moves, in the order of the text."""

    language: ProgramLanguage
    source: Source
    motions: tuple[Motion, ...]


class Refused(NamedTuple):
    """A move that cannot be corrected: its line, its statement and why; ``remedy``: the argument that would settle it, or ""."""

    line: int
    statement: str
    why: str
    remedy: str = ""


class PoseTarget(NamedTuple):
    """A pose that moves go to. ``literal`` takes up the correction; None where it is written into the move (``split``)."""

    goal: Goal
    literal: Taught | None
    at: int  # of the first move that goes there


class Line(NamedTuple):
    """A straight move: its place, from where and to which pose. A start is a pose, or joint readings."""

    at: int
    start: int | Taught  # a pose's index among the targets' poses
    end: int


class Targets(NamedTuple):
    """What is to be corrected: poses, and joint readings as literals; and the moves that cannot be.

    ``lines`` are the straight moves, of which ``loose`` (by place) may begin elsewhere too.
    """

    poses: tuple[PoseTarget, ...]
    joints: tuple[tuple[Taught, int], ...]
    refused: tuple[Refused, ...]
    lines: tuple[Line, ...]
    loose: tuple[int, ...]


def is_program(path: Path) -> bool:
    """Whether a file is a robot's program, by its suffix."""
    return path.suffix.lower() in (*RAPID_SUFFIXES, *SCRIPT_SUFFIXES)


def language_of(path: Path) -> ProgramLanguage:
    """The language of a program, by its suffix."""
    return "urscript" if path.suffix.lower() in SCRIPT_SUFFIXES else "rapid"


def read_program(path: Path, surroundings: Surroundings) -> Program:
    """Read a program and follow its moves. Raises ProgramError with file and line."""
    return parse_program(read_bytes(path, MAX_BYTES, ProgramError), language_of(path), surroundings, str(path))


@contextmanager
def _uncollected() -> Iterator[None]:
    """Without cyclic garbage collection, which goes through the hundred thousands of tuples of a large program again and again; they have no cycles."""
    was = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was:
            gc.enable()


@_uncollected()
def parse_program(data: bytes, language: ProgramLanguage, surroundings: Surroundings, name: str = "program") -> Program:
    """Follow the moves of a program. Raises ProgramError."""
    source = Source(data.decode("latin-1"), name)
    _check_text(source, data)
    flow: Flow
    match language:
        case "urscript":
            tool = surroundings.tool or Unknown("no set_tcp comes before it, so its tool is not known", 0, "tool")
            flow = urscript_meaning.analyse(source, read_urscript(source), (tool,), surroundings.harmless)
        case "rapid":
            flow = rapid_meaning.analyse(source, read_rapid(source), surroundings.frames, surroundings.harmless)
        case _:
            assert_never(language)
    motions = tuple(flow.motions[start] for start in sorted(flow.motions))
    if not motions:
        raise ProgramError(f"{name}: moves the robot nowhere; there is nothing to correct")
    return Program(language, source, motions)


def _check_text(source: Source, data: bytes) -> None:
    """Refuse what is no text, and a text in two encodings: somebody has put parts together, and names may not agree."""
    if (at := source.text.find("\0")) >= 0:
        raise source.wrong(at, "holds a NUL byte, so it is no program in a one-byte encoding or UTF-8")
    try:
        data.decode("utf-8")
    except UnicodeDecodeError as exc:
        for number, line in enumerate(data.splitlines(), start=1):
            if not line.isascii() and _is_utf8(line):
                text = f"line {source.line(exc.start)} is not UTF-8 and line {number} is; save the file in one encoding"
                raise ProgramError(f"{source.name}: {text}") from exc


def _is_utf8(line: bytes) -> bool:
    try:
        line.decode("utf-8")
    except UnicodeDecodeError:
        return False
    return True


def statement_of(program: Program, motion: Motion) -> str:
    """A move's statement, on one line and short."""
    text = one_line(" ".join(program.source.text[motion.start : motion.end].split()))
    return text if len(text) <= 60 else f"{text[:57]}..."


@_uncollected()
def targets_of(program: Program, joint_moves: bool, split: bool) -> Targets:
    """Which literals take up the corrections. ``joint_moves``: joint readings are corrected too; else they are left.

    Raises ProgramError where there are too many targets.
    """
    refused: list[Refused] = []
    users: dict[Goal, Motion] = {}
    joints: dict[Taught, int] = {}
    fixtures: set[int] = set()  # literals of tools and frames

    def refuse(motion: Motion, why: str, remedy: str) -> None:
        refused.append(Refused(program.source.line(motion.start), statement_of(program, motion), why, remedy))

    for motion in program.motions:
        for why, remedy in motion.problems:
            refuse(motion, why, remedy)
        for goal in motion.goals:
            if isinstance(goal.target, Pose):
                users.setdefault(goal, motion)
                fixtures.update(one.start for pose in (goal.tool, goal.frame) for one in _literals(pose))
            elif joint_moves:
                joints.setdefault(goal.target, motion.start)
    if len(users) + len(joints) > MAX_TARGETS:
        raise ProgramError(
            f"{program.source.name}: has {len(users) + len(joints)} targets, the most is {MAX_TARGETS}; split it"
        )
    poses, index = _assigned(program, users, fixtures, split, refuse)
    for literal in (*(one.literal for one in poses if one.literal), *joints):
        if (absurd := _absurd(literal)) is not None:
            raise program.source.wrong(literal.start, absurd)
    lines = tuple(dict.fromkeys(_lines(program, index)))
    loose = tuple(motion.start for motion in program.motions if not motion.known_starts)
    return Targets(poses, tuple(joints.items()), tuple(sorted(set(refused))), lines, loose)


def _lines(program: Program, index: Mapping[Goal, int]) -> Iterator[Line]:
    """The straight moves from known places to poses; ``index`` has the goals that are corrected."""
    for motion in program.motions:
        for start, end in motion.lines:
            begin = start.target if isinstance(start.target, Taught) else index.get(start)
            if begin is not None and end in index:
                yield Line(motion.start, begin, index[end])


def _assigned(
    program: Program,
    users: Mapping[Goal, Motion],
    fixtures: set[int],
    split: bool,
    refuse: Callable[[Motion, str, str], None],
) -> tuple[tuple[PoseTarget, ...], dict[Goal, int]]:
    """The targets, with a literal for each goal (those with one candidate choose first), and which of them each goal is."""
    holders: dict[int, tuple[Goal, Motion]] = {}
    chosen: dict[Goal, PoseTarget] = {}
    candidates = {goal: _candidates(goal, fixtures) for goal in users}
    for goal in sorted(users, key=lambda one: len(candidates[one])):
        motion = users[goal]
        taken: tuple[Goal, Motion] | None = None
        for literal in candidates[goal]:
            holder = holders.setdefault(literal.start, (goal, motion))
            if _same(holder[0], goal):
                chosen[goal] = PoseTarget(goal, literal, motion.start)
                break
            taken = taken or holder
        if goal in chosen:
            continue
        alone = sum(1 for other in motion.goals if (other.start, other.end) == (goal.start, goal.end)) == 1
        if split and alone and goal.start >= 0:
            chosen[goal] = PoseTarget(goal, None, motion.start)
        elif taken is not None:
            shared, other = (program.source.line(at.start) for at in (candidates[goal][0], taken[1]))
            refuse(
                motion,
                f"it needs other numbers in the target of line {shared} than line {other} does",
                "" if split else "split",
            )
        else:
            refuse(motion, "its target is not written as plain numbers in one place", "" if split else "split")
    unique: dict[object, int] = {}
    index: dict[Goal, int] = {}
    poses: list[PoseTarget] = []
    for goal in users:
        if (one := chosen.get(goal)) is not None:
            index[goal] = unique.setdefault((goal.target, goal.tool, goal.frame, one.literal or goal.start), len(poses))
            poses += [one] * (index[goal] == len(poses))
    return tuple(poses), index


def _same(a: Goal, b: Goal) -> bool:
    """Whether two goals ask the same of a literal."""
    return (a.target, a.tool, a.frame) == (b.target, b.tool, b.frame)


def _literals(pose: Pose) -> Iterable[Taught]:
    return (factor.pose for factor in pose.factors if isinstance(factor.pose, Taught))


def _candidates(goal: Goal, fixtures: set[int]) -> list[Taught]:
    """The literals that may take up a goal's correction, the best first."""
    assert isinstance(goal.target, Pose)
    found = list(_literals(goal.target))
    starts = [one.start for one in found]
    return [one for one in reversed(found) if starts.count(one.start) == 1 and one.start not in fixtures]


def _absurd(literal: Taught) -> str | None:
    """Why a literal cannot be a target."""
    numbers = [number.value for number in literal.numbers]
    match literal.form:
        case Form.POSE | Form.ROBTARGET as form:
            largest = UNITS["m"].largest if form is Form.POSE else float(MM.of(UNITS["m"].largest))
            place = numbers[:6] if form is Form.POSE else numbers[:3]
            far = next((value for value in place if not abs(value) <= largest), None)
            if far is not None:
                return f"{far:g} is not a place that a robot reaches"
            norm = math.hypot(*numbers[3:7]) if form is Form.ROBTARGET else 1.0
            return (
                None
                if abs(norm - 1.0) <= UNIT_QUATERNION
                else f"the orientation is no unit quaternion, its norm is {norm:.4g}"
            )
        case Form.JOINTS | Form.JOINTTARGET:
            far = next((value for value in readings_of(literal) if not abs(value) <= UNITS["rad"].largest), None)
            return None if far is None else f"{far:g} rad is no reading of a joint"
        case _:
            assert_never(literal.form)


# numbers in, numbers out


def poses_of(targets: Sequence[PoseTarget]) -> tuple[Floats, Floats, Floats]:
    """(n, 4, 4) targets in their frames, the frames in the controller's base, and the tools, in m."""
    literals = _matrices(targets)
    rows = [
        [
            matrix_of(pose, literals)
            for pose in (one.goal.target, one.goal.frame, one.goal.tool)
            if isinstance(pose, Pose)
        ]
        for one in targets
    ]
    found = np.array(rows).reshape(-1, 3, 4, 4)
    return found[:, 0], found[:, 1], found[:, 2]


def nears_of(targets: Sequence[PoseTarget], n_joints: int) -> Floats:
    """(n, j) joint readings [rad] near those of each target, NaN where the program says none."""
    out = np.full((len(targets), n_joints), np.nan)
    for i, one in enumerate(targets):
        if one.goal.near is not None and len(one.goal.near) == n_joints:
            out[i] = one.goal.near
    return out


def quarters_of(targets: Sequence[PoseTarget], n_joints: int) -> Floats:
    """(n, j) the quarter turns of axes 1, 4 and 6 by the configurations of robtargets, NaN elsewhere."""
    out = np.full((len(targets), n_joints), np.nan)
    if n_joints == 6:
        for i, one in enumerate(targets):
            like = one.goal.target.like if isinstance(one.goal.target, Pose) else None
            if like is not None:
                out[i, QUARTERS] = [number.value for number in like.numbers[7:10]]
    return out


def _matrices(targets: Sequence[PoseTarget]) -> dict[int, Floats]:
    """The matrices of all literals by their places."""
    found = {
        literal.start: literal
        for one in targets
        for pose in (one.goal.target, one.goal.tool, one.goal.frame)
        if isinstance(pose, Pose)
        for literal in _literals(pose)
    }
    return dict(zip(found, matrices_of(list(found.values())), strict=True))


class Solution(NamedTuple):
    """New matrices of literals by their places, and the targets that depend on each other in a circle."""

    literals: dict[int, Floats]
    circular: tuple[PoseTarget, ...]


def solved(targets: Sequence[PoseTarget], told: Floats) -> Solution:
    """The literals with which every target becomes what is told (n, 4, 4), each in its frame."""
    literals = _matrices(targets)
    waiting = {one.literal.start for one in targets if one.literal is not None}
    left = [(one, goal) for one, goal in zip(targets, told, strict=True) if one.literal is not None]
    while left:
        still = []
        for one, goal in left:
            assert one.literal is not None
            assert isinstance(one.goal.target, Pose)
            others = {literal.start for literal in _literals(one.goal.target)} - {one.literal.start}
            if others & waiting:
                still.append((one, goal))
                continue
            literals[one.literal.start] = (
                goal
                if one.goal.target.factors == (Factor(one.literal),)
                else _solved(one.goal.target.factors, one.literal, goal, literals)
            )
        done = {one.literal.start for one, _ in left if one.literal} - {
            one.literal.start for one, _ in still if one.literal
        }
        if not done:
            return Solution(literals, tuple(one for one, _ in still))
        waiting -= done
        left = still
    return Solution(literals, ())


def _solved(factors: Sequence[Factor], literal: Taught, goal: Floats, literals: Mapping[int, Floats]) -> Floats:
    """The literal's matrix with which the product of the factors is the goal (4, 4)."""
    k = next(i for i, factor in enumerate(factors) if factor.pose == literal)
    before, after = (matrix_of(Pose(tuple(part)), literals) for part in (factors[:k], factors[k + 1 :]))
    here = np.linalg.inv(before) @ goal @ np.linalg.inv(after)
    return np.asarray(np.linalg.inv(here) if factors[k].inverse else here)


class Change(NamedTuple):
    """Text in place of what stands from ``start`` to ``end``."""

    start: int
    end: int
    text: str


@_uncollected()
def changes_of(program: Program, targets: Sequence[PoseTarget], told: Floats, new: Solution) -> list[Change]:
    """The changes of the text with which every target is told."""
    seen: dict[int, Taught] = {one.literal.start: one.literal for one in targets if one.literal is not None}
    poses = np.array([new.literals[start] for start in seen]).reshape(-1, 4, 4)
    out = [
        Change(number.start, number.end, text)
        for literal, texts in zip(seen.values(), _pose_texts(list(seen.values()), poses), strict=True)
        for number, text in zip(literal.numbers, texts, strict=False)
    ]
    for one, goal in zip(targets, told, strict=True):
        if one.literal is None:
            out.append(Change(one.goal.start, one.goal.end, _written(program, one.goal, goal)))
    return list(dict.fromkeys(out))


def joint_changes(literals: Sequence[Taught], q: Floats) -> list[Change]:
    """The changes of the text with joint readings q (n, j) [rad] in place of those of literals."""
    out = []
    for literal, readings in zip(literals, q, strict=True):
        values, digits = (readings, 10) if literal.form is Form.JOINTS else (DEG.of(readings), 8)
        out += [Change(n.start, n.end, plain(float(v), digits)) for n, v in zip(literal.numbers, values, strict=False)]
    return out


def changed_text(program: Program, changes: Iterable[Change]) -> bytes:
    """The program with changes of its text; every other byte is as it was."""
    pieces, at = [], 0
    for change in sorted(changes):
        pieces += [program.source.text[at : change.start], change.text]
        at = change.end
    return "".join([*pieces, program.source.text[at:]]).encode("latin-1")


def marks_of(program: Program, refused: Sequence[Refused]) -> list[Change]:
    """A comment at the end of each line whose move is not corrected."""
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
    """The numbers of literals as text: 10 nm and 1e-9 of a turn, finer than a controller's arithmetic."""
    if not literals:
        return []
    rotation = Rotation.from_matrix(poses[:, :3, :3])
    if literals[0].form is Form.POSE:
        old = np.array([[number.value for number in one.numbers[3:]] for one in literals])
        six = np.concatenate([poses[:, :3, 3], _near(rotation.as_rotvec(), old)], axis=1)
        return [[plain(value, 9) for value in row] for row in six.tolist()]
    quaternion = rotation.as_quat()[:, [3, 0, 1, 2]]
    old = np.array([[number.value for number in one.numbers[3:7]] for one in literals])
    quaternion *= np.where((quaternion * old).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]  # q and −q are one turn
    places = [[plain(value, 5) for value in row] for row in MM.of(poses[:, :3, 3]).tolist()]
    return [[*place, *(plain(v, 10) for v in turn)] for place, turn in zip(places, quaternion.tolist(), strict=True)]


def _written(program: Program, goal: Goal, pose: Floats) -> str:
    """A target of its own, in place of an argument."""
    rotation = Rotation.from_matrix(pose[:3, :3])
    if program.language == "urscript":
        six = ", ".join(plain(value, 9) for value in (*pose[:3, 3], *rotation.as_rotvec()))
        near = f", qnear=[{', '.join(plain(value, 10) for value in goal.near)}]" if goal.near else ""
        return f"get_inverse_kin(p[{six}]{near})" if near else f"p[{six}]"
    place = ",".join(plain(value, 5) for value in MM.of(pose[:3, 3]))
    turn = ",".join(plain(value, 10) for value in rotation.as_quat()[[3, 0, 1, 2]])
    like = goal.target.like if isinstance(goal.target, Pose) else None
    rest = [program.source.text[n.start : n.end] for n in like.numbers[7:]] if like else ["0"] * 4 + ["9E9"] * 6
    return f"[[{place}],[{turn}],[{','.join(rest[:4])}],[{','.join(rest[4:])}]]"


def _near(turn: Floats, old: Floats) -> Floats:
    """Rotation vectors with whole turns added so that they are near the old ones: p[…, 0, 3.2, 0] is no −3.083."""
    angle = np.linalg.norm(turn, axis=1, keepdims=True)
    axis = turn / np.maximum(angle, 1e-12)
    choices = np.stack([axis * (angle + 2.0 * math.pi * k) for k in (-2, -1, 0, 1, 2)])
    best = np.linalg.norm(choices - old, axis=2).argmin(axis=0)
    near = choices[best, np.arange(len(turn))]
    return np.asarray(np.where(angle < 1e-9, turn, near))


def plain(value: float, decimals: int) -> str:
    """Without an exponent, trailing zeros or a negative zero."""
    text = f"{value:.{decimals}f}".rstrip("0").rstrip(".")
    return "0" if text in ("-0", "") else text
