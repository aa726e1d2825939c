"""Elements of several lists with one index in one statement: only those with the same index belong together.

``movej(get_inverse_kin(path[i], qnear=near[i]))`` and ``MoveL p{i},v100,fine,tool0\\WObj:=w{i}`` go to as many targets as
the lists have elements, whatever ``i`` is: beyond them the program would stop.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

from truearm.files.programs.syntax import Element, Expression, Name, Number, Operation
from truearm.files.programs.tree_walks import names_in
from truearm.files.programs.values import Listed, Unknown, Values, origin_of

MOST_WAYS = 1_000  # of one statement
FEWEST = 2  # elements with one index
_NOT_ALWAYS = frozenset({"and", "or"})  # operators that may leave out their second operand


class Indexed(NamedTuple):
    """An element of a list whose index is a name plus a number."""

    of: Expression
    plus: float


def indexed_by(expression: Expression) -> dict[str, list[Indexed]]:
    """Return by which names an expression indexes several elements that it always evaluates."""
    found: dict[str, list[Indexed]] = {}
    for one in _elements_in(expression):
        index = _name_and_number(one.at)
        if index is not None:
            found.setdefault(index[0], []).append(Indexed(one.of, index[1]))
    return {name: ones for name, ones in found.items() if len(ones) >= FEWEST}


def _elements_in(node: object) -> Iterator[Element]:
    if isinstance(node, Operation) and node.sign in _NOT_ALWAYS:
        return
    if isinstance(node, Element):
        yield node
    if isinstance(node, tuple):
        for inner in node:
            if isinstance(inner, tuple):
                yield from _elements_in(inner)


def _name_and_number(index: Expression | str) -> tuple[str, float] | None:
    """Return the name and the number of an index such as ``i``, ``i + 1`` or ``(i - 1) - 1``; None for any other."""
    if isinstance(index, Name):
        return index.name, 0.0
    if not isinstance(index, Operation) or len(index.operands) != 2 or index.sign not in "+-":
        return None
    first, second = index.operands
    inner = _name_and_number(first)
    if inner is None or not isinstance(second, Number) or second.value != int(second.value):
        return None
    return inner[0], inner[1] + (second.value if index.sign == "+" else -second.value)


def values_of_index(
    name: str, ones: Sequence[Indexed], whole: Expression, known: Values, value: Callable[[Expression], Values]
) -> Values:
    """Return the values of an index for which all its elements exist, each to be followed alone; nothing if that is not certain.

    ``known``: its possible values so far. If they are not numbers, ``whole`` must use it as an index only.
    """
    if all(isinstance(one, Number) for one in known):
        return known if 1 < len(known) <= MOST_WAYS else ()
    if not any(isinstance(one, Unknown) for one in known) or list(names_in(whole)).count(name) > len(ones):
        return ()
    firsts, ends = [], []
    for one in ones:
        lists = value(one.of)
        sizes = [len(each.items) for each in lists if isinstance(each, Listed) and not each.pose]
        if len(sizes) < len(lists) or not sizes:
            return ()
        firsts.append(int(-one.plus))
        ends.append(int(max(sizes) - one.plus))
    origin = origin_of(known)
    found = range(max(firsts), min(ends))
    return tuple(Number(float(k), origin) for k in found) if len(found) <= MOST_WAYS else ()
