"""Search a program's syntax tree: calls, names, statements and routines, and what a routine changes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence

from truearm.files.programs.syntax import (
    Assign,
    Block,
    Call,
    Element,
    Expression,
    If,
    Loop,
    Name,
    Number,
    Routine,
    Statement,
    Taught,
    Text,
    Truth,
)

WITHOUT_CALLS = frozenset({Name, Number, Taught, Text, Truth, Routine})


def calls_in(node: tuple[object, ...]) -> Iterator[Call]:
    """Yield the calls in a block, a statement or an expression, except those in routines defined there."""
    # a stack, as generators within generators would hand on each call through all levels
    waiting: list[tuple[object, ...]] = [] if type(node) in WITHOUT_CALLS else [node]
    while waiting:
        here = waiting.pop()
        if isinstance(here, Call):
            yield here
        for inner in reversed(here):
            if inner and isinstance(inner, tuple) and type(inner) not in WITHOUT_CALLS:
                waiting.append(inner)


def places_in(node: object) -> Iterator[int]:
    """Yield the places of a statement's or expression's parts, the outermost first."""
    start = getattr(node, "start", None)
    if isinstance(start, int):
        yield start
    if isinstance(node, tuple):
        for inner in node:
            yield from places_in(inner)


def names_in(node: object) -> Iterator[str]:
    """Yield the names of variables in a block, a statement or an expression."""
    if isinstance(node, Name):
        yield node.name
    elif isinstance(node, tuple) and not isinstance(node, Number | Taught):
        for inner in node:
            yield from names_in(inner)


def statements_in(block: Block) -> Iterator[Statement]:
    """Yield the statements of a block and of the blocks in it, except those in routines defined there."""
    waiting = [*reversed(block)]
    while waiting:
        statement = waiting.pop()
        yield statement
        for inner in reversed(_blocks_of(statement)):
            waiting += reversed(inner)


def _blocks_of(statement: Statement) -> Sequence[Block]:
    """Return the blocks of a statement, except a routine's."""
    if isinstance(statement, If):
        return statement.blocks
    return (statement.body,) if isinstance(statement, Loop) else ()


def root_of(target: Expression | None) -> str:
    while isinstance(target, Element):
        target = target.of
    return target.name if isinstance(target, Name) else ""


def assigns_parameters(routine: Routine) -> bool:
    """Return whether a routine may change a variable passed to it, including through others."""
    names = {one.name for one in routine.parameters}
    assigned = {root_of(one.target) for one in statements_in(routine.body) if isinstance(one, Assign)}
    given = {root_of(argument) for call in calls_in(routine.body) for argument in call.arguments}
    return bool(names & (assigned | given))


def touched_by(
    routine: Routine, routines: Mapping[str, Routine], changed_by: Callable[[Call], Sequence[Expression]]
) -> tuple[set[str], set[str], set[str]]:
    """Return the names that a routine itself uses, those that it changes, and the routines that it calls."""
    used, changed, called = set(names_in((routine.body, routine.handlers))), set[str](), set[str]()
    for block in (routine.body, *routine.handlers):
        changed |= {root_of(at.target) for at in statements_in(block) if isinstance(at, Assign) and at.scope != "local"}
    for call in calls_in((routine.body, routine.handlers)):
        if call.function in routines:
            called.add(call.function)
            changed |= {root_of(argument) for argument in (*call.arguments, *(value for _, value in call.named))}
        else:
            changed |= {root_of(argument) for argument in changed_by(call)}
    return used, changed, called
