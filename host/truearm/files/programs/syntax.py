"""What URScript and RAPID have in common once read: expressions, statements, and where in the text each stands.

Both languages are read into this one tree, so that one analysis (``dataflow``) follows values through either. A node keeps the
places (``start``, ``end``) that a message or a change of the text needs, and nothing else of how it was written.
"""

from __future__ import annotations

import re
from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from typing import Literal, NamedTuple

from truearm.errors import ProgramError
from truearm.schema import quoted

_BRACKETS = dict.fromkeys(map(ord, "p[]"))
MAX_DEPTH = 60  # of brackets and blocks within each other
NUMBER = r"(?:[0-9]{1,40}(?:\.[0-9]{0,40})?|\.[0-9]{1,40})(?:[eE][+-]?[0-9]{1,4})?"
NUMBERS = re.compile(rf"[+-]?{NUMBER}")


class Number(NamedTuple):
    """A number."""

    value: float


class Written(NamedTuple):
    """A plain number with its sign, and where it stands."""

    value: float
    start: int
    end: int


class Text(NamedTuple):
    """A string."""

    text: str


class Truth(NamedTuple):
    """True or False."""

    truth: bool


class Name(NamedTuple):
    """A variable, constant or parameter."""

    name: str
    start: int

    @property
    def end(self) -> int:
        """The place behind it."""
        return self.start + len(self.name)


class Form(StrEnum):
    """What a list of plain numbers is that stands in a program as one literal."""

    POSE = "p[…]"  # x, y, z [m], rotation vector [rad]
    ROBTARGET = "robtarget"  # x, y, z [mm], quaternion with the scalar first, configuration, external axes
    JOINTS = "joints"  # readings [rad]
    JOINTTARGET = "jointtarget"  # readings [deg], external axes
    COMPUTED = (
        "computed joints"  # readings [rad] that an expression gives, so that the text is ours; ``start`` is the move
    )


class Taught(NamedTuple):
    """A literal of plain numbers: what a person or an editor wrote or taught there. Its numbers are read where they are asked for."""

    form: Form
    text: str
    start: int

    @property
    def end(self) -> int:
        """The place behind it."""
        return self.start + len(self.text)

    @property
    def values(self) -> tuple[float, ...]:
        """The numbers."""
        return tuple(map(float, self.text.translate(_BRACKETS).split(",")))

    @property
    def numbers(self) -> tuple[Written, ...]:
        """The numbers with their places."""
        found = NUMBERS.finditer(self.text)
        return tuple(Written(float(m[0]), self.start + m.start(), self.start + m.end()) for m in found)


class Items(NamedTuple):
    """A list in brackets; ``pose`` where a p stands before them."""

    items: tuple[Expression, ...]
    pose: bool
    start: int
    end: int


class Call(NamedTuple):
    """A function or instruction with its arguments in order, and those that are given by name."""

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
    """``target = value``; ``scope`` is said where the language says it there."""

    target: Name | Element
    value: Expression
    scope: Literal["global", "local", ""] = ""


class Do(NamedTuple):
    """An expression, mostly a call, for its effect."""

    what: Expression


class If(NamedTuple):
    """One of several blocks; ``whole`` where one of them is always taken."""

    conditions: tuple[Expression, ...]
    blocks: tuple[Block, ...]
    whole: bool


class Loop(NamedTuple):
    """A block that is run any number of times. ``counter``: a variable that counts."""

    condition: Expression | None
    body: Block
    counter: str = ""


class Return(NamedTuple):
    """The end of a routine."""

    value: Expression | None


class Leave(NamedTuple):
    """The end of a loop (break), of a turn of it (continue), or of the program (halt)."""

    what: Literal["break", "continue", "halt"]


class Jump(NamedTuple):
    """A GOTO: what is run next is not followed."""

    start: int


class Parameter(NamedTuple):
    """Of a routine. ``shared``: it is the variable that is given, not a copy."""

    name: str
    default: Expression | None = None
    optional: bool = False
    shared: bool = False


