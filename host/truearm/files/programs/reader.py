"""The tokens of a program, taken one after the other by a language's grammar."""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import chain, islice, repeat

from truearm.errors import ProgramError
from truearm.files.programs.syntax import Number
from truearm.files.programs.work import DEEPER, TOKEN, Work
from truearm.schema import quoted

MAX_DEPTH = 60  # nesting depth of brackets and blocks
MAX_LINKS = 1_000  # of a chain of fields, indexes or operators
MOST_NUMBERS = 1_000  # that are stored once
BATCH = 1_000  # tokens that are found at a time
END, BAD = "end", "bad"  # kinds of the last token, and of a character that begins no token
NO_MORE = rf"(?P<{BAD}>(?s:.))|(?P<{END}>\Z)"  # the last choices of each language's pattern
Token = tuple[str, str, int]  # kind, the name of the group in the language's pattern; text; place


def tokens_of(work: Work, pattern: re.Pattern[str], text: str) -> Iterator[Token]:
    """Yield the tokens of a text, by a pattern whose named groups are the kinds.

    The pattern begins with what is skipped, and ends with ``NO_MORE``. The last tokens have kind END. Raises
    ProgramError with the line where nothing is left of ``work``.
    """
    return chain(chain.from_iterable(_batches(work, pattern, text)), repeat((END, "", len(text))))


def _batches(work: Work, pattern: re.Pattern[str], text: str) -> Iterator[list[Token]]:
    found = pattern.finditer(text)
    while batch := [(m.lastgroup or END, m[m.lastindex or 0], m.start(m.lastindex or 0)) for m in islice(found, BATCH)]:
        work.left -= TOKEN * len(batch)
        if work.left < 0:
            raise work.spent(batch[0][2])
        yield batch


class Reader:
    """Tokens taken one after the other, by a language's grammar.

    ``kind``, ``text`` and ``start`` belong to the next token, ``following`` is the text of the token after it. ``last``
    is the place of the token taken last, ``end`` the place after that token. ``text`` is the source's, or the source's
    in lower case.
    """

    __slots__ = (
        "_next",
        "_tokens",
        "depth",
        "elements",
        "end",
        "kind",
        "known",
        "last",
        "numbers",
        "source",
        "start",
        "text",
        "work",
    )

    def __init__(self, work: Work, pattern: re.Pattern[str], text: str) -> None:
        self.work, self.source, self.depth, self.last, self.end = work, work.source, 0, 0, 0
        self._tokens = tokens_of(work, pattern, text)
        self.kind, self.text, self.start = next(self._tokens)
        self._next = next(self._tokens)
        self.known: dict[str, str] = {}  # names, each stored once
        self.numbers: dict[str, Number] = {}  # the first ones, each stored once: speeds and zones repeat
        self.elements = 0  # of lists, by an index

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

    def number(self, text: str, value: float) -> Number:
        """Return a number, as the same object where its text is the same."""
        found = Number(value)
        if len(self.numbers) < MOST_NUMBERS:
            self.numbers[text] = found
        return found

    def wrong(self, what: str) -> ProgramError:
        """Return an error at the reader's position."""
        return self.source.wrong(self.start, what)

    def unexpected(self, wanted: str) -> ProgramError:
        """Return an error: something else was expected here."""
        if self.kind == END:
            return self.wrong(f"the file ends where {wanted} is expected; it is truncated")
        found = self.source.text[self.start : self.start + max(len(self.text), 12 * (self.kind == BAD))]
        if self.kind == BAD:
            return self.wrong(f"{quoted(found)} is not known in this language")
        return self.wrong(f"expected {wanted}, found {quoted(found)}; correct the program")

    def deeper(self) -> None:
        """Count the beginning of a bracket or block; ``depth`` is lowered at its end."""
        self.depth += 1
        self.work.left -= DEEPER
        if self.depth > MAX_DEPTH:
            raise self.wrong(f"is nested more than {MAX_DEPTH} deep")

    def longer(self, links: int) -> None:
        """Check the length of a chain of fields, indexes or operators, each of which contains the one before."""
        if links > MAX_LINKS:
            raise self.wrong("an expression is nested too deeply; split it")
