"""The moves of a RAPID task, each with targets, tool and work object, and all that uses or may change a datum.

The modules are read together, and nothing is followed: a name has all values that are assigned to it, in any order.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from truearm.correct.programs.program import (
    IDENTITY,
    Change,
    Datum,
    Form,
    Goal,
    Literal,
    Move,
    Place,
    Program,
    Scope,
    Step,
    Surroundings,
    Target,
)
from truearm.correct.programs.reading import (
    Reading,
    Uncertain,
    arithmetic,
    check_reach,
    matrix_of_quaternion,
    steps_of,
    table_of,
    words_of,
)
from truearm.correct.programs.tokens import (
    NUMBER,
    RAPID,
    Source,
    Tokens,
    closing,
    is_bracketed,
    is_word,
    separated,
    tokens_of,
)
from truearm.types import Floats
from truearm.units import MM

SIZES = {Form.ROBTARGET.value: (3, 4, 4, 6), Form.DEGREES.value: (6, 6)}  # components of robtarget and jointtarget
TOOL, WORK_OBJECT = "(b((fff)(ffff))(f(fff)(ffff)fff))", "(bbs((fff)(ffff))((fff)(ffff)))"  # types of components
NO_AXIS = 8.9e9  # an external axis from this value on is not used
AXES = tuple(f"eax_{letter}" for letter in "abcdef")

Value = float | str | bool | tuple["Value", ...]


class Instruction(NamedTuple):
    """An instruction that moves the robot: the places of its targets and of its tool among the arguments."""

    targets: tuple[int, ...]
    tool: int


WORDS, STEPS = words_of("rapid"), steps_of("rapid")
MOVES = {
    name: Instruction(tuple(entry["targets"]), entry["tool"])
    for entry in table_of("rapid")["moves"]
    for name in entry["names"].split()
}
READERS = (MOVES.keys() | WORDS["reading"] | WORDS["displacing"] | WORDS["operators"]) - WORDS["searches"]
LANGUAGE = MOVES.keys() | frozenset[str]().union(*WORDS.values())

Parameters = list[tuple[str, str]]  # of a routine: name and mode, "" for by value


class Statement(NamedTuple):
    """An instruction, an assignment, or an expression that is evaluated (a condition, a declaration's value)."""

    tokens: Tokens
    scope: Scope
    is_instruction: bool


@dataclass(eq=False)
class Task(Reading):
    """The modules of a task.

    ``modules``: the data of each. ``shared``: those that all modules see. ``outline``: the statements with the
    structure around them. ``by_name``: why no variable is certain.
    ``is_unwatched``: ConfL or ConfJ is off somewhere. ``persistents``: data that all tasks of a controller share.
    """

    modules: list[dict[str, Datum]] = field(default_factory=list)
    shared: dict[str, list[Datum]] = field(default_factory=lambda: defaultdict(list))
    routines: dict[str, list[Parameters]] = field(default_factory=lambda: defaultdict(list))
    outline: list[Step | Statement] = field(default_factory=list)
    by_name: Uncertain | None = None
    is_unwatched: bool = False
    persistents: list[Datum] = field(default_factory=list)

    def is_foreign(self, name: str, scope: Scope) -> bool:
        """Return whether a name is neither a word of the language nor in the files."""
        return name not in LANGUAGE and name not in self.routines and find(self, name, scope) is None

    def check(self, datum: Datum) -> None:
        """Raise Uncertain if a datum may have values that are not assigned to it as a whole."""
        super().check(datum)
        if self.by_name is not None and datum.kind != "const":
            raise self.by_name.again()


def read_names(files: Sequence[Source], surroundings: Surroundings) -> Task:
    """Read the modules of a task, and note who uses and changes each datum."""
    task = Task(Program("rapid", list(files)), surroundings)
    for number, source in enumerate(files):
        _ModuleReader(task, number, tokens_of(RAPID, source.text)).read()
    for data in task.modules:
        for name, datum in data.items():
            if not datum.local:
                task.shared[name].append(datum)
    for name in surroundings.frames:  # declared elsewhere, but these files may change it
        if name not in task.shared:
            task.shared[name] = [Datum(name, "", "external", Place(0, 0))]
    for statement in task.outline:
        if isinstance(statement, Statement):
            _note_uses(task, statement)
            if statement.is_instruction:
                _note_instruction(task, statement)
    return task


@dataclass(eq=False)
class _ModuleReader:
    """Reads the statements and declarations of one file; ``compact``: the number of IF without THEN around."""

    task: Task
    file: int
    tokens: Tokens
    index: int = 0
    blocks: tuple[dict[str, Datum], ...] = ()
    compact: int = 0

    def read(self) -> None:
        """Read the file."""
        tokens, outline = self.tokens, self.task.outline
        self.begin_module()
        while self.index < len(tokens):
            token = tokens[self.index]
            word = token.text if token.kind == "word" else ""
            self.index += 1
            if word == "module":
                self.begin_module()
                self.skip_name()
            elif word in ("proc", "func", "trap"):
                self.begin_routine(word)
            elif word == "record":
                while self.index < len(tokens) and tokens[self.index].text not in WORDS["routine_ends"]:
                    self.index += 1
            elif word in WORDS["routine_ends"]:
                outline += [Step.END] * (len(self.blocks) > 1)
                self.blocks = self.blocks[-1:]
            elif word in ("const", "var", "pers"):
                self.declaration(word, tokens[max(self.index - 2, 0)].text)
            elif word in STEPS:
                outline.append(STEPS[word])
                self.structure(word)
            elif word and is_word(tokens, self.index, ":"):
                outline.append(Step.CALL)  # GOTO may come from anywhere
            elif (word and word not in WORDS["skipped"]) or (token.text == "%" and len(self.blocks) > 1):
                self.index -= 1
                self.add(self.end(), is_instruction=True)
                outline += [Step.END] * self.compact
                self.compact = 0

    def end(self) -> int:
        """Return the index of the next token that ends a statement."""
        index, tokens = self.index, self.tokens
        while index < len(tokens) and tokens[index].text not in WORDS["statement_ends"]:
            index += 1
        return index

    def add(self, end: int, is_instruction: bool = False) -> None:
        """Add the tokens up to ``end`` as a statement."""
        if end > self.index:
            scope = Scope(self.file, self.blocks)
            self.task.outline.append(Statement(self.tokens[self.index : end], scope, is_instruction))
            self.index = end

    def begin_module(self) -> None:
        """Begin a module."""
        self.blocks = ({},)
        self.task.modules.append(self.blocks[0])

    def skip_name(self) -> None:
        """Go on after a name and the brackets that follow it."""
        self.index += 1
        if is_word(self.tokens, self.index, "("):
            self.index = closing(self.tokens, self.index) + 1

    def begin_routine(self, word: str) -> None:
        """Begin PROC, FUNC or TRAP, and read its parameters."""
        self.index += word == "func"
        first = self.index
        self.skip_name()
        self.task.outline.append(Step.ROUTINE)
        parameters: Parameters = []
        data: dict[str, Datum] = {}
        for parameter in separated(self.tokens[first + 2 : self.index - 1], ",", "\\", "|"):
            names = [token for token in parameter if token.kind == "word"]
            if names:
                name, mode = names[-1].text, names[0].text
                parameters.append((name, mode if mode in ("inout", "var", "pers") else ""))
                data[name] = Datum(name, "", "parameter", Place(self.file, names[-1].start))
        if first < len(self.tokens):
            self.task.routines[self.tokens[first].text].append(parameters)
        self.blocks = (data, self.blocks[-1])

    def declaration(self, kind: str, prefix: str) -> None:
        """Read CONST, VAR or PERS, which may have LOCAL or TASK before it."""
        end = self.end()
        tokens = self.tokens[self.index : end]
        self.index = min(self.index + 2, end)
        if len(tokens) < 2:
            return
        sign = next((index for index, token in enumerate(tokens) if token.text == ":="), end)
        name, place = tokens[1].text, Place(self.file, tokens[1].start)
        datum = Datum(name, tokens[0].text, kind, place, prefix == "local" or len(self.blocks) > 1)
        if tokens[sign + 1 :]:
            datum.values.append((tokens[sign + 1 :], Scope(self.file, self.blocks)))
        if self.blocks[0].setdefault(name, datum) is not datum:
            self.blocks[0][name].changes.append(Change(place, "redeclared"))
        if kind == "pers" and prefix != "task" and not datum.local:
            self.task.persistents.append(datum)
        self.add(end)

    def structure(self, word: str) -> None:
        """Read the expression of a word that begins, continues or ends a block.

        The data of a FOR are seen in it alone. An IF without THEN has one statement, which begins where an operand
        follows an operand.
        """
        tokens = self.tokens
        if word == "for" and self.index < len(tokens):
            name, place = tokens[self.index].text, Place(self.file, tokens[self.index].start)
            self.blocks = ({name: Datum(name, "", "counter", place)}, *self.blocks)
            self.index += 1
        elif word == "endfor" and len(self.blocks) > 2:
            self.blocks = self.blocks[1:]
        if word in WORDS["evaluating"]:
            end = self.end()
            if word == "if" and not is_word(tokens, end, "then"):
                self.compact += 1
                end = next((index for index in range(self.index + 1, end) if self.begins_statement(index)), end)
            self.add(end)

    def begins_statement(self, index: int) -> bool:
        """Return whether a word follows an operand."""
        previous, token = self.tokens[index - 1], self.tokens[index]
        is_operand = (previous.kind != "sign" and previous.text not in WORDS["operators"]) or previous.text in (
            ")",
            "]",
            "}",
        )
        return is_operand and token.kind == "word" and token.text not in WORDS["operators"]


# names and what may change them


def find(task: Task, name: str, scope: Scope) -> Datum | None:
    """Return the datum of a name as seen from a scope: the routine's, the module's, or one of another module."""
    if (datum := scope.find(name)) is not None:
        return datum
    data = task.shared.get(name, ())
    if len(data) > 1 and not any(change.code == "ambiguous" for change in data[0].changes):
        for datum, neighbour in zip(data, [*data[1:], data[0]], strict=True):
            datum.changes.append(Change(neighbour.place, "ambiguous"))
    return data[0] if data else None


def arguments_of(tokens: Tokens) -> tuple[list[Tokens], dict[str, Tokens]]:
    """Return the arguments in their order, and the optional ones (``\\Name:=value``, ``\\Name``) by name."""
    positional: list[Tokens] = []
    optional: dict[str, Tokens] = {}
    for argument in filter(None, separated(tokens, ",", "\\")):
        if argument[0].text != "\\":
            positional.append(argument)
        elif len(argument) > 1:
            optional[argument[1].text] = argument[2 + is_word(argument, 2, ":=") :]
    return positional, optional


def _note_uses(task: Task, statement: Statement) -> None:
    """Note every name of a statement as a use, and what its function calls may change."""
    tokens, scope = statement.tokens, statement.scope
    for index, token in enumerate(tokens):
        if token.kind != "word" or is_word(tokens, index - 1, ".") or is_word(tokens, index - 1, "\\"):
            continue
        datum = find(task, token.text, scope)
        if datum is not None and not (is_word(tokens, index - 1, "(") and is_word(tokens, index - 2, "dim")):
            datum.uses.add(scope.place(token))
        if is_word(tokens, index + 1, "("):
            end = closing(tokens, index + 1)
            if end == len(tokens):  # what it may change is not known
                task.by_name = Uncertain("deep")
            _note_call(task, scope, token.text, tokens[index + 2 : end])


def _note_instruction(task: Task, statement: Statement) -> None:
    """Note what an instruction or assignment changes, and what it does to all moves."""
    tokens, scope = statement.tokens, statement.scope
    name, place = tokens[0].text, scope.place(tokens[0])
    if len(tokens) > 1 and tokens[1].text in (":=", "{", "."):
        datum = find(task, name, scope)
        if datum is not None and tokens[1].text == ":=" and datum.type in WORDS["records"]:
            datum.values.append((tokens[2:], scope))
            datum.uses.discard(place)
        elif datum is not None:
            datum.changes.append(Change(place, "assigned"))
        return
    if name == "%":
        task.program.absent["a routine called by a text (%…%)"] = None
        tokens = tokens[max(index for index, token in enumerate(tokens) if token.text == "%") :]
    elif name in WORDS["loading"]:
        task.program.absent[name] = None
    _note_call(task, scope, name, tokens[1:])
    texts = {token.text for token in tokens}
    if name in WORDS["displacing"]:
        task.displace("displacing", name, place)
    if name == "singarea" and "lockaxis4" in texts:
        task.displace("locked-axis", name, place)
    if name in WORDS["by_name"]:
        task.by_name = Uncertain("by-name", name=name, where=task.program.where(place))
    task.is_unwatched |= name in ("confl", "confj") and "off" in texts


def _note_call(task: Task, scope: Scope, function: str, tokens: Tokens) -> None:
    """Note which arguments a call of an instruction or function may change."""
    routines = task.routines.get(function, ())
    is_absent = function != "%" and task.is_foreign(function, scope)
    if is_absent:
        task.program.absent[function] = None
    if not routines and function in READERS:
        return
    positional, optional = arguments_of(tokens)
    if function in WORDS["searches"] and not routines:
        positional, optional = positional[1:2], {}
    by_key: list[tuple[int | str, Tokens]] = [*enumerate(positional), *optional.items()]
    for key, argument in by_key:
        is_place = argument and argument[0].kind == "word" and not is_word(argument, 1, "(")
        if not is_place or (routines and all(_takes_value(parameters, key) for parameters in routines)):
            continue
        datum = find(task, argument[0].text, scope)
        if datum is not None and datum.kind != "const":
            change = Change(scope.place(argument[0]), "argument", function)
            (datum.outside if is_absent else datum.changes).append(change)


def _takes_value(parameters: Parameters, key: int | str) -> bool:
    """Return whether a routine takes an argument, by its number or name, by value."""
    if isinstance(key, str):
        return dict(parameters).get(key, "?") == ""
    return key < len(parameters) and not any(mode for _, mode in parameters)


# targets, tools and moves


def read_rapid(tasks: Sequence[Sequence[Source]], surroundings: Surroundings) -> list[Program]:
    """Read the tasks of a controller, each with all its modules. A PERS of one name is one datum in all of them."""
    read = [read_names(files, surroundings) for files in tasks]
    _share_persistents(read)
    for task in read:
        for entry in task.outline:
            if isinstance(entry, Step):
                task.program.steps.append(entry)
            else:
                _add_steps(task, entry)
    return [task.program for task in read]


def _share_persistents(tasks: Sequence[Task]) -> None:
    """Note what other tasks do to a PERS."""
    by_name: dict[str, list[Datum]] = defaultdict(list)
    for task in tasks:
        for datum in task.persistents:
            by_name[datum.name].append(datum)
    for data in by_name.values():
        texts = {" ".join(token.text for token in tokens) for datum in data for tokens, _ in datum.values}
        is_changed = len(texts) > 1 or any(datum.changes for datum in data)
        is_changed_outside = any(datum.outside for datum in data)
        for datum in data if len(data) > 1 else ():
            datum.uses.add(datum.place)  # its numbers in the other task must stay the same
            datum.changes += [Change(datum.place, "other-task")] * is_changed
            datum.outside += [Change(datum.place, "other-task")] * is_changed_outside


# values


def value_of(task: Task, tokens: Tokens, scope: Scope) -> Value:
    """Return the value of an expression of constants. Raises Uncertain."""
    if not tokens:
        raise Uncertain("arguments")
    first = tokens[0]
    is_single = len(tokens) == 1
    if is_single and first.kind == "row":
        return tuple(float(match[0]) for match in NUMBER.finditer(first.text))
    if is_single and (first.kind == "text" or first.text in ("true", "false")):
        return first.text if first.kind == "text" else first.text == "true"
    if is_bracketed(tokens, 0, "["):
        return tuple(value_of(task, item, scope) for item in separated(tokens[1:-1], ","))
    value = arithmetic(tokens, lambda operand: value_of(task, operand, scope))
    if value is not None:
        return value
    datum, element = _datum_of(task, tokens, scope)
    value, *further_values = set(task.through(datum, lambda tokens, scope: [value_of(task, tokens, scope)]))
    if further_values:
        raise Uncertain("several", name=datum.name)
    if element is None:
        return value
    if not isinstance(value, tuple) or not 1 <= element <= len(value):
        raise Uncertain("element", name=datum.name)
    return value[element - 1]


def _datum_of(task: Task, tokens: Tokens, scope: Scope) -> tuple[Datum, int | None]:
    """Return a datum and the element: its number, 0 if only the run knows it, None for the whole datum."""
    if tokens[0].kind != "word" or (len(tokens) > 1 and not is_bracketed(tokens, 1, "{")):
        raise Uncertain("run-time")
    datum = find(task, tokens[0].text, scope)
    if datum is None:
        raise Uncertain("undeclared", name=tokens[0].text)
    if len(tokens) == 1:
        return datum, None
    try:
        index = value_of(task, tokens[2:-1], scope)
    except Uncertain:
        return datum, 0
    return datum, int(index) if isinstance(index, float) else 0


# targets, tools and work objects


def targets_of(task: Task, tokens: Tokens, scope: Scope, form: Form, element: int | None = None) -> list[Target]:
    """Return where an argument, or an element of an array, may go. Raises Uncertain.

    ``element``: its number, 0 for any element, None if the argument is no array.
    """
    if not tokens:
        raise Uncertain("arguments")
    name = tokens[0].text
    if is_bracketed(tokens, 0, "["):
        if element is None:
            return [Target(_literal(tokens, scope, form))]
        items = list(separated(tokens[1:-1], ","))[max(element - 1, 0) : element or None]
        if not items:
            raise Uncertain("element", name=name)
        return task.all_values([(item, scope) for item in items], lambda item, _: targets_of(task, item, scope, form))
    if name in ("offs", "reltool") and is_bracketed(tokens, 1, "(") and name not in task.routines:
        return _displaced(task, tokens, scope, form)
    datum, index = _datum_of(task, tokens, scope)
    index = element if index is None else index
    targets = task.through(datum, lambda tokens, scope: targets_of(task, tokens, scope, form, index), key=(form, index))
    return [target.by(datum, scope.place(tokens[0])) for target in targets]


def _displaced(task: Task, tokens: Tokens, scope: Scope, form: Form) -> list[Target]:
    """Return the targets of Offs or RelTool with constant offsets."""
    positional, optional = arguments_of(tokens[2:-1])
    if len(positional) != 4:
        raise Uncertain("arguments")
    offsets: list[Any] = [value_of(task, argument, scope) for argument in positional[1:]]
    angles: list[Any] = [value_of(task, optional[key], scope) if key in optional else 0.0 for key in ("rx", "ry", "rz")]
    if not all(isinstance(number, float) for number in (*offsets, *angles)):
        raise Uncertain("run-time", subject="offset")
    step = IDENTITY.copy()
    step[:3, 3] = MM.to_si(np.array(offsets))
    step[:3, :3] = Rotation.from_euler("XYZ", angles, degrees=True).as_matrix()
    targets = targets_of(task, positional[0], scope, form)
    is_in_frame = tokens[0].text == "offs"
    return [target.moved(left=step) if is_in_frame else target.moved(right=step) for target in targets]


def _literal(tokens: Tokens, scope: Scope, form: Form) -> Literal:
    """Return the literal of a robtarget or jointtarget in brackets. Raises Uncertain."""
    rows = [token for token in tokens if token.kind == "row"]
    matches = [list(NUMBER.finditer(row.text)) for row in rows]
    if 2 * len(rows) + 1 != len(tokens):
        raise Uncertain("not-written")
    if tuple(map(len, matches)) != SIZES[form.value]:
        raise Uncertain("type", type="robtarget" if form is Form.ROBTARGET else "jointtarget")
    spans = [(row.start + m.start(), row.start + m.end()) for row, ms in zip(rows, matches, strict=True) for m in ms]
    numbers = tuple(float(match[0]) for row in matches for match in row)
    literal = Literal(scope.place(tokens[0]), tokens[-1].end, form, numbers, tuple(spans))
    check_reach(literal)
    return literal


def _shape(value: Value) -> str:
    """Return the types of a value's components in brackets, such as (bs(ff))."""
    return f"({''.join(map(_shape, value))})" if isinstance(value, tuple) else type(value).__name__[0]


def _frame_of(task: Task, tokens: Tokens, scope: Scope, subject: str) -> Floats:
    """Return the frame of a tool that the robot holds, or of a work object that stands still."""
    name = tokens[0].text if len(tokens) == 1 else ""
    datum, is_tool = find(task, name, scope), subject == "tool"
    if datum is None and name in ("tool0", "wobj0"):
        return IDENTITY
    try:
        if datum is not None and datum.kind == "external":
            pose = task.given(name, Uncertain("undeclared"))
            task.check(datum)
            return pose
        value: Any = value_of(task, tokens, scope)
        if _shape(value) != (TOOL if is_tool else WORK_OBJECT):
            raise Uncertain("type", type=f"complete {subject}")
        if value[0] is not is_tool:
            raise Uncertain("fixed-tool" if is_tool else "moved-object")
        if is_tool:
            return matrix_of_quaternion(*value[1])
        if value[1:3] != (True, '""'):
            raise Uncertain("moved-object")
        return np.asarray(matrix_of_quaternion(*value[3]) @ matrix_of_quaternion(*value[4]))
    except Uncertain as uncertain:
        raise uncertain.again(subject=subject) from None


# moves


def _add_steps(task: Task, statement: Statement) -> None:
    """Add the move of an instruction, and calls that may move the robot."""
    tokens, scope, program = statement.tokens, statement.scope, task.program
    name = tokens[0].text
    if any(token.text in task.routines for token in tokens) or name == "%":
        program.steps.append(Step.CALL)
    if not statement.is_instruction or name in task.routines or is_word(tokens, 1, ":="):
        return
    if name not in MOVES and name not in WORDS["aimless"]:
        program.steps += [Step.CALL] * task.is_foreign(name, scope)
        return
    move = Move(name, scope.place(tokens[0]), tokens[-1].end, name.startswith(tuple(WORDS["straight"])))
    task.add_move(move, lambda: _goals(task, statement))


def _goals(task: Task, statement: Statement) -> list[Goal]:
    """Return the goals of a move. Raises Uncertain."""
    tokens, scope = statement.tokens, statement.scope
    if tokens[0].text in WORDS["aimless"]:
        raise Uncertain("aimless")
    positional, optional = arguments_of(tokens[1:])
    instruction = MOVES[tokens[0].text]
    if len(positional) <= max(*instruction.targets, instruction.tool):
        raise Uncertain("arguments")
    if "corr" in optional:
        raise Uncertain("path")
    form = Form.DEGREES if "absj" in tokens[0].text else Form.ROBTARGET
    tool = work_object = IDENTITY
    if form is Form.ROBTARGET:
        task.check_displacement()
        tool = _frame_of(task, positional[instruction.tool], scope, "tool")
        if "wobj" in optional:
            work_object = _frame_of(task, optional["wobj"], scope, "work object")
    goals = []
    for argument in (positional[number] for number in instruction.targets):
        targets = targets_of(task, argument, scope, form)
        span = (argument[0].start, argument[-1].end) if len(targets) == 1 else None
        for target in targets:
            numbers = target.literal.numbers if form is Form.ROBTARGET else ()
            for name, axis in zip(AXES, numbers[11:], strict=False):
                if abs(axis) < NO_AXIS and name not in task.surroundings.unchanged:
                    raise Uncertain("axis", name=name)
            quarters = () if task.is_unwatched else numbers[7:10]
            goals.append(Goal(target, tool, work_object, span, quarters=quarters))
    return goals
