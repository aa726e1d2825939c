"""A program after reading: data with their uses, literals, and moves with their goals.

Every reader of a language returns a ``Program``. The census of uses, the correction and the writer work on it alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, NamedTuple, TypeVar

import numpy as np

from truearm.correct.programs.tokens import Source, Tokens
from truearm.findings import Finding
from truearm.types import Floats

IDENTITY: Floats = np.eye(4)
IDENTITY.flags.writeable = False
MOST_TARGETS = 1_000  # of one argument, such as the elements of a list
MOST_GOALS = 100_000  # of all moves


class Uncertain(Exception):
    """Why something has no certain value, by a code of ``reasons.py`` with the values of its text."""

    def __init__(self, code: str, **values: object) -> None:
        super().__init__(code)
        self.finding = Finding(code, values)

    def again(self) -> Uncertain:
        """Return the same reason for another move: an exception that is raised again keeps all its tracebacks."""
        return Uncertain(self.finding.code, **self.finding.values)

    def about(self, subject: str) -> Uncertain:
        """Return the same reason as one about a tool, work object or offset."""
        return Uncertain(self.finding.code, **{**self.finding.values, "subject": subject})


T = TypeVar("T")


@dataclass(eq=False)
class Memo:
    """Values and failures of names, each computed once: names that lead to themselves end as "deep"."""

    results: dict[object, Any] = field(default_factory=dict)

    def get(self, key: object, compute: Callable[[], T]) -> T:
        """Return the value of a key, computed if it is not known yet. Raises Uncertain."""
        if key not in self.results:
            self.results[key] = Finding("deep")  # while it is computed
            try:
                self.results[key] = compute()
            except Uncertain as uncertain:
                self.results[key] = uncertain.finding
        result = self.results[key]
        if isinstance(result, Finding):
            raise Uncertain(result.code, **result.values)
        value: T = result
        return value


class Place(NamedTuple):
    """A byte of one of the files."""

    file: int
    offset: int


class Form(StrEnum):
    """How numbers are written: a URScript's p[…], a robtarget, X, Y, Z, A, B, C; joint readings in rad or deg."""

    VECTOR = "vector"
    ROBTARGET = "robtarget"
    ANGLES = "angles"
    RADIANS = "radians"
    DEGREES = "degrees"

    @property
    def is_joints(self) -> bool:
        """Whether the numbers are joint readings."""
        return self in (Form.RADIANS, Form.DEGREES)

    @property
    def size(self) -> int:
        """How many numbers determine the pose or the joints."""
        return 7 if self is Form.ROBTARGET else 6


@dataclass(frozen=True, eq=False)
class Literal:
    """Numbers in the text, in the units of the language.

    ``spans``: the bytes of each number. Numbers beyond the six or seven of the pose are the configuration data:
    cf1, cf4, cf6 of a robtarget, T of a KRL pose.
    """

    place: Place
    end: int
    form: Form
    numbers: tuple[float, ...]
    spans: tuple[tuple[int, int], ...]


class Change(NamedTuple):
    """Where and how (by a code of ``reasons.py``) a datum gets a value that is not certain."""

    place: Place
    code: str
    function: str = ""


@dataclass(eq=False)
class Datum:
    """A name with all values that are ever assigned to it.

    ``kind``: const, pers, var, parameter or counter. ``values``: the tokens of each value with the scope in which its
    names are looked up. ``written``: where a whole value is assigned, which reads nothing. ``uses``: every other place
    of the name. ``changes``: what else may give it another value, as the place and code of a reason and the function
    that does it; ``outside``: the same, by something that is in none of the files.
    """

    name: str
    type: str
    kind: str
    place: Place
    local: bool = False
    values: list[tuple[Tokens, Any]] = field(default_factory=list)
    written: set[Place] = field(default_factory=set)
    uses: set[Place] = field(default_factory=set)
    changes: list[Change] = field(default_factory=list)
    outside: list[Change] = field(default_factory=list)


Uses = tuple[tuple[Datum, Place], ...]


@dataclass(frozen=True, eq=False)
class Target:
    """left · literal · right, poses (4, 4) [m], or joint readings. ``uses``: the names on the way to the literal."""

    literal: Literal
    left: Floats = field(default_factory=lambda: IDENTITY)
    right: Floats = field(default_factory=lambda: IDENTITY)
    uses: Uses = ()


