"""The common syntax tree of URScript and RAPID: expressions, statements, and their places in the text.

Both languages are read into this one tree, so that one analysis (``dataflow``) follows values through either. A node
stores the places (``start``, ``end``) that a message or a change of the text needs, and no other formatting.
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
MAX_DEPTH = 60  # nesting depth of brackets and blocks
MAX_LINKS = 1_000  # of a chain of fields, indexes or operators
NUMBER = r"(?:[0-9]{1,40}(?:\.[0-9]{0,40})?|\.[0-9]{1,40})(?:[eE][+-]?[0-9]{1,4})?"
NUMBERS = re.compile(rf"[+-]?{NUMBER}")


class Number(NamedTuple):
    """A number."""

    value: float


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
        return tuple(map(float, self.text.translate(_BRACKETS).split(",")))

    @property
    def numbers(self) -> tuple[Written, ...]:
        """Return the numbers with their places."""
        found = NUMBERS.finditer(self.text)
        return tuple(Written(float(m[0]), self.start + m.start(), self.start + m.end()) for m in found)


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
    """A block that is executed any number of times. ``counter``: a variable that counts."""

    condition: Expression | None
    body: Block
    counter: str = ""


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
    """A function, procedure, thread or interrupt routine."""

    name: str
    parameters: tuple[Parameter, ...]
    body: Block
    kind: Literal["routine", "beside"]  # "beside": runs concurrently or in between, as threads and traps do
    start: int
    handlers: tuple[Block, ...] = ()  # may be executed from any place of the body, and return to it


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


END = "end of the file"
Token = tuple[str, str, int]  # kind, the name of the group in the language's pattern; text; place


def tokens_of(source: Source, pattern: re.Pattern[str]) -> Iterator[Token]:
    """Yield the tokens of a text, by a pattern whose named groups are the kinds.

    The pattern begins with what is skipped, and matches nothing else if there is no token. The last tokens have kind
    END. Raises ProgramError with the line for text that is not a token.
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

    ``kind``, ``text`` and ``start`` belong to the next token, ``following`` is the text of the token after it. ``last``
    is the place of the token taken last, ``end`` the place after that token.
    """

    __slots__ = ("_next", "_tokens", "depth", "end", "kind", "known", "last", "source", "start", "text")

    def __init__(self, source: Source, pattern: re.Pattern[str]) -> None:
        self.source, self.depth, self.last, self.end = source, 0, 0, 0
        self._tokens = tokens_of(source, pattern)
        self.kind, self.text, self.start = next(self._tokens)
        self._next = next(self._tokens)
        self.known: dict[str, str] = {}  # names, each stored once

    def step(self) -> str:
        """Take the token; return its text."""
        text, self.last = self.text, self.start
        self.end = self.last + len(text)
        self.kind, self.text, self.start = self._next
        self._next = next(self._tokens)
        return text

    @property
    def following(self) -> str:
        """Return the text of the token after the next one."""
        return self._next[1]

    def once(self, name: str) -> str:
        """Return a name, always as the same object."""
        return self.known.setdefault(name, name)

    def wrong(self, what: str) -> ProgramError:
        """Return an error at the reader's position."""
        return self.source.wrong(self.start, what)

    def unexpected(self, wanted: str) -> ProgramError:
        """Return an error: something else was expected here."""
        if self.kind == END:
            return self.wrong(f"the file ends where {wanted} is expected; it is truncated")
        return self.wrong(f"expected {wanted}, found {quoted(self.text)}")

    def deeper(self) -> None:
        """Count the beginning of a bracket or block; ``depth`` is lowered at its end."""
        self.depth += 1
        if self.depth > MAX_DEPTH:
            raise self.wrong(f"is nested more than {MAX_DEPTH} deep")

    def longer(self, links: int) -> None:
        """Check the length of a chain of fields, indexes or operators, each of which contains the one before."""
        if links > MAX_LINKS:
            raise self.wrong("an expression is nested too deeply; split it")


def words(text: str) -> frozenset[str]:
    """Return the words of a text."""
    return frozenset(text.split())
