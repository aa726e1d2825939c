"""What the readers of all languages share.

The words of a language, reasons, values that are computed once, sums of constants, moves with their goals, poses of
literals, and the numbers that a literal needs for a pose.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from typing import Any, TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from truearm.correct.programs.program import Datum, Form, Goal, Literal, Move, Place, Program, Scope, Step, Surroundings
from truearm.correct.programs.tokens import Tokens, is_bracketed, separated
from truearm.findings import Reason
from truearm.model.transforms import pose_of
from truearm.types import Floats
from truearm.units import DEG, MM, UNITS

MOST_TARGETS = 1_000  # of one argument, such as the elements of a list
MOST_GOALS = 100_000  # of all moves
T = TypeVar("T")
UNIT_QUATERNION = 1e-3  # largest deviation of a quaternion's norm from 1


@cache
def table_of(language: str) -> dict[str, Any]:
    """Return the table of a language as it is written."""
    text = resources.files(__package__).joinpath("words.toml").read_text("utf-8")
    return dict(tomllib.loads(text)[language])


def words_of(language: str) -> dict[str, frozenset[str]]:
    """Return the lists of words by their names."""
    return {name: frozenset(text.split()) for name, text in table_of(language).items() if isinstance(text, str)}


def steps_of(language: str) -> dict[str, Step]:
    """Return what each word that begins, continues or ends a block is between moves."""
    return {word: Step(step) for step, text in table_of(language)["steps"].items() for word in text.split()}


class Uncertain(Exception):
    """Why something has no certain value, by the name of a reason with its values."""

    def __init__(self, name: str, /, **values: object) -> None:
        super().__init__(name)
        self.reason = Reason(name, values)

    def again(self, **values: object) -> Uncertain:
        """Return the same reason, with values: an exception that is raised again keeps all its tracebacks."""
        return Uncertain(self.reason.name, **{**self.reason.values, **values})


@dataclass(eq=False)
class Reading:
    """A program while it is read. ``results``: values and failures of names, each computed once.

    ``displaced``: why no pose of the program is certain.
    """

    program: Program
    surroundings: Surroundings
    displaced: Uncertain | None = None
    results: dict[object, Any] = field(default_factory=dict)
    n_goals: int = 0

    def once(self, key: object, compute: Callable[[], T]) -> T:
        """Return the value of a key, computed if it is not known yet. Raises Uncertain."""
        if key not in self.results:
            self.results[key] = Uncertain("deep", circular=True)  # while it is computed
            try:
                self.results[key] = compute()
            except Uncertain as uncertain:
                self.results[key] = uncertain.again()
        result = self.results[key]
        if isinstance(result, Uncertain):
            raise result.again()
        value: T = result
        return value

    def through(self, datum: Datum, evaluate: Callable[[Tokens, Scope], list[T]], key: object = None) -> list[T]:
        """Return what a name stands for, as ``evaluate`` and ``key`` understand it. Raises Uncertain."""
        self.check(datum)
        if not datum.values:
            raise Uncertain("no-value", name=datum.name)
        return self.once((datum, key), lambda: self.all_values(datum.values, evaluate))

    def all_values(
        self, values: Iterable[tuple[Tokens, Scope]], evaluate: Callable[[Tokens, Scope], list[T]]
    ) -> list[T]:
        """Return what values, each with its scope, stand for. Raises Uncertain, with where a value is computed."""
        alternatives: list[T] = []
        for tokens, scope in values:
            try:
                alternatives += evaluate(tokens, scope)
            except Uncertain as uncertain:
                if uncertain.reason.name != "run-time" or "where" in uncertain.reason.values or not tokens:
                    raise
                raise uncertain.again(where=self.program.where(scope.place(tokens[0]))) from None
            if len(alternatives) > MOST_TARGETS:
                raise Uncertain("many", most=MOST_TARGETS)
        return alternatives

    def check(self, datum: Datum) -> None:
        """Raise Uncertain if a datum may have other values than those that are assigned to it as a whole."""
        if datum.kind in ("parameter", "counter"):
            raise Uncertain("parameter", name=datum.name, kind=datum.kind)
        is_trusted = datum.name.lower() in self.surroundings.unchanged
        for place, code, function in [*datum.changes, *([] if is_trusted else datum.outside)]:
            location = self.program.where(place)
            raise Uncertain(code, name=datum.name, where=location, function=function, outside=not datum.changes)
        is_visible = datum.kind != "const" and not datum.local
        if is_visible and not is_trusted:
            self.check_absent()

    def given(self, name: str, otherwise: Uncertain) -> Floats:
        """Return the tool or work object that is given by a name. Raises ``otherwise`` if it is not."""
        self.program.needed_frames.add(name)
        if name not in self.surroundings.frames:
            raise otherwise
        return self.surroundings.frames[name]

    def check_displacement(self) -> None:
        """Raise Uncertain if no pose is certain."""
        if self.displaced is not None:
            raise self.displaced.again()
        self.check_absent()

    def check_absent(self) -> None:
        """Raise Uncertain if a routine in none of the files may do anything."""
        if self.surroundings.strict and self.program.absent:
            raise Uncertain("absent-routine", name=next(iter(self.program.absent)))

    def displace(self, code: str, name: str, place: Place) -> None:
        """Note why no pose is certain."""
        self.displaced = self.displaced or Uncertain(code, name=name, where=self.program.where(place))

    def add_move(self, move: Move, goals: Callable[[], list[Goal]]) -> None:
        """Add a move with its goals, or with the reason why they are not certain."""
        self.program.moves.append(move)
        self.program.steps.append(move)
        try:
            move.goals = goals()
            self.n_goals += len(move.goals)
            if self.n_goals > MOST_GOALS:
                raise Uncertain("many", most=MOST_GOALS)
        except Uncertain as uncertain:
            move.goals, move.reason = [], uncertain.reason
        except RecursionError:
            move.goals, move.reason = [], Reason("deep")


def common_pose(poses: Sequence[Floats], otherwise: Uncertain) -> Floats:
    """Return the pose (4, 4) that all of ``poses`` are. Raises ``otherwise`` if they differ or are none."""
    if not poses or np.ptp(poses, axis=0).max() > 1e-12:
        raise otherwise
    return poses[0]


def arithmetic(tokens: Tokens, evaluate: Callable[[Tokens], T]) -> T | float | None:
    """Return the value of a number, a sum, a product or an expression in brackets, None of others. Raises Uncertain.

    ``evaluate`` returns the value of what is in brackets or of an operand, which must be a number, or raises Uncertain.
    """
    if len(tokens) == 1 and tokens[0].kind == "number":
        return float(tokens[0].text)
    if is_bracketed(tokens, 0, "("):
        return evaluate(tokens[1:-1])
    for signs in ("+-", "*/"):
        operands = list(separated(tokens, *signs))
        if len(operands) > 1:
            break
    else:
        return None
    total = 0.0
    for operand in operands if operands[0] or signs == "*/" else operands[1:]:  # the first operand may have a sign
        sign = operand[0].text if operand and operand[0].text in signs else ""
        value = evaluate(operand[bool(sign) :])
        if not isinstance(value, float) or (sign == "/" and not value):
            raise Uncertain("run-time")
        if sign == "*":
            total *= value
        elif sign == "/":
            total /= value
        else:
            total += -value if sign == "-" else value
    return total


def matrix_of_angles(x: float, y: float, z: float, a: float, b: float, c: float) -> Floats:
    """Return the pose (4, 4) at x, y, z [mm], rotated by a, b, c [deg] about z, the new y and the new x."""
    return np.asarray(_poses(Form.ANGLES, np.array([[x, y, z, a, b, c]]))[0])


def matrix_of_quaternion(xyz: Sequence[float], quaternion: Sequence[float]) -> Floats:
    """Return the pose (4, 4) at xyz [mm], rotated by a quaternion, scalar first.

    Raises Uncertain if it is no unit one.
    """
    check_quaternion(quaternion)
    return np.asarray(_poses(Form.ROBTARGET, np.array([[*xyz, *quaternion]]))[0])


def check_quaternion(quaternion: Sequence[float]) -> None:
    """Raise Uncertain unless a quaternion has the norm 1."""
    norm = math.hypot(*quaternion)
    if not abs(norm - 1.0) <= UNIT_QUATERNION:
        raise Uncertain("quaternion", norm=norm)


def check_reach(literal: Literal) -> None:
    """Raise Uncertain for numbers that no robot can reach."""
    if literal.form is Form.ROBTARGET:
        check_quaternion(literal.numbers[3:7])
    number, largest = max(literal.numbers[:6], key=abs), UNITS["m"].largest
    if not abs(number) <= (largest if literal.form in (Form.VECTOR, Form.RADIANS) else MM.of(largest)):
        raise Uncertain("range", number=number)


def poses_of(literals: Sequence[Literal]) -> Floats:
    """Return the poses (n, 4, 4) [m] of literals; NaN for joint readings."""
    poses = np.full((len(literals), 4, 4), np.nan)
    for form in {literal.form for literal in literals if not literal.form.is_joints}:
        rows = [row for row, literal in enumerate(literals) if literal.form is form]
        poses[rows] = _poses(form, np.array([literals[row].numbers[: form.size] for row in rows]))
    return poses


def _poses(form: Form, numbers: Floats) -> Floats:
    """Return the poses (n, 4, 4) [m] of numbers (n, 6 or 7) that are no joint readings."""
    xyz, angles = numbers[:, :3], numbers[:, 3:]
    if form is Form.VECTOR:  # m and rad
        return pose_of(xyz, angles)
    if form is Form.ROBTARGET:
        rotation = Rotation.from_quat(np.roll(angles, -1, axis=1))  # SciPy's scalar is the last
    else:
        rotation = Rotation.from_euler("ZYX", angles, degrees=True)
    poses = np.tile(np.eye(4), (len(numbers), 1, 1))
    poses[:, :3, 3], poses[:, :3, :3] = MM.to_si(xyz), rotation.as_matrix()
    return poses


def readings_of(literal: Literal) -> Floats:
    """Return the joint readings [rad] of a literal of six."""
    readings = np.array(literal.numbers[:6])
    return np.asarray(DEG.to_si(readings)) if literal.form is Form.DEGREES else readings


def texts_of_readings(literal: Literal, readings: Floats) -> list[str]:
    """Return joint readings (6,) [rad] as the numbers of a literal, to 1e-10 rad or 1e-8 deg."""
    if literal.form is Form.DEGREES:
        return [plain(value, 8) for value in DEG.of(readings)]
    return [plain(value, 10) for value in readings.tolist()]


def texts_of_poses(literals: Sequence[Literal], poses: Floats) -> list[list[str]]:
    """Return poses (n, 4, 4) as the numbers of literals: to 1 nm (mm: 10 nm) and 1e-9 of a rotation.

    A rotation vector is the one nearest to the literal's own, and so are a quaternion's sign and whole turns of angles.
    """
    texts: list[list[str]] = [[] for _ in literals]
    for form in {literal.form for literal in literals}:
        rows = [row for row, literal in enumerate(literals) if literal.form is form]
        turn = Rotation.from_matrix(poses[rows, :3, :3])
        old = np.array([literals[row].numbers[3 : form.size] for row in rows])
        xyz = poses[rows, :3, 3]
        if form is Form.ROBTARGET:
            angles, decimals = np.roll(turn.as_quat(), 1, axis=1), (5, 10)
            angles *= np.where((angles * old).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]
        else:
            is_vector = form is Form.VECTOR
            angles = _nearest_vectors(turn.as_rotvec(), old) if is_vector else _nearest_angles(turn, old)
            decimals = (9, 9) if is_vector else (6, 8)
        numbers = np.concatenate([xyz if form is Form.VECTOR else MM.of(xyz), angles], axis=1)
        for row, values in zip(rows, numbers.tolist(), strict=True):
            texts[row] = [plain(value, decimals[column > 2]) for column, value in enumerate(values)]
    return texts


def _nearest_vectors(vectors: Floats, old: Floats) -> Floats:
    """Return rotation vectors (n, 3) with whole turns added to be nearest to the old ones."""
    angle = np.linalg.norm(vectors, axis=1, keepdims=True)
    axis = vectors / np.maximum(angle, 1e-12)
    alternatives = np.stack([axis * (angle + 2.0 * np.pi * turns) for turns in (-2, -1, 0, 1, 2)])
    nearest = np.linalg.norm(alternatives - old, axis=2).argmin(axis=0)
    return np.asarray(np.where(angle < 1e-9, vectors, alternatives[nearest, np.arange(len(vectors))]))


def _nearest_angles(turn: Rotation, old: Floats) -> Floats:
    """Return A, B, C (n, 3) [deg] or the other angles of the same rotation, whichever are nearer to the old ones."""
    angles = turn.as_euler("ZYX", degrees=True)
    mirrored = np.stack([angles[:, 0] + 180.0, 180.0 - angles[:, 1], angles[:, 2] + 180.0], axis=1)
    alternatives = np.stack([solution + 360.0 * np.round((old - solution) / 360.0) for solution in (angles, mirrored)])
    nearest = np.abs(alternatives - old).max(axis=2).argmin(axis=0)
    return np.asarray(alternatives[nearest, np.arange(len(angles))])


def plain(value: float, decimals: int) -> str:
    """Return a number without an exponent, trailing zeros or a negative zero."""
    text = f"{value:.{decimals}f}".rstrip("0").rstrip(".")
    return "0" if text in ("-0", "") else text
