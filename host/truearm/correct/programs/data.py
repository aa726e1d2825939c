"""Data of a program: literals, and names with their values and uses."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import NamedTuple

from truearm.correct.programs.tokens import Token, Tokens


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
