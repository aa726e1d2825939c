"""The turns of loops, where the text says how many: they are followed turn by turn, so that what has one index stays together.

Only loops with several elements of lists are: for others, following all turns at once finds the same.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping

from truearm.files.programs.syntax import Element, Expression, Loop, Name, Number, Operation, Taught, Text, Truth
from truearm.files.programs.values import Values
from truearm.files.programs.work import Work

MOST_TURNS = 300  # of all loops of a program together; of more, all turns are followed at once
SPARE = 0.5  # of the work that may be spent on a program: with less left, all turns are followed at once
WITHOUT_ELEMENTS = frozenset({Name, Number, Taught, Text, Truth})
_COMPARED: Mapping[str, Callable[[float, float], bool]] = {
    "<": operator.lt, ">": operator.gt, "<=": operator.le, ">=": operator.ge, "!=": operator.ne, "<>": operator.ne,
}  # fmt: skip


class Turns:
    """The turns that may still be followed one by one, and which loops are worth it."""

    def __init__(self, work: Work) -> None:
        self._work = work
        self._left = MOST_TURNS
        self._worth: dict[int, bool] = {}

    def worth(self, loop: Loop) -> bool:
        """Return whether a loop has several elements of lists."""
        known = self._worth.get(id(loop))
        if known is None:
            known, inner = _several_indexes(loop.body)
            self._worth[id(loop)] = known
            self._worth |= dict.fromkeys(inner, False) if not known else {}  # none of them has more than all together
        return known

    def take(self) -> bool:
        """Take off a turn; return False if none is left."""
        self._left -= 1
        return self._left >= 0 and self._work.left > SPARE * self._work.whole

    def fits(self, turns: int) -> bool:
        """Return whether so many turns are left."""
        return turns <= self._left


def _several_indexes(node: tuple[object, ...]) -> tuple[bool, list[int]]:
    """Return whether a body has several elements of lists, and the identities of the loops seen in it before that."""
    waiting, loops, several = [node], list[int](), 0
    while waiting:
        here = waiting.pop()
        if isinstance(here, Element) and not isinstance(here.at, str | Number):
            several += 1
            if several > 1:
                return True, loops
        elif isinstance(here, Loop):
            loops.append(id(here))
        # Only what may hold an element: a body may have 100,000 statements.
        waiting += [inner for inner in here if isinstance(inner, tuple) and type(inner) not in WITHOUT_ELEMENTS]
    return False, loops


def holds(condition: Expression, value: Callable[[Expression], Values]) -> bool | None:
    """Return whether a comparison of known numbers holds; None for anything else."""
    compare = _COMPARED.get(condition.sign) if isinstance(condition, Operation) else None
    if compare is None or not isinstance(condition, Operation) or len(condition.operands) != 2:
        return None
    found = [value(one) for one in condition.operands]
    numbers = [one[0].value for one in found if len(one) == 1 and isinstance(one[0], Number)]
    return compare(*numbers) if len(numbers) == 2 and all(map(float.is_integer, numbers)) else None


def counter_values(loop: Loop, value: Callable[[Expression], Values]) -> tuple[float, ...]:
    """Return the values of a FOR loop's counter, in order; none if its bounds are not known or they are not whole."""
    found = [value(one) for one in loop.bounds]
    numbers = [one[0].value for one in found if len(one) == 1 and isinstance(one[0], Number)]
    if len(numbers) < max(2, len(found)) or not all(map(float.is_integer, numbers)):
        return ()
    first, last = numbers[:2]
    step = numbers[2] if len(numbers) > 2 else 1.0 if last >= first else -1.0
    count = int((last - first) / step) + 1 if step else 0
    return tuple(first + k * step for k in range(count)) if 0 < count <= MOST_TURNS else ()