class Routine(NamedTuple):
    """A function, procedure, thread or interrupt routine."""

    name: str
    parameters: tuple[Parameter, ...]
    body: Block
    kind: Literal["routine", "beside"]  # "beside": runs beside or in between the rest, as threads and traps do
    start: int
    handlers: tuple[Block, ...] = ()  # may be run from any place of the body, and go back to it


Statement = Assign | Do | If | Loop | Return | Leave | Jump | Routine
Block = tuple[Statement, ...]


@dataclass(frozen=True)
class Source:
    """A program's text: bytes, one character each (Latin-1), so that every byte that is not changed stays."""

    text: str
    name: str

    @cached_property
    def line_starts(self) -> list[int]:
        """The place of each line's first character; lines end with CR LF, LF or CR."""
        return [0, *(match.end() for match in re.finditer("\r\n|\n|\r", self.text))]

    def line(self, at: int) -> int:
        """The line, from 1, of a place."""
        return bisect_right(self.line_starts, at)

    def wrong(self, at: int, what: str) -> ProgramError:
        """An error with file and line."""
        return ProgramError(f"{self.name} line {self.line(at)}: {what}")


END = "end of the file"
Token = tuple[str, str, int]  # kind, the name of the group of the language's pattern; text; place


def tokens_of(source: Source, pattern: re.Pattern[str]) -> Iterator[Token]:
    """The tokens of a text one after the other, by a pattern whose named groups are the kinds.

    It begins with what is skipped, and matches nothing else where there is no token. The last ones have kind END. Raises ProgramError with the line of what is not a token.
    """
    at, text = 0, source.text
    for match in pattern.finditer(text):
        kind = match.lastgroup
        if kind is None:
            at = match.end()
            break
        start, end = match.span(kind)
        yield kind, text[start:end], start
    if at != len(text):
        raise source.wrong(at, f"{quoted(text[at : at + 12])} is not known in this language")
    while True:
        yield END, "", at


class Reader:
    """Tokens taken one after the other, by a language's grammar.

    ``kind``, ``text`` and ``start`` are of the token that is next, ``following`` is the text of the one behind it, ``last`` and ``end`` are the places of the one
    that was taken last and behind it.
    """

    __slots__ = ("_next", "_tokens", "depth", "end", "kind", "known", "last", "source", "start", "text")

    def __init__(self, source: Source, pattern: re.Pattern[str]) -> None:
        self.source, self.depth, self.last, self.end = source, 0, 0, 0
        self._tokens = tokens_of(source, pattern)
        self.kind, self.text, self.start = next(self._tokens)
        self._next = next(self._tokens)
        self.known: dict[str, str] = {}  # names, each kept once

    def step(self) -> str:
        """Take the token; its text."""
        text, self.last = self.text, self.start
        self.end = self.last + len(text)
        self.kind, self.text, self.start = self._next
        self._next = next(self._tokens)
        return text

    @property
    def following(self) -> str:
        """The text of the token behind the one that is next."""
        return self._next[1]

    def once(self, name: str) -> str:
        """A name, the same object each time."""
        return self.known.setdefault(name, name)

    def wrong(self, what: str) -> ProgramError:
        """An error where the reader stands."""
        return self.source.wrong(self.start, what)

    def unexpected(self, wanted: str) -> ProgramError:
        """An error: something else was wanted here."""
        if self.kind == END:
            return self.wrong(f"the file ends where {wanted} should stand; it is cut short")
        return self.wrong(f"{quoted(self.text)} stands where {wanted} should")

    def deeper(self) -> None:
        """Count a bracket or block that begins; ``depth`` is lowered where it ends."""
        self.depth += 1
        if self.depth > MAX_DEPTH:
            raise self.wrong(f"is nested more than {MAX_DEPTH} deep")


def words(text: str) -> frozenset[str]:
    """The words of a text."""
    return frozenset(text.split())
