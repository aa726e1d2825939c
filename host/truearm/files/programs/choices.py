"""Choices that a routine's call decides: whether an optional argument was given (RAPID's ``Present``)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator

from truearm.files.programs.syntax import Block, Call, Expression, If, Name, Operation, Routine, Truth
from truearm.files.programs.tree_walks import calls_in
from truearm.files.programs.values import Unknown, Value, Values

ABSENT = Truth(False, "absent")  # an optional argument that a call does not give
PRESENT = "present"  # the function that asks for one; what it gives has this type
GIVEN, NOT_GIVEN = Truth(True, PRESENT), Truth(False, PRESENT)


def asked_of(routines: Iterable[Routine]) -> frozenset[tuple[str, str]]:
    """Return the optional parameters, each with its routine, that some calls of a program give and others do not.

    Where all calls are alike, another file may call the routine otherwise, so both ways are followed.
    """
    by_name = {routine.name: routine for routine in routines if any(one.optional for one in routine.parameters)}
    calls, given = Counter[str](), Counter[tuple[str, str]]()
    for routine in routines if by_name else ():
        for call in calls_in((routine.body, routine.handlers)):
            if call.function in by_name:
                calls[call.function] += 1
                given.update({(call.function, name) for name, _ in call.named})
    return frozenset(
        (routine.name, one.name)
        for routine in by_name.values()
        for one in routine.parameters
        if one.optional and 0 < given[routine.name, one.name] < calls[routine.name]
    )


def present(values: Values) -> Iterator[Value]:
    """Yield whether an argument was given, for each of its possible values."""
    for one in values:
        yield one if isinstance(one, Unknown) else NOT_GIVEN if one == ABSENT else GIVEN


class Choices:
    """The blocks of choices that were followed, and those that a call decided against."""

    def __init__(self) -> None:
        self._left_out: dict[int, Block] = {}
        self._followed: set[int] = set()

    def reachable(self, choice: If, value: Callable[[Expression], Values]) -> If:
        """Return a choice without the blocks that the present call decides against."""
        if not any(map(_asks, choice.conditions)):
            return choice
        conditions, blocks, whole = list[Expression](), list[Block](), choice.whole
        for condition, block in zip(choice.conditions, choice.blocks, strict=False):
            found: Values = value(condition) if _asks(condition) else ()
            if found == (NOT_GIVEN,):
                continue
            blocks.append(block)
            if found == (GIVEN,):
                whole = True  # as an ELSE: nothing after it is reached
                break
            conditions.append(condition)
        else:
            blocks += choice.blocks[len(choice.conditions) :]
        self._followed.update(map(id, blocks))
        self._left_out |= {id(block): block for block in choice.blocks}
        return If(tuple(conditions), tuple(blocks), whole)

    def never_followed(self) -> Iterator[Call]:
        """Yield the calls in blocks that no call of the program reaches."""
        for at, block in self._left_out.items():
            if at not in self._followed:
                yield from calls_in(block)


def _asks(condition: Expression) -> bool:
    """Return whether a condition is ``Present(…)`` or ``NOT Present(…)``."""
    if isinstance(condition, Operation) and condition.sign == "not":
        condition = condition.operands[0]
    return (
        isinstance(condition, Call)
        and condition.function == PRESENT
        and any(isinstance(one, Name) for one in condition.arguments)
    )
