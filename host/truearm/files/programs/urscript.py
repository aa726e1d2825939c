"""The parser of URScript: the grammar of Universal Robots' script manual (5.x), and PolyScope's additions.

A line is a statement unless a bracket is open. ``$ 3 "MoveJ"`` marks a step of PolyScope's tree and is skipped, as
comments are.
"""

from __future__ import annotations

import re
from typing import Literal

from truearm.files.programs.reader import END, NO_MORE, Reader
from truearm.files.programs.syntax import (
    NUMBER,
    SIGNED,
    Assign,
    Block,
    Call,
    Do,
    Element,
    Expression,
    Form,
    If,
    Items,
    Leave,
    Loop,
    Name,
    Number,
    Operation,
    Parameter,
    Return,
    Routine,
    Statement,
    Taught,
    Text,
    Truth,
)
from truearm.files.programs.work import STATEMENT, Work

_SIX = rf"\[\s*{SIGNED}\s*(?:,\s*{SIGNED}\s*){{5}}\]"
_TOKENS = re.compile(
    rf"""(?:[ \t\f]++|\#[^\r\n]*+|\$[^\r\n]*+|\xef\xbb\xbf)*+(?:(?P<newline>\r\n|\n|\r)|(?P<pose>p{_SIX})|(?P<joints>{_SIX})
    |(?P<number>{NUMBER})|(?P<word>[A-Za-z_]\w*)|(?P<string>"[^"\r\n]*"|'[^'\r\n]*')
    |(?P<sign>==|!=|<=|>=|[-+*/%()\[\],:=<>.])|{NO_MORE})""",
    re.VERBOSE | re.ASCII,
)
_BINDS = {"or": 1, "xor": 1, "and": 2, "==": 4, "!=": 4, "<": 4, ">": 4, "<=": 4, ">=": 4}
_BINDS |= {"+": 5, "-": 5, "*": 6, "/": 6, "%": 6}
_NOT, _MINUS = 3, 7
_PLAIN, _AFTER_OPERAND = frozenset({"number", "pose", "joints", "word"}), frozenset({",", ")", "]"})  # most arguments
_TRUTHS = frozenset({"True", "False", "true", "false"})
_CLOSING = frozenset({"end", "else", "elif"})
_LEAVES = {"break": Leave("break"), "continue": Leave("continue"), "halt": Leave("halt")}
_NO_NAMES = _CLOSING | {"def", "thread", "sec", "if", "while", "return", "break", "continue", "halt", "global", "local"}


def read_urscript(work: Work) -> Block:
    """Return the statements of a program. Raises ProgramError with file and line."""
    reader = _Reader(work)
    block = reader.block()
    if reader.kind != END:
        raise reader.wrong(f"{reader.text} ends a block that was not opened")
    return block


