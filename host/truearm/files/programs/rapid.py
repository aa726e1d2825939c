"""The parser of RAPID: the grammar of ABB's technical reference manual (RAPID kernel, IRC5 and OmniCore).

Words are case-insensitive; names are stored in lower case, and may contain letters of ISO 8859-1. Statements end with a
semicolon; line ends have no meaning. A module yields its data, its routines, and the types of its declarations.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, NamedTuple

from truearm.files.programs.rapid_expressions import CLOSING, ENDS, ExpressionReader
from truearm.files.programs.reader import END
from truearm.files.programs.syntax import (
    Assign,
    Block,
    Call,
    Do,
    Element,
    Expression,
    If,
    Items,
    Jump,
    Leave,
    Loop,
    Name,
    Parameter,
    Return,
    Routine,
    Statement,
    Truth,
)
from truearm.files.programs.tree_walks import root_of
from truearm.files.programs.work import STATEMENT, Work

PLACEHOLDERS = ("<tdn>", "<ddn>", "<rdn>", "<smt>")  # where an editor has no declaration or statement yet
LATE_BOUND = "%"  # represents %expression%: the procedure of that name


class Declared(NamedTuple):
    """A datum of a module or a routine. ``kind``: "const", "pers" or "var"."""

    name: str
    kind: str
    type: str
    value: Expression | None
    start: int


class Module(NamedTuple):
    """The declarations of a module.

    ``hidden``: names of LOCAL data and routines, which other modules do not see.
    """

    name: str
    data: tuple[Declared, ...]
    routines: tuple[Routine, ...]
    records: dict[str, tuple[tuple[str, str], ...]]  # the type and name of each component
    assigned: frozenset[str]  # variables that routines declare or change
    hidden: frozenset[str]
    names: frozenset[str]  # all names in the file


def read_rapid(work: Work) -> tuple[Module, ...]:
    """Return the modules of a program. Raises ProgramError with file and line."""
    reader = _Reader(work)
    found = [reader.module()]
    while reader.kind != END:
        found.append(reader.module())
    names = frozenset(reader.known)
    return tuple(module._replace(names=names) for module in found)


class _Reader(ExpressionReader):
    """The grammar by recursive descent. ``assigned``: variables that the module's routines declare or change."""

    def __init__(self, work: Work) -> None:
        super().__init__(work)
        self.assigned: set[str] = set()
        self.jumps = False

    def module(self) -> Module:
        data: list[Declared] = []
        routines: list[Routine] = []
        records: dict[str, tuple[tuple[str, str], ...]] = {}
        hidden: set[str] = set()
        self.assigned = set()
        self.take("module")
        name = self.word("the module's name")
        if self.text == "(":
            while self.text != ")":
                if self.kind == END:
                    raise self.unexpected(")")
                self.step()
            self.step()
        while not self.is_word("endmodule"):
            is_local, before = self.is_word("local"), (len(data), len(routines))
            self.declared(data, routines, records)
            if is_local:
                hidden |= {datum.name for datum in data[before[0] :]} | {one.name for one in routines[before[1] :]}
        self.step()
        return Module(
            name, tuple(data), tuple(routines), records, frozenset(self.assigned), frozenset(hidden), frozenset()
        )

    def declared(
        self, data: list[Declared], routines: list[Routine], records: dict[str, tuple[tuple[str, str], ...]]
    ) -> None:
        if self.is_word("local", "task"):
            self.step()
        if self.text in PLACEHOLDERS:
            self.step()
        elif self.is_word("var", "pers", "const"):
            data.append(self.datum())
        elif self.is_word(*ENDS):
            routines.append(self.routine())
        elif self.is_word("record"):
            self.step()
            name = self.word("a name")
            parts = []
            while not self.is_word("endrecord"):
                parts.append((self.word("a type"), self.word("a component")))
                self.take(";")
            self.step()
            records[name] = tuple(parts)
        elif self.is_word("alias"):
            self.step()
            old, new = self.word("a type"), self.word("a name")
            self.take(";")
            records[new] = (("alias", old),)
        else:
            raise self.unexpected("a declaration or a routine")

    def datum(self) -> Declared:
        kind, start = self.step(), self.last
        type_of, name = self.word("a type"), self.word("a name")
        if self.text == "{":
            self.step()
            self.bracketed("}")
        value = None
        if self.text == ":=":
            self.step()
            value = self.expression()
        self.take(";")
        return Declared(name, kind, type_of, value, start)

    def routine(self) -> Routine:
        kind, start = self.step(), self.last
        self.calls, self.jumps = set(), False
        if kind == "func":
            self.word("a type")
        name = self.word("a name")
        parameters = self.parameters() if self.text == "(" else ()
        body: list[Statement] = []
        constants: set[str] = set()
        while self.is_word("var", "pers", "const", "local") or self.text == "<ddn>":
            if self.text == "<ddn>":
                self.step()
                continue
            if self.is_word("local"):
                self.step()
            datum = self.datum()
            self.assigned.add(datum.name)
            if datum.kind == "const":
                constants.add(datum.name)
            if datum.value is not None:
                body.append(Assign(Name(datum.name, datum.start), datum.value, "local"))
            else:
                body.append(Assign(Name(datum.name, datum.start), Truth(False), "local"))
        body += self.block()
        handlers: list[Block] = []
        while self.is_word("error", "undo", "backward"):
            self.step()
            if self.text == "(":
                self.step()
                self.bracketed(")")
            handlers.append(self.block())
        self.take(ENDS[kind])
        how: Literal["routine", "beside"] = "beside" if kind == "trap" else "routine"
        return Routine(
            name,
            parameters,
            tuple(body),
            how,
            start,
            tuple(handlers),
            calls=frozenset(self.calls),
            jumps=self.jumps,
            constants=frozenset(constants),
        )

    def parameters(self) -> tuple[Parameter, ...]:
        found: list[Parameter] = []
        self.step()
        while self.text != ")":
            optional = self.text in ("\\", "|")
            if optional:
                self.step()
            words = []
            while self.kind == "word":
                words.append(self.step())
            if not words:
                raise self.unexpected("a parameter")
            if self.text == "{":
                while self.step() != "}":
                    if self.kind == END:
                        raise self.unexpected("}")
            found.append(Parameter(words[-1], None, optional, not {"inout", "var", "pers"}.isdisjoint(words[:-1])))
            if self.text == ",":
                self.step()
            elif self.text not in (")", "|", "\\"):
                raise self.unexpected("a comma or )")
        self.step()
        return tuple(found)

    def block(self) -> Block:
        """Return the statements up to the word that closes them, which is not consumed."""
        self.deeper()
        found: list[Statement] = []
        while not (self.kind == END or self.is_word(*CLOSING)):
            found += self.statement()
        self.depth -= 1
        return tuple(found)

    def statement(self) -> list[Statement]:
        self.work.left -= STATEMENT
        start = self.start
        word = self.text if self.kind == "word" else ""
        if word in _STATEMENTS:
            return _STATEMENTS[word](self)
        if self.text == "%":
            self.step()
            self.expression()
            self.take("%")
            arguments, named = self.arguments(";")
            return [Do(Call(LATE_BOUND, arguments, named, start, self.last))]
        if self.following == ":":
            self.step()
            self.step()
            self.jumps = True
            return [Jump(start)]
        if self.text in PLACEHOLDERS:
            self.step()
            return []
        return [self.simple()]

    def counted_loop(self) -> list[Statement]:
        self.step()
        counter = self.word("a variable")
        self.take("from")
        bounds = [self.expression()]
        self.take("to")
        bounds.append(self.expression())
        if self.is_word("step"):
            self.step()
            bounds.append(self.expression())
        self.take("do")
        body = self.block()
        self.take("endfor")
        decisions = (If((bound,), ((),), False) for bound in bounds)  # evaluated once, and they decide
        return [*decisions, Loop(None, body, counter, tuple(bounds))]

    def loop(self) -> list[Statement]:
        self.step()
        condition = self.expression()
        self.take("do")
        body = self.block()
        self.take("endwhile")
        return [Loop(condition, body)]

    def returned(self) -> list[Statement]:
        self.step()
        value = None if self.text == ";" else self.expression()
        self.take(";")
        return [Return(value)]

    def goto(self) -> list[Statement]:
        start = self.start
        self.step()
        self.word("a label")
        self.take(";")
        self.jumps = True
        return [Jump(start)]

    def ended(self) -> list[Statement]:
        self.step()
        self.take(";")
        return [Leave("halt")]

    def raised(self) -> list[Statement]:
        """Read RAISE, RETRY or TRYNEXT: it leaves an error handler, which may be entered from anywhere."""
        self.step()
        if self.text != ";":
            self.expression()
        self.take(";")
        return []

    def connected(self) -> list[Statement]:
        self.step()
        self.expression()
        self.take("with")
        self.word("a trap")
        self.take(";")
        return []

    def simple(self) -> Statement:
        """Read an assignment, or an instruction or procedure with its arguments."""
        start, before = self.start, self.elements
        if self.following in (":=", ".", "{"):
            left = self.postfix()
            self.take(":=")
            value = self.expression()
            if not isinstance(left, Name | Element):
                raise self.source.wrong(start, "the left side of := is not a variable")
            self.assigned.add(root_of(left))
            found: Statement = Assign(left, value)
            self.take(";")
            if self.elements > before + 1:
                self.work.indexed.add(start)
            return found
        name = self.word("a statement")
        self.calls.add(name)
        arguments, named = self.arguments(";")
        if self.elements > before + 1:
            self.work.indexed.add(start)
        return Do(Call(name, arguments, named, start, self.last))

    def choice(self) -> list[Statement]:
        self.step()
        conditions, blocks, whole = [self.expression()], list[Block](), False
        if not self.is_word("then"):
            return [If(tuple(conditions), (tuple(self.statement()),), False)]
        self.step()
        blocks.append(self.block())
        while self.is_word("elseif"):
            self.step()
            conditions.append(self.expression())
            self.take("then")
            blocks.append(self.block())
        if self.is_word("else"):
            self.step()
            blocks.append(self.block())
            whole = True
        self.take("endif")
        return [If(tuple(conditions), tuple(blocks), whole)]

    def test(self) -> list[Statement]:
        self.step()
        values, start = [self.expression()], self.start
        conditions, blocks, whole = list[Expression](), list[Block](), False
        while self.is_word("case"):
            self.step()
            values.append(self.expression())
            while self.text == ",":
                self.step()
                values.append(self.expression())
            self.take(":")
            conditions.append(Items(tuple(values), False, start, self.end))
            values = []
            blocks.append(self.block())
        if self.is_word("default"):
            self.step()
            self.take(":")
            blocks.append(self.block())
            whole = True
        if values:  # there was no case
            conditions.append(values[0])
        self.take("endtest")
        return [If(tuple(conditions), tuple(blocks), whole)]


_STATEMENTS: dict[str, Callable[[_Reader], list[Statement]]] = {
    "if": _Reader.choice,
    "for": _Reader.counted_loop,
    "while": _Reader.loop,
    "test": _Reader.test,
    "return": _Reader.returned,
    "goto": _Reader.goto,
    "exit": _Reader.ended,
    **dict.fromkeys(("raise", "retry", "trynext"), _Reader.raised),
    "connect": _Reader.connected,
}
