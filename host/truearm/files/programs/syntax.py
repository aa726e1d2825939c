"""What URScript and RAPID have in common once read: expressions, statements, and where in the text each stands.

Both languages are read into this one tree, so that one analysis (``dataflow``) follows values through either. A node keeps the
places (``start``, ``end``) that a message or a change of the text needs, and nothing else of how it was written.
"""

from __future__ import annotations

import re
from bisect import bisect_right
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from typing import Literal, NamedTuple

from truearm.errors import ProgramError
from truearm.schema import quoted

MAX_DEPTH = 60  # of brackets and blocks within each other
NUMBER = r"(?:[0-9]{1,40}(?:\.[0-9]{0,40})?|\.[0-9]{1,40})(?:[eE][+-]?[0-9]{1,4})?"


class Number(NamedTuple):
    """A plain number with its sign. ``start`` is −1 for a number that is written nowhere."""

    value: float
    start: int = -1
    end: int = -1


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
    end: int


class Form(Enum):
    """What a list of plain numbers is that stands in a program as one literal."""

    POSE = "p[…]"  # x, y, z [m], rotation vector [rad]
    ROBTARGET = "robtarget"  # x, y, z [mm], quaternion with the scalar first, configuration, external axes
    JOINTS = "joints"  # readings [rad]
    JOINTTARGET = "jointtarget"  # readings [deg], external axes


class Taught(NamedTuple):
    """A literal of plain numbers: what a person or an editor wrote or taught there."""

    form: Form
    numbers: tuple[Number, ...]
    start: int
    end: int


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
    scope: Literal["global", "local", ""]
    start: int
    end: int


class Do(NamedTuple):
    """An expression, mostly a call, for its effect."""

    what: Expression
    start: int
    end: int


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
    """Of a routine."""

    name: str
    default: Expression | None = None
    optional: bool = False


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


class Token(NamedTuple):
    """A piece of a program's text. ``kind``: the name of the group of the language's pattern."""

    kind: str
    text: str
    start: int
    end: int


END = "end of the file"


def tokens_of(source: Source, pattern: re.Pattern[str]) -> list[Token]:
    """The tokens of a text by a pattern whose named groups are the kinds, one of them "skip"; the last has kind END.

    Raises ProgramError with the line of what is no token.
    """
    found, at, text = [], 0, source.text
    for match in pattern.finditer(text):
        start, end = match.span()
        if start != at:
            break
        at = end
        kind = match.lastgroup or ""
        if kind != "skip":
            found.append(Token(kind, match[0], start, end))
    if at != len(text):
        raise source.wrong(at, f"{quoted(text[at : at + 12])} is not known in this language")
    return [*found, Token(END, "", at, at)]


_NUMBERS = re.compile(rf"(?:([+-])\s*)?({NUMBER})")


def numbers_in(text: str, start: int, end: int) -> tuple[Number, ...]:
    """The plain numbers with their signs in a part of a text that holds nothing else but signs and spaces."""
    return tuple(
        Number(float((match[1] or "") + match[2]), match.start(), match.end())
        for match in _NUMBERS.finditer(text, start, end)
    )


class Reader:
    """Tokens taken one after the other, by a language's grammar."""

    def __init__(self, source: Source, tokens: list[Token]) -> None:
        self.source, self.tokens, self.at, self.depth = source, tokens, 0, 0
        self.here = tokens[0]

    def step(self) -> Token:
        """Take the token."""
        token = self.here
        if token.kind != END:
            self.at += 1
            self.here = self.tokens[self.at]
        return token

    def ahead(self, n: int = 1) -> Token:
        """The token n places on."""
        return self.tokens[min(self.at + n, len(self.tokens) - 1)]

    @property
    def before(self) -> Token:
        """The token that was taken last."""
        return self.tokens[max(self.at - 1, 0)]

    def wrong(self, what: str, token: Token | None = None) -> ProgramError:
        """An error where the reader stands."""
        return self.source.wrong((token or self.here).start, what)

    def unexpected(self, wanted: str) -> ProgramError:
        """An error: something else was wanted here."""
        if self.here.kind == END:
            return self.wrong(f"the file ends where {wanted} should stand; it is cut short")
        return self.wrong(f"{quoted(self.here.text)} stands where {wanted} should")

    def deeper(self) -> None:
        """Count a bracket or block that begins; ``depth`` is lowered where it ends."""
        self.depth += 1
        if self.depth > MAX_DEPTH:
            raise self.wrong(f"is nested more than {MAX_DEPTH} deep")


def words(text: str) -> frozenset[str]:
    """The words of a text."""
    return frozenset(text.split())
