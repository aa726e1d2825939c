"""Split a program's text into tokens and statements.

Text that no rule knows becomes tokens of one character, so nothing is rejected. Places are byte offsets: a file is
decoded as Latin-1, in which one character is one byte. Comments are skipped. Every scan over brackets stops at
DEEPEST levels, so the cost is linear in the size of a file from a stranger.
"""

from __future__ import annotations

import re
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

DEEPEST = 40  # brackets in brackets, and names defined by names
DEPTH = {**dict.fromkeys("([{", 1), **dict.fromkeys(")]}", -1)}


class Token(NamedTuple):
    """A word, number, text, sign, newline or row of numbers ([1,2,3] in RAPID and URScript) with its bytes.

    Words of RAPID and KRL are in lower case.
    """

    kind: str
    text: str
    start: int
    end: int


Tokens = Sequence[Token]

_DIGITS = r"(?:\d++\.?+\d*+|\.\d++)(?:[eE][-+]?+\d++)?+"
_NUMBER = rf"(?P<number>{_DIGITS})"
_ROW = rf"(?P<row>\[\s*+[-+]?+{_DIGITS}(?:\s*+,\s*+[-+]?+{_DIGITS})++\s*+\])"
NUMBER = re.compile(r"[^\s,\[\]]+")  # of a row
_FLAGS = re.VERBOSE | re.ASCII | re.DOTALL | re.MULTILINE
RAPID = re.compile(
    rf"""(?:\s++|![^\r\n]*+|%%%.*?%%%)++|(?P<text>"(?:[^"\r\n]|"")*+"?)|{_NUMBER}|(?P<word>[A-Za-z_]\w*+)
    |(?P<row>\[\s*+[-+]?+{_DIGITS}(?:\s*+,\s*+[-+]?+{_DIGITS})*+\s*+\])|(?P<sign>:=|<>|<=|>=|.)""",
    _FLAGS,
)
URSCRIPT = re.compile(
    rf"""(?:^[ \t]*+\$[^\r\n]*+|[ \t\f]++|\#[^\r\n]*+|\xef\xbb\xbf)++|(?P<newline>\r\n|\n|\r|;)
    |(?P<text>"[^"\r\n]*+"|'[^'\r\n]*+')|{_NUMBER}|(?P<word>[A-Za-z_]\w*+)|{_ROW}
    |(?P<sign>==|!=|<=|>=|.)""",
    _FLAGS,
)
KRL = re.compile(
    rf"""(?:[ \t\f]++|;[^\r\n]*+|^&[^\r\n]*+)++|(?P<newline>\r\n|\n|\r)|(?P<text>"[^"\r\n]*+"?)|{_NUMBER}
    |(?P<word>[$\#]?[A-Za-z_]\w*+)|(?P<sign>==|<>|<=|>=|.)""",
    _FLAGS,
)


@dataclass(frozen=True, eq=False)
class Source:
    """A file of a program: its name in messages and its bytes."""

    name: str
    data: bytes

    @property
    def text(self) -> str:
        """The bytes as characters, one each."""
        return self.data.decode("latin-1")

    @cached_property
    def _line_starts(self) -> list[int]:
        return [0, *(match.end() for match in re.finditer(rb"\r\n|\n|\r", self.data))]

    @cached_property
    def script_tokens(self) -> list[Token]:
        """The tokens of a URScript, which are needed twice: to group the files, and to read them."""
        return tokens_of(URSCRIPT, self.text, lower=False)

    def line(self, offset: int) -> int:
        """Return the number of the line with the byte ``offset``, from 1."""
        return bisect_right(self._line_starts, offset)

    def line_end(self, offset: int) -> int:
        """Return the offset of the end of the line with the byte ``offset``, before its line break."""
        match = re.compile(rb"\r|\n|\Z").search(self.data, offset)
        return len(self.data) if match is None else match.start()


def tokens_of(pattern: re.Pattern[str], text: str, lower: bool = True) -> list[Token]:
    """Return the tokens of a text; ``lower``: in lower case."""
    matches = pattern.finditer(text.lower() if lower else text)
    return [Token(kind, match[0], match.start(), match.end()) for match in matches if (kind := match.lastgroup)]


def closing(tokens: Tokens, start: int) -> int:
    """Return the index of the bracket that closes the one at ``start``; the number of tokens if none does."""
    depth = 0
    for index in range(start, len(tokens)):
        depth += DEPTH.get(tokens[index].text, 0)
        if not depth:
            return index
        if depth > DEEPEST:
            break
    return len(tokens)


def is_bracketed(tokens: Tokens, start: int, bracket: str) -> bool:
    """Return whether all tokens from ``start`` on are one pair of brackets and its content."""
    return len(tokens) > start + 1 and tokens[start].text == bracket and closing(tokens, start) == len(tokens) - 1


def separated(tokens: Tokens, *signs: str) -> Iterator[Tokens]:
    """Yield the tokens between signs outside brackets. Every sign but a comma begins the tokens that follow it."""
    depth, begin = 0, 0
    for index, token in enumerate(tokens):
        depth += DEPTH.get(token.text, 0)
        if not depth and token.text in signs and token.kind == "sign":
            yield tokens[begin:index]
            begin = index + (token.text == ",")
    yield tokens[begin:]


def is_word(tokens: Tokens, index: int, text: str) -> bool:
    """Return whether the token at an index is this word or sign."""
    return 0 <= index < len(tokens) and tokens[index].text == text
