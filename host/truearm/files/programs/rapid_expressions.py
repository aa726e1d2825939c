"""The words and expressions of RAPID, from which ``rapid`` builds statements and modules."""

from __future__ import annotations

import re

from truearm.files.programs.reader import NO_MORE, Reader
from truearm.files.programs.syntax import (
    NUMBER,
    SIGNED,
    Call,
    Element,
    Expression,
    Form,
    Items,
    Name,
    Number,
    Operation,
    Taught,
    Text,
    Truth,
)
from truearm.files.programs.work import Work

_N = rf"\s*{SIGNED}\s*"


def _list(n: int) -> str:
    return rf"\s*\[{_N}(?:,{_N}){{{n - 1}}}\]\s*"


TOKENS = re.compile(
    rf"""(?:\s++|![^\r\n]*+|\xef\xbb\xbf|%%%[^%]*+%%%)*+
    (?:(?P<robtarget>\[{_list(3)},{_list(4)},{_list(4)},{_list(6)}\])|(?P<jointtarget>\[{_list(6)},{_list(6)}\])
    |(?P<number>0x[0-9a-f]+|0o[0-7]+|0b[01]+|{NUMBER})|(?P<word>[a-z\x80-\xff][\w\x80-\xff]*+)|(?P<string>"[^"\r\n]*+(?:""[^"\r\n]*+)*+")
    |(?P<sign><(?:[tdr]dn|smt)>|:=|<>|<=|>=|[-+*/()\[\]{{}},:;=<>.\\?%|])|{NO_MORE})""",
    re.VERBOSE | re.ASCII,
)
_BINDS = {"or": 1, "xor": 1, "and": 2, "=": 4, "<>": 4, "<": 4, ">": 4, "<=": 4, ">=": 4}
_BINDS |= {"+": 5, "-": 5, "*": 6, "/": 6, "div": 6, "mod": 6}
_NOT, _MINUS = 3, 7
_SIGNS, _AFTER_OPERAND = frozenset({"not", "-", "+"}), frozenset({",", ";", ")", "]", "}"})
PASSED = r"\?"  # represents \name?parameter: the parameter, if it is given
ENDS = {"proc": "endproc", "func": "endfunc", "trap": "endtrap"}
CLOSING = frozenset(
    {*ENDS.values(), "else", "elseif", "endif", "endfor", "endwhile", "endtest", "case", "default", "error", "undo", "backward"}
)  # fmt: skip
NO_NAMES = CLOSING | {
    "module",
    "endmodule",
    "proc",
    "func",
    "trap",
    "if",
    "then",
    "for",
    "while",
    "do",
    "test",
    "var",
    "pers",
    "const",
}