class _Reader(Reader):
    """The grammar by recursive descent. ``open``: number of open brackets; ``found``: routines of the one being read."""

    __slots__ = ("found", "open")

    def __init__(self, work: Work) -> None:
        super().__init__(work, _TOKENS, work.source.text)
        self.open = 0
        self.found: list[Routine] = []

    def block(self) -> Block:
        """Return the statements up to the word that closes them, which is not consumed."""
        self.deeper()
        found: list[Statement] = []
        while True:
            while self.kind == "newline":
                self.step()
            if self.kind == END or (self.kind == "word" and self.text in _CLOSING):
                self.depth -= 1
                return tuple(found)
            found.append(self.statement())

    def statement(self) -> Statement:
        self.work.left -= STATEMENT
        start = self.start
        word = self.text if self.kind == "word" else ""
        if word in ("def", "thread", "sec"):
            return self.routine()
        if word == "if":
            return self.choice()
        if word == "while":
            self.step()
            condition = self.expression()
            body = self.inner()
            self.close("while", start)
            return Loop(condition, body)
        found: Statement
        if word == "return":
            self.step()
            ended = self.kind in ("newline", END) or self.text in _CLOSING
            found = Return(None if ended else self.expression())
        elif word in _LEAVES:
            self.step()
            found = _LEAVES[word]
        else:
            if word in ("global", "local"):
                self.step()
            found = self.assigned(word if word in ("global", "local") else "")
        if self.kind not in ("newline", END) and self.text not in _CLOSING:
            raise self.unexpected("the end of the statement")
        return found

    def assigned(self, scope: str) -> Statement:
        """Read an assignment, a declaration without value, or an expression for its effect."""
        start, before = self.start, self.elements
        left = self.expression()
        if self.text != "=" or self.kind != "sign":
            if self.elements > before + 1:
                self.work.indexed.add(start)
            return Do(Truth(False)) if scope else Do(left)  # a name may be declared without a value
        if not isinstance(left, Name | Element):
            raise self.wrong("the left side of = is not a variable")
        self.step()
        value = self.expression()
        if self.elements > before + 1:
            self.work.indexed.add(start)
        return Assign(left, value, "global" if scope == "global" else "local" if scope else "")

    def routine(self) -> Routine:
        start, kind = self.start, self.step()
        name = self.word("a name")
        parameters: list[Parameter] = []
        if self.text == "(":
            self.step()
            while self.text != ")":
                parameter = self.word("a parameter")
                default = None
                if self.text == "=":
                    self.step()
                    default = self.expression()
                parameters.append(Parameter(parameter, default, default is not None))
                if self.text == ",":
                    self.step()
                elif self.text != ")":
                    raise self.unexpected("a comma or )")
            self.step()
        outer, self.found = self.found, []
        body = self.inner()
        self.close(f"{kind} {name}", start)
        how: Literal["routine", "beside"] = "beside" if kind == "thread" else "routine"
        routine = Routine(name, tuple(parameters), body, how, start, inner=tuple(self.found))
        self.found = outer
        outer.append(routine)
        return routine

    def choice(self) -> If:
        start = self.start
        conditions, blocks, whole = [], [], False
        while self.text in ("if", "elif") and not whole:
            self.step()
            conditions.append(self.expression())
            blocks.append(self.inner())
            if self.text == "else":
                self.step()
                blocks.append(self.inner())
                whole = True
        self.close("if", start)
        return If(tuple(conditions), tuple(blocks), whole)

    def inner(self) -> Block:
        """Return the block after a colon."""
        if self.text != ":":
            raise self.unexpected("a colon")
        self.step()
        return self.block()

    def close(self, what: str, start: int) -> None:
        """Consume the end of what began at ``start``."""
        if self.text != "end":
            raise self.unexpected(f"the end of {what} (line {self.source.line(start)})")
        self.step()

    def word(self, wanted: str) -> str:
        if self.kind != "word" or self.text in _NO_NAMES:
            raise self.unexpected(wanted)
        return self.once(self.step())

    def expression(self, least: int = 0) -> Expression:
        """Return an expression whose operators have at least this precedence; brackets may span lines."""
        if self.kind in _PLAIN and self._next[1] in _AFTER_OPERAND and self.text != "not":
            return self.atom()
        start, text = self.start, self.text
        if text == "not":
            left = self.operation(text, (self.operand(_NOT),), start)
        elif text in ("-", "+"):
            left = self.operation(text, (self.operand(_MINUS),), start)
        else:
            left = self.postfix()
        if self.open and self.kind == "newline":
            self.spaces()
        links = 0
        while (binds := _BINDS.get(self.text, -1)) > least and self.kind in ("sign", "word"):
            links += 1
            self.longer(links)
            sign = self.step()
            if self.open:
                self.spaces()
            left = self.operation(sign, (left, self.expression(binds)), start)
        return left

    def operand(self, least: int) -> Expression:
        """Return what follows a sign, which is consumed."""
        self.deeper()
        self.step()
        found = self.expression(least)
        self.depth -= 1
        return found

    def operation(self, sign: str, operands: tuple[Expression, ...], start: int) -> Expression:
        if len(operands) == 1 and sign in "+-" and isinstance(operands[0], Number):
            return Number(-operands[0].value if sign == "-" else operands[0].value)
        return Operation(sign, operands, start, self.end)

    def postfix(self) -> Expression:
        start = self.start
        found = self.atom()
        links = 0
        while self.kind == "sign" and self.text in "[.":
            links += 1
            self.longer(links)
            if self.step() == ".":
                found = Element(found, self.word("a field"), start, self.end)
                if self.text == "(":  # a method, for instance of an RPC handle
                    arguments, named = self.arguments()
                    found = Call(f".{found.at}", (found.of, *arguments), named, start, self.end)
                continue
            items = self.bracketed("]")
            if len(items) not in (1, 2):
                raise self.source.wrong(start, "an index has one or two numbers")
            self.elements += 1
            for item in items:
                found = Element(found, item, start, self.end)
        return found

    def atom(self) -> Expression:
        kind, text, start = self.kind, self.text, self.start
        if kind == "word" and text not in _NO_NAMES:
            if text in _TRUTHS:
                self.step()
                return Truth(text in ("True", "true"))
            return self.named()
        if kind == "number":
            self.step()
            return self.numbers.get(text) or self.number(text, float(text))
        if kind == "pose":
            self.step()
            return Taught(Form.POSE, text, start)
        if kind == "joints":
            self.step()
            return Taught(Form.JOINTS, text, start)
        if kind == "string":
            self.step()
            return Text(text[1:-1])
        if text == "[":
            self.step()
            return Items(self.bracketed("]"), False, start, self.end)
        if text == "(":
            self.step()
            items = self.bracketed(")")
            if len(items) != 1:
                raise self.source.wrong(start, "exactly one expression is needed between the brackets")
            return items[0]
        raise self.unexpected("an expression")

    def named(self) -> Expression:
        """Return a variable, a call, p[…], or an operation on a thread."""
        start, name = self.start, self.once(self.step())
        if self.text == "(":
            arguments, named = self.arguments()
            return Call(name, arguments, named, start, self.end)
        if name == "p" and self.text == "[" and self.start == self.end:
            self.step()
            return Items(self.bracketed("]"), True, start, self.end)
        if name == "run" and self.kind == "word":
            return self.postfix()
        if name in ("join", "kill") and self.kind == "word":
            self.postfix()
            return Truth(False)
        return Name(name, start)

    def arguments(self) -> tuple[tuple[Expression, ...], tuple[tuple[str, Expression], ...]]:
        """Return the arguments in the brackets of a call."""
        self.deeper()
        self.open += 1
        self.step()
        values: list[Expression] = []
        named: list[tuple[str, Expression]] = []
        self.spaces()
        while self.text != ")":
            if self.kind == "word" and self.following == "=":
                name = self.once(self.step())
                self.step()
                self.spaces()
                named.append((name, self.expression()))
            else:
                values.append(self.expression())
            if self.kind == "newline":
                self.spaces()
            if self.text == ",":
                self.step()
                if self.kind == "newline":
                    self.spaces()
            elif self.text != ")":
                raise self.unexpected("a comma or )")
        self.open -= 1
        self.step()
        self.depth -= 1
        return tuple(values), tuple(named)

    def bracketed(self, closing: str) -> tuple[Expression, ...]:
        """Return expressions between commas up to a closing bracket, which is consumed."""
        self.deeper()
        self.open += 1
        items: list[Expression] = []
        self.spaces()
        while self.text != closing:
            items.append(self.expression())
            self.spaces()
            if self.text == ",":
                self.step()
                self.spaces()
            elif self.text != closing:
                raise self.unexpected(f"a comma or {closing}")
        self.open -= 1
        self.step()
        self.depth -= 1
        return tuple(items)

    def spaces(self) -> None:
        """Skip the ends of lines within brackets."""
        while self.kind == "newline":
            self.step()
