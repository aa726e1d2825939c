"""A program after reading: its data, its moves with their goals, and the structure around them.

Every reader of a language returns a ``Program``. The census of uses, the correction and the writer work on it alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from truearm.correct.programs.tokens import Source, Token, Tokens
from truearm.findings import Reason
from truearm.types import Floats

IDENTITY: Floats = np.eye(4)
IDENTITY.flags.writeable = False


class Place(NamedTuple):
    """A byte of one of the files."""

    file: int
    offset: int


class Scope(NamedTuple):
    """From where names are looked up: a file, and the data of each block around, the innermost first."""

    file: int
    blocks: tuple[dict[str, Datum], ...] = ()

    def place(self, token: Token) -> Place:
        """Return the place of a token."""
        return Place(self.file, token.start)

    def find(self, name: str) -> Datum | None:
        """Return the datum of a name, None if no block has it."""
        return next((block[name] for block in self.blocks if name in block), None)


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
    """Where and how (by the code of a finding) a datum gets a value that is not certain."""

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
    values: list[tuple[Tokens, Scope]] = field(default_factory=list)
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

    def by(self, datum: Datum, place: Place) -> Target:
        """Return the target as reached by a use of a name."""
        return replace(self, uses=((datum, place), *self.uses))

    def moved(self, left: Floats = IDENTITY, right: Floats = IDENTITY) -> Target:
        """Return the target between two more poses (4, 4)."""
        return replace(self, left=left @ self.left, right=self.right @ right)


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

    @property
    def is_joints(self) -> bool:
        """Whether the target is joint readings."""
        return self.target.literal.form.is_joints


@dataclass(eq=False)
class Move:
    """A statement that moves the robot. Without a reason it is corrected. ``straight``: along a line."""

    name: str
    place: Place
    end: int
    straight: bool = False
    goals: list[Goal] = field(default_factory=list)
    reason: Reason | None = None


class Step(StrEnum):
    """What stands between moves, in the order of the text.

    ``ELSE`` is a branch that runs if no other does, ``REPEAT`` a loop that runs at least once. ``END`` ends a routine,
    a choice or a loop. ``LEAVE`` leaves or repeats the innermost loop. A ``CALL`` may move the robot elsewhere.
    """

    ROUTINE = "routine"
    IF = "if"
    BRANCH = "branch"
    ELSE = "else"
    LOOP = "loop"
    REPEAT = "repeat"
    LEAVE = "leave"
    END = "end"
    CALL = "call"


@dataclass(eq=False)
class Program:
    """The files that run together.

    ``steps``: moves and the structure around them, in the order of the text (``order.py``). ``absent``: routines that
    none of the files defines. ``origins``: the moves from which each may come, where the steps do not show it.
    ``harmless``: uses of data that a correction may change, such as joints near a target. ``needed_frames``: the names
    of tools and work objects that moves need from outside of the files, "" for a tool without a name. ``texts``: texts
    that contain moves.
    """

    language: str
    files: list[Source]
    moves: list[Move] = field(default_factory=list)
    steps: list[Step | Move] = field(default_factory=list)
    origins: dict[Move, frozenset[Move | None]] = field(default_factory=dict)
    absent: dict[str, None] = field(default_factory=dict)
    harmless: set[Place] = field(default_factory=set)
    needed_frames: set[str] = field(default_factory=set)
    texts: list[Place] = field(default_factory=list)

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

    ``frames``: tools and work objects by name in lower case, "" for the tool of a URScript before it sets one, poses
    (4, 4) [m]. ``unchanged``: data, tools and axes that nothing outside the files changes or moves. ``strict``: a
    routine in none of the files may displace the program and change data.
    """

    frames: Mapping[str, Floats] = field(default_factory=dict)
    unchanged: frozenset[str] = frozenset()
    strict: bool = False
