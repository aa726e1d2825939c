"""The moves of a RAPID task, each with its targets, tool and work object."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from truearm.correct.programs.expressions import sum_or_product
from truearm.correct.programs.poses import check_reach, matrix_of_angles, matrix_of_quaternion
from truearm.correct.programs.program import (
    IDENTITY,
    MOST_TARGETS,
    Change,
    Datum,
    Form,
    Goal,
    Literal,
    Move,
    Place,
    Program,
    Step,
    Surroundings,
    Target,
    Uncertain,
)
from truearm.correct.programs.rapid_names import (
    LANGUAGE,
    Scope,
    Statement,
    Task,
    arguments_of,
    certain,
    find,
    is_place,
    read_names,
)
from truearm.correct.programs.rapid_words import AIMLESS, MOVES, STRAIGHT
from truearm.correct.programs.tokens import DEEPEST, Source, Tokens, is_bracketed, separated
from truearm.types import Floats

SIZES = {Form.ROBTARGET.value: (3, 4, 4, 6), Form.DEGREES.value: (6, 6)}  # components of robtarget and jointtarget
NO_AXIS = 8.9e9  # an external axis from this value on is not used
AXES = tuple(f"eax_{letter}" for letter in "abcdef")


class Number(NamedTuple):
    """A number, and its bytes if it is written as one."""

    value: float
    span: tuple[int, int] | None = None


class Row(NamedTuple):
    """Values in square brackets, with the bytes of the whole."""

    items: tuple[Value, ...]
    start: int
    end: int
    file: int


Value = Number | str | bool | Row


def read_rapid(tasks: Sequence[Sequence[Source]], surroundings: Surroundings) -> list[Program]:
    """Read the tasks of a controller, each with all its modules. A PERS of one name is one datum in all of them."""
    read = [read_names(files, surroundings) for files in tasks]
    _share_persistents(read)
    for task in read:
        for entry in task.outline:
            if isinstance(entry, Step):
                task.program.steps.append(entry)
                continue
            if entry.tokens[0].text == "%" or any(token.text in task.routines for token in entry.tokens):
                task.program.steps.append(Step.CALL)
            if entry.is_instruction and entry.tokens[0].text not in task.routines:
                _add_move(task, entry)
    return [task.program for task in read]


def _share_persistents(tasks: Sequence[Task]) -> None:
    """Note what other tasks do to a PERS."""
    by_name: dict[str, list[tuple[Task, Datum]]] = defaultdict(list)
    for task in tasks:
        for datum in task.persistents:
            by_name[datum.name].append((task, datum))
    changes: dict[Datum, list[Change]] = defaultdict(list)
    outside: dict[Datum, list[Change]] = defaultdict(list)
    for shared in by_name.values():
        texts = {" ".join(token.text for token in datum.values[0][0]) for _, datum in shared if datum.values}
        for task, datum in shared if len(shared) > 1 else ():
            others = [other for other_task, other in shared if other_task is not task]
            datum.uses.add(datum.place)  # its numbers in the other task must stay the same
            if len(texts) > 1 or any(other.changes or len(other.values) > 1 for other in others):
                changes[datum].append(Change(datum.place, "other-task"))
            elif any(other.outside for other in others):
                outside[datum].append(Change(datum.place, "other-task"))
    for datum, added in changes.items():
        datum.changes += added
    for datum, added in outside.items():
        datum.outside += added


# values


def value_of(task: Task, tokens: Tokens, scope: Scope, depth: int = 0) -> Value:
    """Return the value of an expression of constants. Raises Uncertain."""
    if not tokens or depth > DEEPEST:
        raise Uncertain("deep" if tokens else "arguments")
    first = tokens[0]
    if len(tokens) == 1 and first.kind == "number":
        return Number(float(first.text), (first.start, first.end))
    if len(tokens) == 1 and (first.kind == "text" or first.text in ("true", "false")):
        return first.text if first.kind == "text" else first.text == "true"
    if len(tokens) == 2 and first.text == "-" and tokens[1].kind == "number":
        return Number(-float(tokens[1].text), (first.start, tokens[1].end))
    if is_bracketed(tokens, 0, "["):
        items = tuple(value_of(task, item, scope, depth + 1) for item in separated(tokens[1:-1], ","))
        return Row(items, first.start, tokens[-1].end, scope.file)
    if is_bracketed(tokens, 0, "("):
        return value_of(task, tokens[1:-1], scope, depth + 1)
    total = sum_or_product(tokens, lambda operand: _number(value_of(task, operand, scope, depth + 1)))
    if total is not None:
        return Number(total)
    if is_place(tokens):
        return _value_of_place(task, tokens, scope, depth)
    raise Uncertain("run-time")


def _number(value: Value) -> float:
    if not isinstance(value, Number):
        raise Uncertain("run-time")
    return value.value


def _value_of_place(task: Task, tokens: Tokens, scope: Scope, depth: int) -> Value:
    """Return the only value of a name, or of an element of it by a constant index."""
    datum, element = _datum_of(task, tokens, scope, depth)
    value = task.memo.get(datum, lambda: _only_value(task, datum, depth))
    if element is None:
        return _without_span(value)
    items = value.items if isinstance(value, Row) else ()
    if not 1 <= element <= len(items):
        raise Uncertain("element", name=datum.name)
    return _without_span(items[element - 1])


def _only_value(task: Task, datum: Datum, depth: int) -> Value:
    """Return the only value of a datum."""
    values = [value_of(task, value, scope, depth + 1) for value, scope in _values(task, datum)]
    if any(_plain(value) != _plain(values[0]) for value in values):
        raise Uncertain("several", name=datum.name)
    return values[0]


def _values(task: Task, datum: Datum) -> list[tuple[Tokens, Scope]]:
    """Return all values of a datum with their scopes. Raises Uncertain if it has none."""
    if not datum.values:
        raise Uncertain("no-value", name=datum.name)
    return datum.values  # type: ignore[return-value]


def _without_span(value: Value) -> Value:
    """Return a value that is reached by a name: a number of it is not written where the name stands."""
    return Number(value.value) if isinstance(value, Number) else value


def _plain(value: Value) -> object:
    if isinstance(value, Row):
        return tuple(_plain(item) for item in value.items)
    return value.value if isinstance(value, Number) else value


def _datum_of(task: Task, tokens: Tokens, scope: Scope, depth: int) -> tuple[Datum, int | None]:
    """Return a certain datum and the element: its number, 0 if only the run knows it, None for the whole datum."""
    datum = find(task, tokens[0].text, scope)
    if datum is None:
        raise Uncertain("undeclared", name=tokens[0].text)
    certain(task, datum)
    if len(tokens) == 1:
        return datum, None
    if not is_bracketed(tokens, 1, "{"):
        raise Uncertain("run-time")
    try:
        index = value_of(task, tokens[2:-1], scope, depth + 1)
    except Uncertain:
        return datum, 0
    return datum, int(index.value) if isinstance(index, Number) else 0


# targets, tools and work objects


def targets_of(task: Task, tokens: Tokens, scope: Scope, form: Form, depth: int = 0) -> list[Target]:
    """Return where an argument may go: one target, or one for each element of an array. Raises Uncertain."""
    if depth > DEEPEST:
        raise Uncertain("deep")
    if is_bracketed(tokens, 0, "["):
        return [Target(_literal(task, value_of(task, tokens, scope), form))]
    if (
        tokens
        and tokens[0].text in ("offs", "reltool")
        and is_bracketed(tokens, 1, "(")
        and tokens[0].text not in task.routines
    ):
        return _displaced(task, tokens, scope, form, depth)
    if not is_place(tokens):
        raise Uncertain("run-time")
    datum, element = _datum_of(task, tokens, scope, depth)
    use = datum, Place(scope.file, tokens[0].start)
    if element is None:
        targets = task.memo.get((datum, form), lambda: _targets_of_datum(task, datum, form, depth))
    else:
        targets = task.memo.get((datum, form, element), lambda: _elements(task, datum, element, form))
    return [Target(t.literal, t.left, t.right, (use, *t.uses)) for t in targets]


def _targets_of_datum(task: Task, datum: Datum, form: Form, depth: int) -> list[Target]:
    """Return the targets of all values of a datum."""
    by_literal: dict[object, Target] = {}
    for value, scope in _values(task, datum):
        for target in targets_of(task, value, scope, form, depth + 1):
            by_literal[target.literal, target.left.tobytes(), target.right.tobytes(), target.uses] = target
        if len(by_literal) > MOST_TARGETS:
            raise Uncertain("many", most=MOST_TARGETS)
    return list(by_literal.values())


def _elements(task: Task, datum: Datum, element: int, form: Form) -> list[Target]:
    """Return the elements of an array that a move may go to: one, or all if only the run knows the index."""
    if len(datum.values) != 1:
        raise Uncertain("no-value", name=datum.name)
    value, scope = _values(task, datum)[0]
    row = value_of(task, value, scope)
    items = row.items if isinstance(row, Row) else ()
    if len(items) > MOST_TARGETS and not element:
        raise Uncertain("many", most=MOST_TARGETS)
    chosen = items[element - 1 : element] if element else items
    if not chosen:
        raise Uncertain("element", name=datum.name)
    return [Target(_literal(task, item, form)) for item in chosen]


def _displaced(task: Task, tokens: Tokens, scope: Scope, form: Form, depth: int) -> list[Target]:
    """Return the targets of Offs or RelTool with constant offsets."""
    positional, optional = arguments_of(tokens[2:-1])
    offsets = [value_of(task, argument, scope) for argument in [*positional[1:], *optional.values()]]
    numbers = [offset.value for offset in offsets if isinstance(offset, Number)]
    if len(positional) != 4 or len(numbers) != len(offsets):
        raise Uncertain("run-time", subject="offset")
    x, y, z = numbers[:3]
    step = matrix_of_angles(x, y, z, 0.0, 0.0, 0.0)
    for axis in ("rx", "ry", "rz"):
        if axis in optional:
            angle = numbers[3 + list(optional).index(axis)]
            a, b, c = (angle * (axis == name) for name in ("rz", "ry", "rx"))
            step = step @ matrix_of_angles(0.0, 0.0, 0.0, a, b, c)
    targets = targets_of(task, positional[0], scope, form, depth + 1)
    if tokens[0].text == "offs":
        return [Target(t.literal, step @ t.left, t.right, t.uses) for t in targets]
    return [Target(t.literal, t.left, t.right @ step, t.uses) for t in targets]


def _literal(task: Task, row: Value, form: Form) -> Literal:
    """Return the literal of a robtarget or jointtarget. Raises Uncertain."""
    if not isinstance(row, Row):
        raise Uncertain("not-written")
    place = Place(row.file, row.start)
    if place not in task.literals:
        groups = [item.items if isinstance(item, Row) and item.file == row.file else () for item in row.items]
        numbers = [item for group in groups for item in group if isinstance(item, Number)]
        if tuple(map(len, groups)) != SIZES[form.value] or len(numbers) != sum(map(len, groups)):
            raise Uncertain("type", type="robtarget" if form is Form.ROBTARGET else "jointtarget")
        spans = [item.span for item in numbers if item.span and row.start <= item.span[0] < row.end]
        if len(spans) != len(numbers):
            raise Uncertain("not-written")
        literal = Literal(place, row.end, form, tuple(item.value for item in numbers), tuple(spans))
        check_reach(literal)
        task.literals[place] = literal
    return task.literals[place]


def _frame(value: Value) -> Floats:
    """Return the frame [[x, y, z], [q1, q2, q3, q4]]."""
    groups = [item.items for item in value.items if isinstance(item, Row)] if isinstance(value, Row) else []
    numbers = [[item.value for item in group if isinstance(item, Number)] for group in groups]
    if list(map(len, groups)) != [3, 4] or list(map(len, numbers)) != [3, 4]:
        raise Uncertain("type", type="frame of plain numbers")
    return matrix_of_quaternion(*numbers)


def _tool(task: Task, tokens: Tokens, scope: Scope) -> Floats:
    """Return the frame of a tooldata that the robot holds."""
    value = _frame_data(task, tokens, scope, "tool")
    if not isinstance(value, Row):
        return value
    held, frame, *others = value.items
    if held is not True or len(others) != 1:
        raise Uncertain("fixed-tool")
    return _frame(frame)


def _work_object(task: Task, tokens: Tokens, scope: Scope) -> Floats:
    """Return user frame · object frame of a wobjdata that stands still."""
    value = _frame_data(task, tokens, scope, "work object")
    if not isinstance(value, Row):
        return value
    if len(value.items) != 5 or value.items[0] is not False:
        raise Uncertain("held-object")
    if value.items[1] is not True or value.items[2] != '""':
        raise Uncertain("moved-object")
    return np.asarray(_frame(value.items[3]) @ _frame(value.items[4]))


def _frame_data(task: Task, tokens: Tokens, scope: Scope, subject: str) -> Row | Floats:
    """Return the value of a tool or work object, or the frame that it was given by name."""
    name = tokens[0].text if len(tokens) == 1 else ""
    datum = find(task, name, scope)
    if datum is None and name in ("tool0", "wobj0"):
        return IDENTITY
    if datum is None and name:
        raise Uncertain("undeclared", name=name, subject=subject)
    try:
        if datum is not None and datum is task.external.get(name):
            certain(task, datum)
            return task.surroundings.frames[name]
        value = value_of(task, tokens, scope)
    except Uncertain as uncertain:
        raise uncertain.about(subject) from None
    if not isinstance(value, Row) or len(value.items) < 3:
        raise Uncertain("type", type=f"complete {subject}")
    return value


# moves


def _add_move(task: Task, statement: Statement) -> None:
    """Add the move of an instruction, or a call that may move the robot."""
    tokens, scope, program = statement.tokens, statement.scope, task.program
    name = tokens[0].text
    is_move = name in MOVES and not (len(tokens) > 1 and tokens[1].text in (":=", "{", "."))
    if not is_move and name not in AIMLESS:
        if name not in LANGUAGE and find(task, name, scope) is None:
            program.steps.append(Step.CALL)
        return
    move = Move(name, Place(scope.file, tokens[0].start), tokens[-1].end, name in STRAIGHT)
    program.moves.append(move)
    program.steps.append(move)
    try:
        if not is_move:
            raise Uncertain("aimless")
        move.goals = _goals(task, statement)
        program.count(move)
    except Uncertain as uncertain:
        move.refuse(uncertain)


def _goals(task: Task, statement: Statement) -> list[Goal]:
    """Return the goals of a move. Raises Uncertain."""
    tokens, scope = statement.tokens, statement.scope
    positional, optional = arguments_of(tokens[1:])
    instruction = MOVES[tokens[0].text]
    if len(positional) <= max(*instruction.targets, instruction.tool):
        raise Uncertain("arguments")
    if "corr" in optional:
        raise Uncertain("path")
    joints = "absj" in tokens[0].text
    tool = work_object = IDENTITY
    if not joints:
        _check_surroundings(task)
        tool = _tool(task, positional[instruction.tool], scope)
        if "wobj" in optional:
            work_object = _work_object(task, optional["wobj"], scope)
    goals = []
    for number in instruction.targets:
        argument = positional[number]
        targets = targets_of(task, argument, scope, Form.DEGREES if joints else Form.ROBTARGET)
        span = (argument[0].start, argument[-1].end) if len(targets) == 1 else None
        for target in targets:
            quarters: tuple[float, ...] = ()
            if not joints:
                _check_axes(task, target.literal)
                quarters = () if task.unwatched else target.literal.numbers[7:10]
            goals.append(Goal(target, tool, work_object, span, quarters=quarters))
    return goals


def _check_surroundings(task: Task) -> None:
    """Raise Uncertain if something displaces all poses of the task."""
    if task.displaced is not None:
        raise task.displaced.again()
    if task.locked:
        raise Uncertain("locked-axis")
    if task.surroundings.strict and task.program.absent:
        raise Uncertain("absent-routine", name=next(iter(task.program.absent)))


def _check_axes(task: Task, literal: Literal) -> None:
    """Raise Uncertain if a robtarget has an external axis, which may move the robot's base."""
    for name, axis in zip(AXES, literal.numbers[11:17], strict=True):
        if abs(axis) < NO_AXIS and name not in task.surroundings.unchanged:
            raise Uncertain("axis", name=name)
