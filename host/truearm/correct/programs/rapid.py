"""The moves of a RAPID task, each with its targets, tool and work object."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from truearm.correct.programs.data import Change, Datum, Form, Literal, Scope
from truearm.correct.programs.poses import check_reach, matrix_of_quaternion
from truearm.correct.programs.program import IDENTITY, Goal, Move, Program, Step, Surroundings, Target
from truearm.correct.programs.rapid_names import Statement, Task, arguments_of, find, read_names
from truearm.correct.programs.rapid_words import AIMLESS, MOVES, STRAIGHT
from truearm.correct.programs.reading import Uncertain, arithmetic
from truearm.correct.programs.tokens import NUMBER, Source, Tokens, is_bracketed, is_word, separated
from truearm.types import Floats
from truearm.units import MM

SIZES = {Form.ROBTARGET.value: (3, 4, 4, 6), Form.DEGREES.value: (6, 6)}  # components of robtarget and jointtarget
TOOL, WORK_OBJECT = "(b((fff)(ffff))(f(fff)(ffff)fff))", "(bbs((fff)(ffff))((fff)(ffff)))"  # types of components
NO_AXIS = 8.9e9  # an external axis from this value on is not used
AXES = tuple(f"eax_{letter}" for letter in "abcdef")

Value = float | str | bool | tuple["Value", ...]


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
    if name not in MOVES and name not in AIMLESS:
        program.steps += [Step.CALL] * task.is_foreign(name, scope)
        return
    move = Move(name, scope.place(tokens[0]), tokens[-1].end, name in STRAIGHT)
    task.add_move(move, lambda: _goals(task, statement))


def _goals(task: Task, statement: Statement) -> list[Goal]:
    """Return the goals of a move. Raises Uncertain."""
    tokens, scope = statement.tokens, statement.scope
    if tokens[0].text in AIMLESS:
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