@dataclass(frozen=True, eq=False)
class Goal:
    """Where a move goes: a target in ``frame`` for ``tool`` in the flange, poses (4, 4) [m].

    ``argument``: the bytes that numbers of its own would replace; None if something else depends on them. ``near``:
    joint readings [rad] that choose the configuration. ``quarters``: quarter turns of axes 1, 4 and 6 that choose it,
    as ⌊q / 90°⌋. ``turns``: the sign bits of a KRL pose, with which the configuration must agree.
    """

    target: Target
    tool: Floats = field(default_factory=lambda: IDENTITY)
    frame: Floats = field(default_factory=lambda: IDENTITY)
    argument: tuple[int, int] | None = None
    near: tuple[float, ...] = ()
    quarters: tuple[float, ...] = ()
    turns: int | None = None


@dataclass(eq=False)
class Move:
    """A statement that moves the robot. Without a reason it is corrected. ``straight``: along a line."""

    name: str
    place: Place
    end: int
    straight: bool = False
    goals: list[Goal] = field(default_factory=list)
    reason: Finding | None = None

    def refuse(self, uncertain: Uncertain) -> None:
        """Give up the goals of a move whose targets are not certain."""
        self.goals, self.reason = [], uncertain.finding


class Step(StrEnum):
    """What stands between moves, in the order of the text.

    ``END`` ends a routine, a choice or a loop. ``LEAVE`` leaves or repeats the innermost loop. A ``CALL`` may move the
    robot elsewhere.
    """

    ROUTINE = "routine"
    IF = "if"
    BRANCH = "branch"
    LOOP = "loop"
    LEAVE = "leave"
    END = "end"
    CALL = "call"


@dataclass(eq=False)
class Program:
    """The files that run together.

    ``steps``: moves and the structure around them, in the order of the text (``order.py``). ``absent``: routines that
    none of the files defines. ``origins``: the moves from which each may come, where the steps do not show it. ``harmless``: uses of data that a correction may change, such as joints near a target.
    ``names``: all words; ``declared``: those that the files declare as data. ``texts``: texts that contain moves.
    """

    language: str
    files: list[Source]
    moves: list[Move] = field(default_factory=list)
    steps: list[Step | Move] = field(default_factory=list)
    origins: dict[Move, frozenset[Move | None]] = field(default_factory=dict)
    absent: dict[str, None] = field(default_factory=dict)
    harmless: set[Place] = field(default_factory=set)
    names: set[str] = field(default_factory=set)
    declared: set[str] = field(default_factory=set)
    texts: list[Place] = field(default_factory=list)
    n_goals: int = 0

    def count(self, move: Move) -> None:
        """Count the goals of a move. Raises Uncertain if all moves together have too many."""
        self.n_goals += len(move.goals)
        if self.n_goals > MOST_GOALS:
            raise Uncertain("many", most=MOST_GOALS)

    def where(self, place: Place) -> str:
        """Return the file and line of a place."""
        source = self.files[place.file]
        return f"{source.name} line {source.line(place.offset)}"

    def statement(self, move: Move) -> str:
        """Return the text of a move on one line."""
        data = self.files[move.place.file].data[move.place.offset : move.end]
        return " ".join(data.decode("latin-1").split())


@dataclass(frozen=True)
class Surroundings:
    """What defines a program from outside.

    ``tool``: the tool of a URScript before it sets one. ``frames``: tools and work objects by name in lower case, poses
    (4, 4) [m]. ``unchanged``: data, tools and axes that nothing outside the files changes or moves. ``strict``: a
    routine in none of the files may displace the program and change data.
    """

    tool: Floats | None = None
    frames: Mapping[str, Floats] = field(default_factory=dict)
    unchanged: frozenset[str] = frozenset()
    strict: bool = False


def certain(program: Program, datum: Datum, surroundings: Surroundings) -> None:
    """Raise Uncertain if a datum may have other values than those that are assigned to it as a whole."""
    if datum.kind in ("parameter", "counter"):
        raise Uncertain("parameter", name=datum.name, kind=datum.kind)
    is_trusted = datum.name.lower() in surroundings.unchanged
    for place, code, function in [*datum.changes, *([] if is_trusted else datum.outside)]:
        where = program.where(place)
        raise Uncertain(code, name=datum.name, where=where, function=function, outside=not datum.changes)
    is_visible = datum.kind != "const" and not datum.local
    if surroundings.strict and program.absent and is_visible and not is_trusted:
        raise Uncertain("absent-routine", name=next(iter(program.absent)))