class ExpressionReader(Reader):
    """Expressions by recursive descent. ``text`` is in lower case."""

    def __init__(self, work: Work) -> None:
        super().__init__(work, TOKENS, work.source.text.lower())  # each of ISO 8859-1's letters becomes one letter
        self.calls: set[str] = set()  # names that the routine being read calls

    def written(self) -> str:
        """Return the text of the token taken last, as it is in the source."""
        return self.source.text[self.last : self.end]

    def is_word(self, *words: str) -> bool:
        return self.kind == "word" and self.text in words

    def take(self, text: str) -> None:
        if self.text != text:
            raise self.unexpected(text.upper() if text.isalpha() else quoted_sign(text))
        self.step()

    def word(self, wanted: str) -> str:
        if self.kind != "word" or self.text in NO_NAMES:
            raise self.unexpected(wanted)
        return self.once(self.step())

    def arguments(self, closing: str) -> tuple[tuple[Expression, ...], tuple[tuple[str, Expression], ...]]:
        r"""Return arguments in order, and those after a \\, up to a sign that is consumed. A switch is True."""
        values: list[Expression] = []
        named: list[tuple[str, Expression]] = []
        self.deeper()
        while self.text != closing:
            if self.text == "\\":
                self.step()
                name = self.word("an argument's name")
                value: Expression = Truth(True)
                if self.text == ":=":
                    self.step()
                    value = self.expression()
                elif self.text == "?":  # passed on from the routine's own optional parameter, or omitted
                    self.step()
                    at = self.start
                    value = Call(PASSED, (Name(self.word("a parameter"), at),), (), at, self.end)
                named.append((name, value))
            else:
                if self.following == ":=" and self.kind == "word":  # required arguments are in order, named or not
                    self.step()
                    self.step()
                values.append(self.expression())
            if self.text == ",":
                self.step()
            elif self.text not in (closing, "\\"):
                raise self.unexpected(f"a comma or {closing}")
        self.step()
        self.depth -= 1
        return tuple(values), tuple(named)

    def expression(self, least: int = 0) -> Expression:
        """Return an expression whose operators have at least this precedence."""
        start, text = self.start, self.text
        if self._next[1] in _AFTER_OPERAND and text not in _SIGNS:
            return self.atom()  # as most arguments
        if text in _SIGNS:
            self.deeper()
            self.step()
            inner = self.expression(_NOT if text == "not" else _MINUS)
            self.depth -= 1
            if isinstance(inner, Number):
                left: Expression = Number(-inner.value if text == "-" else inner.value)
            else:
                left = Operation(text, (inner,), start, self.end)
        else:
            left = self.postfix()
        links = 0
        while (binds := _BINDS.get(self.text, -1)) > least and self.kind in ("sign", "word"):
            links += 1
            self.longer(links)
            sign = self.step()
            left = Operation(sign, (left, self.expression(binds)), start, self.end)
        return left

    def postfix(self) -> Expression:
        start = self.start
        found = self.atom()
        links = 0
        while self.kind == "sign" and self.text in "{.":
            links += 1
            self.longer(links)
            if self.step() == ".":
                found = Element(found, self.word("a component"), start, self.end)
                continue
            for item in self.bracketed("}"):
                self.elements += 1
                counted = Operation("-", (item, Number(1.0)), start, self.end)  # counted from 1
                found = Element(found, counted, start, self.end)
        return found

    def atom(self) -> Expression:
        kind, text, start = self.kind, self.text, self.start
        if kind == "word":
            word = self.once(text)
            if word in ("true", "false"):
                self.step()
                return Truth(word == "true")
            if word not in NO_NAMES:
                self.step()
                if self.text == "(":
                    self.step()
                    self.calls.add(word)
                    arguments, named = self.arguments(")")
                    return Call(word, arguments, named, start, self.end)
                return Name(word, start)
        elif kind == "number":
            self.step()
            plain = not text.startswith(("0x", "0o", "0b"))
            return self.numbers.get(text) or self.number(text, float(text) if plain else float(int(text, 0)))
        elif kind == "robtarget":
            self.step()
            return Taught(Form.ROBTARGET, self.written(), start)
        elif kind == "jointtarget":
            self.step()
            return Taught(Form.JOINTTARGET, self.written(), start)
        elif kind == "string":
            self.step()
            return Text(self.written()[1:-1])
        elif text == "[":
            self.step()
            return Items(self.bracketed("]"), False, start, self.end)
        elif text == "(":
            self.deeper()
            self.step()
            found = self.expression()
            self.take(")")
            self.depth -= 1
            return found
        raise self.unexpected("an expression")

    def bracketed(self, closing: str) -> tuple[Expression, ...]:
        """Return expressions between commas up to a closing bracket, which is consumed."""
        self.deeper()
        items: list[Expression] = []
        while self.text != closing:
            if closing == "}" and self.text == "*":
                self.step()
            else:
                items.append(self.expression())
            if self.text == ",":
                self.step()
            elif self.text != closing:
                raise self.unexpected(f"a comma or {closing}")
        self.step()
        self.depth -= 1
        return tuple(items)


def quoted_sign(text: str) -> str:
    """Return a sign as it is displayed."""
    return f"'{text}'"
