"""The common syntax tree of URScript and RAPID: expressions, statements, and their places in the text.

Both languages are read into this one tree, so that one analysis (``dataflow``) follows values through either. A node
stores the places (``start``, ``end``) that a message or a change of the text needs, and no other formatting.
"""

from __future__ import annotations

import re
from bisect import bisect_right
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from typing import Literal, NamedTuple

from truearm.errors import ProgramError

NO_NUMBERS = dict.fromkeys(map(ord, "p[] \t\r\n\f\v"))  # of a literal; its numbers are left, between commas
NUMBER = r"(?:[0-9]{1,40}(?:\.[0-9]{0,40})?|\.[0-9]{1,40})(?:[eE][+-]?[0-9]{1,4})?"
SIGNED = rf"(?:[+-]\s*)?{NUMBER}"
NUMBERS = re.compile(SIGNED, re.ASCII)


class Number(NamedTuple):
    """A number; ``origin``: the literals from whose numbers it is computed."""

    value: float
    origin: frozenset[Taught] = frozenset()


class Written(NamedTuple):
    """A plain number with its sign, and its place."""

    value: float
    start: int
    end: int


class Text(NamedTuple):
    """A string."""

    text: str


class Truth(NamedTuple):
    """True or False."""

    truth: bool
    type: str = "bool"  # without it, True would equal the number 1


class Name(NamedTuple):
    """A variable, constant or parameter."""

    name: str
    start: int

    @property
    def end(self) -> int:
        """Return the place after it."""
        return self.start + len(self.name)


class Form(StrEnum):
    """The type of a list of plain numbers that is one literal in a program."""

    POSE = "p[…]"  # x, y, z [m], rotation vector [rad]
    ROBTARGET = "robtarget"  # x, y, z [mm], quaternion with the scalar first, configuration, external axes
    JOINTS = "joints"  # readings [rad]
    JOINTTARGET = "jointtarget"  # readings [deg], external axes
    COMPUTED = (
        "computed joints"  # readings [rad] from an expression, so the new text is truearm's; ``start`` is the move
    )


class Taught(NamedTuple):
    """A literal of plain numbers, as a person or an editor wrote or taught it. Its numbers are read on demand."""

    form: Form
    text: str
    start: int

    @property
    def end(self) -> int:
        """Return the place after it."""
        return self.start + len(self.text)

    @property
    def values(self) -> tuple[float, ...]:
        """Return the numbers."""
        return tuple(map(float, self.text.translate(NO_NUMBERS).split(",")))

    @property
    def numbers(self) -> tuple[Written, ...]:
        """Return the numbers with their places."""
        found = NUMBERS.finditer(self.text)
        return tuple(
            Written(value, self.start + m.start(), self.start + m.end())
            for value, m in zip(self.values, found, strict=True)
        )


class Items(NamedTuple):
    """A list in brackets; ``pose`` if it starts with p."""

    items: tuple[Expression, ...]
    pose: bool
    start: int
    end: int


class Call(NamedTuple):
    """A function or instruction with its arguments in order, and its named arguments."""

    function: str
    arguments: tuple[Expression, ...]
    named: tuple[tuple[str, Expression], ...]
    start: int
    end: int


class Element(NamedTuple):
    """An element of a list, counted from 0, or a field of a record."""

    of: Expression
    at: Expression | str
    start: int
    end: int


class Operation(NamedTuple):
    """An operator with one operand or two."""

    sign: str
    operands: tuple[Expression, ...]
    start: int
    end: int


Expression = Number | Text | Truth | Name | Taught | Items | Call | Element | Operation


class Assign(NamedTuple):
    """``target = value``; ``scope`` if the language states it there."""

    target: Name | Element
    value: Expression
    scope: Literal["global", "local", ""] = ""


class Do(NamedTuple):
    """An expression, usually a call, for its effect."""

    what: Expression


class If(NamedTuple):
    """One of several blocks; ``whole`` if one of them is always taken."""

    conditions: tuple[Expression, ...]
    blocks: tuple[Block, ...]
    whole: bool


class Loop(NamedTuple):
    """A block that is executed any number of times. ``counter``: a variable that counts from one of ``bounds`` to the next."""

    condition: Expression | None
    body: Block
    counter: str = ""
    bounds: tuple[Expression, ...] = ()  # first value, last value, and step if it is given


class Return(NamedTuple):
    """The end of a routine."""

    value: Expression | None


class Leave(NamedTuple):
    """The end of a loop (break), of one pass of it (continue), or of the program (halt)."""

    what: Literal["break", "continue", "halt"]


class Jump(NamedTuple):
    """A GOTO: the next statement is not followed."""

    start: int


class Parameter(NamedTuple):
    """A parameter of a routine. ``shared``: it is the passed variable, not a copy."""

    name: str
    default: Expression | None = None
    optional: bool = False
    shared: bool = False


class Routine(NamedTuple):
    """A function, procedure, thread or interrupt routine.

    ``inner``: the routines defined in it, but not those within them; ``calls``: names that a RAPID routine calls;
    ``jumps``: whether it contains a Jump; ``constants``: data of its own that nothing may assign.
    """

    name: str
    parameters: tuple[Parameter, ...]
    body: Block
    kind: Literal["routine", "beside"]  # "beside": runs concurrently or in between, as threads and traps do
    start: int
    handlers: tuple[Block, ...] = ()  # may be executed from any place of the body, and return to it
    inner: tuple[Routine, ...] = ()
    calls: frozenset[str] = frozenset()
    jumps: bool = False
    constants: frozenset[str] = frozenset()


Statement = Assign | Do | If | Loop | Return | Leave | Jump | Routine
Block = tuple[Statement, ...]


@dataclass(frozen=True)
class Source:
    """A program's text: bytes, one character each (Latin-1), so that unchanged bytes are preserved."""

    text: str
    name: str

    @cached_property
    def line_starts(self) -> list[int]:
        """Return the place of each line's first character; lines end with CR LF, LF or CR."""
        return [0, *(match.end() for match in re.finditer("\r\n|\n|\r", self.text))]

    def line(self, at: int) -> int:
        """Return the line, from 1, of a place."""
        return bisect_right(self.line_starts, at)

    def wrong(self, at: int, what: str) -> ProgramError:
        """Return an error with file and line."""
        return ProgramError(f"{self.name} line {self.line(at)}: {what}")


def words(text: str) -> frozenset[str]:
    """Return the words of a text."""
    return frozenset(text.split())
