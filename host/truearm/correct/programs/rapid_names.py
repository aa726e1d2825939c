"""The modules of a RAPID task: statements, routines, data, and everything that uses or may change a datum.

The files are read together, and nothing is followed: a name has all values that are assigned to it, in any order.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from truearm.correct.programs.program import (
    Change,
    Datum,
    Literal,
    Memo,
    Place,
    Program,
    Step,
    Surroundings,
    Uncertain,
)
from truearm.correct.programs.program import certain as certain_in_program
from truearm.correct.programs.rapid_words import AIMLESS, BY_NAME, FUNCTIONS, MOVES, QUIET, READERS, SEARCHES
from truearm.correct.programs.tokens import (
    RAPID,
    Source,
    Token,
    Tokens,
    closing,
    depth_change,
    is_word,
    separated,
    tokens_of,
    words,
)

ROUTINE_ENDS = words("endproc endfunc endtrap endmodule endrecord")
STRUCTURE: dict[str, tuple[Step, tuple[str, ...]]] = {  # the step of each word, and what ends its expression
    "if": (Step.IF, ("then", ";")),
    "test": (Step.IF, ("case", "default", "endtest")),
    "while": (Step.LOOP, ("do", ";")),
    "for": (Step.LOOP, ("do", ";")),
    "elseif": (Step.BRANCH, ("then", ";")),
    "case": (Step.BRANCH, (":", ";")),
    **dict.fromkeys(("else", "default"), (Step.BRANCH, ())),
    **dict.fromkeys(("endif", "endfor", "endwhile", "endtest"), (Step.END, ())),
    **dict.fromkeys(("error", "undo", "backward"), (Step.CALL, ())),  # from anywhere in the routine
}
OPERATORS = words("and or xor not div mod")
DISPLACING = words("pdispon pdispset eoffson eoffsset")
CONTROL = words("return goto raise exit stop retry trynext connect exitcycle break")
LOADING = words("load startload waitload callbyvar")
RECORDS = words("robtarget jointtarget tooldata wobjdata")  # types with several values of one name
LANGUAGE = frozenset(MOVES) | QUIET | FUNCTIONS | READERS | CONTROL | AIMLESS | DISPLACING | BY_NAME


@dataclass(eq=False)
class Routine:
    """A routine with its parameters (name and mode, "" for by value), and the data declared in it."""

    name: str
    parameters: list[tuple[str, str]] = field(default_factory=list)
    names: dict[str, Datum] = field(default_factory=dict)


class Scope(NamedTuple):
    """From where names are looked up."""

    file: int
    module: str
    routine: Routine | None


class Statement(NamedTuple):
    """An instruction, an assignment, or an expression that is evaluated (a condition, a declaration's value)."""

    tokens: Tokens
    scope: Scope
    is_instruction: bool


@dataclass(eq=False)
class Task:
    """The modules of a task.

    ``outline``: the statements with the structure around them. ``displaced``: why no pose of the task is certain.
    ``by_name``: why no variable is. ``unwatched``: ConfL or ConfJ is switched off somewhere. ``locked``: axis 4 is.
    ``persistents``: data that all tasks of a controller share.
    """

    program: Program
    surroundings: Surroundings
    modules: dict[str, dict[str, Datum]] = field(default_factory=dict)
    routines: dict[str, list[Routine]] = field(default_factory=lambda: defaultdict(list))
    outline: list[Step | Statement] = field(default_factory=list)
    shared: dict[str, list[Datum]] = field(default_factory=lambda: defaultdict(list))
    external: dict[str, Datum] = field(default_factory=dict)
    displaced: Uncertain | None = None
    by_name: Uncertain | None = None
    unwatched: bool = False
    locked: bool = False
    literals: dict[Place, Literal] = field(default_factory=dict)
    memo: Memo = field(default_factory=Memo)
    persistents: list[Datum] = field(default_factory=list)

    def statements(self) -> Iterator[Statement]:
        """Yield all statements."""
        return (entry for entry in self.outline if isinstance(entry, Statement))


def read_names(files: Sequence[Source], surroundings: Surroundings) -> Task:
    """Read the modules of a task, and note who uses and changes each datum."""
    task = Task(Program("rapid", list(files)), surroundings)
    for number, source in enumerate(files):
        tokens = tokens_of(RAPID, source.text)
        task.program.names.update(token.text for token in tokens if token.kind == "word")
        _ModuleReader(task, number, tokens).read()
    for names in task.modules.values():
        task.program.declared.update(names)
        for name, datum in names.items():
            if not datum.local:
                task.shared[name].append(datum)
    for name in surroundings.frames:  # declared elsewhere, but these files may change it
        if name not in task.shared:
            task.external[name] = Datum(name, "", "pers", Place(0, 0))
    for statement in task.statements():
        _note_uses(task, statement)
        if statement.is_instruction:
            _note_instruction(task, statement)
    return task


class _ModuleReader:
    """Reads the statements and declarations of one file."""

    def __init__(self, task: Task, file: int, tokens: Tokens) -> None:
        self.task, self.file, self.tokens = task, file, tokens
        self.index = 0
        self.module = ""
        self.routine: Routine | None = None
        self.compact = False  # the next statement belongs to an IF without THEN

    def read(self) -> None:
        """Read the file."""
        tokens = self.tokens
        while self.index < len(tokens):
            modifier = ""
            if tokens[self.index].text in ("local", "task") and self.index + 1 < len(tokens):
                modifier = tokens[self.index].text
                self.index += 1
            token = tokens[self.index]
            read = _READERS_BY_WORD.get(token.text) if token.kind == "word" else _ModuleReader.other
            if token.text in ("const", "var", "pers"):
                self.declaration(modifier)
            elif read is None:
                self.instruction()
            else:
                read(self)

    def until(self, *ends: str) -> int:
        """Return the index of the next of these tokens, or of a word that ends a routine."""
        index, tokens = self.index, self.tokens
        while index < len(tokens) and tokens[index].text not in ends:
            if tokens[index].kind == "word" and tokens[index].text in ROUTINE_ENDS:
                break
            index += 1
        return index

    def add(self, tokens: Tokens, is_instruction: bool = False) -> None:
        """Add a statement."""
        if tokens:
            scope = Scope(self.file, self.module, self.routine)
            self.task.outline.append(Statement(tokens, scope, is_instruction))

    def step(self, step: Step) -> None:
        """Add a step of the structure, and go on."""
        self.task.outline.append(step)
        self.index += 1

    def start_module(self) -> None:
        """Read MODULE name(attributes)."""
        self.index += 1
        name = self.tokens[self.index].text if self.index < len(self.tokens) else ""
        self.module = name if name not in self.task.modules else f"{name} {self.file}"
        self.task.modules[self.module] = {}
        self.index += 1
        if is_word(self.tokens, self.index, "("):
            self.index = closing(self.tokens, self.index) + 1

    def end_routine(self) -> None:
        """Leave a routine or a module."""
        if self.routine is not None:
            self.task.outline.append(Step.END)
        self.routine = None
        self.index += 1

    def record(self) -> None:
        """Skip the components of RECORD."""
        self.index += 1
        self.index = self.until() + 1

    def start_routine(self) -> None:
        """Read the head of PROC, FUNC or TRAP."""
        kind = self.tokens[self.index].text
        self.step(Step.ROUTINE)
        self.index += kind == "func"
        name = self.tokens[self.index].text if self.index < len(self.tokens) else ""
        self.routine = Routine(name)
        self.task.routines[name].append(self.routine)
        self.index += 1
        if kind != "trap" and is_word(self.tokens, self.index, "("):
            end = closing(self.tokens, self.index)
            self.parameters(self.routine, self.tokens[self.index + 1 : end])
            self.index = end + 1

    def parameters(self, routine: Routine, tokens: Tokens) -> None:
        """Read the parameters of a routine."""
        for parameter in separated(tokens, ",", "\\", "|"):
            words = [token for token in parameter if token.kind == "word"]
            if words:
                mode = words[0].text if words[0].text in ("inout", "var", "pers") else ""
                name = words[-1].text
                routine.parameters.append((name, mode))
                routine.names[name] = Datum(name, "", "parameter", Place(self.file, words[-1].start))

    def declaration(self, modifier: str) -> None:
        """Read CONST, VAR or PERS."""
        end = self.until(";")
        kind, tokens = self.tokens[self.index].text, self.tokens[self.index + 1 : end]
        self.index = end + is_word(self.tokens, end, ";")
        if len(tokens) < 2:
            return
        sign = next((index for index, token in enumerate(tokens) if token.text == ":="), len(tokens))
        name, place = tokens[1].text, Place(self.file, tokens[1].start)
        scope = Scope(self.file, self.module, self.routine)
        array = is_word(tokens, 2, "{")
        datum = Datum(name, tokens[0].text, kind, place, modifier == "local" or self.routine is not None, array)
        if tokens[sign + 1 :]:
            datum.values.append((tokens[sign + 1 :], scope))
        names = self.routine.names if self.routine else self.task.modules.setdefault(self.module, {})
        if names.setdefault(name, datum) is not datum:
            names[name].changes.append(Change(place, "redeclared"))
        if kind == "pers" and not modifier and not datum.local:
            self.task.persistents.append(datum)
        self.add(tokens[2:])

    def structure(self) -> None:
        """Read a word that begins, continues or ends a block, with its expression.

        An IF without THEN has one statement, which begins where an operand follows an operand.
        """
        word = self.tokens[self.index].text
        step, ends = STRUCTURE[word]
        self.task.outline.append(step)
        self.index += 1
        if word == "for" and self.routine is not None and self.index < len(self.tokens):
            name, place = self.tokens[self.index].text, Place(self.file, self.tokens[self.index].start)
            self.routine.names.setdefault(name, Datum(name, "num", "counter", place))
            self.index += 1
        if not ends:
            return
        end = self.until(*ends)
        self.compact = word == "if" and not is_word(self.tokens, end, "then")
        if self.compact:
            end = _statement_begin(self.tokens, self.index, end)
        self.add(self.tokens[self.index : end])
        self.index = end + (
            not self.compact and end < len(self.tokens) and self.tokens[end].text in (":", ";", "then", "do")
        )

    def other(self) -> None:
        """Skip a sign; read the call of a routine whose name is a text: %"name"% arguments."""
        if self.tokens[self.index].text == "%" and self.routine is not None:
            self.instruction()
        else:
            self.index += 1

    def instruction(self) -> None:
        """Read an instruction, an assignment or a label."""
        if is_word(self.tokens, self.index + 1, ":"):
            self.step(Step.CALL)  # GOTO may come from anywhere
            return
        end = self.until(";")
        self.add(self.tokens[self.index : end], is_instruction=True)
        self.index = max(end, self.index + 1)
        if self.compact:
            self.compact = False
            self.task.outline.append(Step.END)


_READERS_BY_WORD = {
    "module": _ModuleReader.start_module,
    "record": _ModuleReader.record,
    **dict.fromkeys(ROUTINE_ENDS, _ModuleReader.end_routine),
    **dict.fromkeys(("proc", "func", "trap"), _ModuleReader.start_routine),
    **dict.fromkeys(STRUCTURE, _ModuleReader.structure),
}


def _statement_begin(tokens: Tokens, start: int, end: int) -> int:
    """Return the index of the word that follows an operand directly, outside brackets; ``end`` if there is none."""
    depth = 0
    for index in range(start + 1, end):
        depth += depth_change(tokens[index - 1])
        if not depth and _begins_statement(tokens[index - 1], tokens[index]):
            return index
    return end


def _begins_statement(before: Token, token: Token) -> bool:
    """Return whether a word follows an operand directly."""
    if token.kind != "word" or token.text in OPERATORS:
        return False
    is_name = before.kind == "word" and before.text not in OPERATORS
    return is_name or before.kind in ("number", "text") or before.text in (")", "]", "}")


# names and what may change them


def find(task: Task, name: str, scope: Scope) -> Datum | None:
    """Return the datum of a name as seen from a scope: the routine's, the module's, or one of another module."""
    if scope.routine is not None and name in scope.routine.names:
        return scope.routine.names[name]
    own = task.modules.get(scope.module, {}).get(name)
    if own is not None:
        return own
    data = task.shared.get(name, ())
    if len(data) > 1 and not data[0].changes:
        for datum, other in zip(data, [*data[1:], data[0]], strict=True):
            datum.changes.append(Change(other.place, "ambiguous"))
    return data[0] if data else task.external.get(name)


def certain(task: Task, datum: Datum) -> None:
    """Raise Uncertain if a datum may have values that are not assigned to it as a whole."""
    certain_in_program(task.program, datum, task.surroundings)
    if task.by_name is not None and datum.kind != "const":
        raise task.by_name.again()


def is_place(tokens: Tokens) -> bool:
    """Return whether tokens are a name with indexes and components, to which something may be assigned."""
    index = 1
    while index < len(tokens):
        if tokens[index].text == "{":
            index = closing(tokens, index) + 1
        elif tokens[index].text == "." and index + 1 < len(tokens):
            index += 2
        else:
            return False
    return bool(tokens) and tokens[0].kind == "word"


def arguments_of(tokens: Tokens) -> tuple[list[Tokens], dict[str, Tokens]]:
    """Return the arguments in their order, and the optional ones (``\\Name:=value``, ``\\Name``) by name."""
    positional: list[Tokens] = []
    optional: dict[str, Tokens] = {}
    for number, argument in enumerate(separated(tokens, ",", "\\")):
        if argument and argument[0].text == "\\":
            if len(argument) > 1:
                optional[argument[1].text] = argument[2 + is_word(argument, 2, ":=") :]
        elif argument or number:
            positional.append(argument)
    return positional, optional


def _note_uses(task: Task, statement: Statement) -> None:
    """Note every name of a statement as a use, and what its function calls may change."""
    tokens, scope = statement.tokens, statement.scope
    for index, token in enumerate(tokens):
        if token.kind != "word" or is_word(tokens, index - 1, ".") or is_word(tokens, index - 1, "\\"):
            continue
        datum = find(task, token.text, scope)
        if datum is not None and not (is_word(tokens, index - 1, "(") and is_word(tokens, index - 2, "dim")):
            datum.uses.add(Place(scope.file, token.start))
        if is_word(tokens, index + 1, "("):
            end = closing(tokens, index + 1)
            if end == len(tokens):  # what it may change is not known
                task.by_name = Uncertain("deep")
            else:
                _note_call(task, scope, token.text, tokens[index + 2 : end])


def _note_instruction(task: Task, statement: Statement) -> None:
    """Note what an instruction or assignment changes, and what it does to all moves."""
    tokens, scope = statement.tokens, statement.scope
    sign = next((index for index, token in enumerate(tokens) if token.text == ":="), 0)
    if sign and is_place(tokens[:sign]):
        _note_assignment(task, statement, sign)
        return
    name, where = tokens[0].text, task.program.where(Place(scope.file, tokens[0].start))
    if name == "%":
        task.program.absent["a routine called by a text (%…%)"] = None
        end = next((index for index, token in enumerate(tokens) if index and token.text == "%"), 0)
        _note_call(task, scope, "%", tokens[end + 1 :])
        return
    if len(tokens) > 1 and is_place(tokens) and name not in task.routines:
        return
    _note_call(task, scope, name, tokens[1:])
    if name in DISPLACING:
        task.displaced = task.displaced or Uncertain("displaced", name=name, where=where)
    if name in BY_NAME:
        task.by_name = Uncertain("by-name", name=name, where=where)
    words = {token.text for token in tokens[1:]}
    task.unwatched |= name in ("confl", "confj") and "off" in words
    task.locked |= name == "singarea" and "lockaxis4" in words
    if name in LOADING:
        task.program.absent[name] = None


def _note_assignment(task: Task, statement: Statement, sign: int) -> None:
    """Note an assignment: one more value of a whole datum, or a change of a part of it."""
    tokens, scope = statement.tokens, statement.scope
    datum = find(task, tokens[0].text, scope)
    if datum is None:
        return
    place = Place(scope.file, tokens[0].start)
    if sign == 1 and datum.type in RECORDS and not datum.array:
        datum.values.append((tokens[2:], scope))
        datum.uses.discard(place)
    else:
        datum.changes.append(Change(place, "assigned"))


def _note_call(task: Task, scope: Scope, function: str, tokens: Tokens) -> None:
    """Note which arguments a call of an instruction or function may change."""
    routines = task.routines.get(function, ())
    is_absent = not routines and function not in LANGUAGE and find(task, function, scope) is None
    if is_absent and function != "%":
        task.program.absent[function] = None
    if not routines and function in READERS - SEARCHES:
        return
    positional, optional = arguments_of(tokens)
    if function in SEARCHES and not routines:
        positional, optional = positional[1:2], {}
    by_key: list[tuple[int | str, Tokens]] = [*enumerate(positional), *optional.items()]
    for key, argument in by_key:
        if not is_place(argument) or (routines and all(_takes_value(routine, key) for routine in routines)):
            continue
        datum = find(task, argument[0].text, scope)
        if datum is not None and datum.kind != "const":
            change = Change(Place(scope.file, argument[0].start), "argument", function)
            (datum.outside if is_absent else datum.changes).append(change)


def _takes_value(routine: Routine, key: int | str) -> bool:
    """Return whether a routine takes an argument, by its number or name, by value."""
    if isinstance(key, str):
        return dict(routine.parameters).get(key, "?") == ""
    return key < len(routine.parameters) and not any(mode for _, mode in routine.parameters)
