"""Moves that a program sends as text to another program, which runs them uncorrected."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

from truearm.files.programs.syntax import Text
from truearm.files.programs.urscript_words import AIMLESS, MOVES
from truearm.files.programs.values import Unknown, Value

_SCRIPT = rf"\b(?:{'|'.join(sorted(frozenset(MOVES) | AIMLESS))})[ \t]*\("
_RAPID = r"(?i:\bmove(?:l|j|c|absj)\b[ \t\\]*[a-z\[])"  # and a name, a target or a switch
_MOVE = re.compile(f"{_SCRIPT}|{_RAPID}")


def why_sent(values: Iterable[Value]) -> str | None:
    """Return why a statement that sends one of these values is refused; None if none is known to contain a move."""
    texts = (value.text for value in values if isinstance(value, Text))
    found = next((match for text in texts if (match := _MOVE.search(text))), None)
    if found is None:
        return None
    word = re.split(r"\W", found[0])[0]
    return f"it sends a {word} as text, which truearm does not correct; correct the program that the text is for"


def text_of(given: Sequence[Value], at: int) -> Value:
    """Return texts put together; if only the run knows one, those that are known, if they contain a move."""
    texts = [one.text for one in given if isinstance(one, Text)]
    if len(texts) < len(given) and not any(map(_MOVE.search, texts)):
        return Unknown("a text is put together at run time", at)
    return Text("".join(texts))


def sum_of(given: Sequence[Value], at: int) -> Value:
    """Return a sum with texts, of which only a move is followed: other texts would multiply the possibilities."""
    found = _MOVE.search("".join(one.text for one in given if isinstance(one, Text)))
    return Unknown("a text is put together at run time", at) if found is None else Text(found[0])
