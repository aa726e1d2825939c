"""The operators of a program, applied to numbers and texts."""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping

from truearm.files.programs.sent_moves import sum_of
from truearm.files.programs.syntax import Number, Text
from truearm.files.programs.values import Unknown, Value

_ARITHMETIC: Mapping[str, Callable[[float, float], float]] = {
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
    "/": operator.truediv,
}


def operator_of(sign: str, at: int) -> Callable[..., Value]:
    """Return the function of an operator on numbers and texts; comparisons are left to run time."""

    def result(*operands: Value) -> Value:
        values = [one.value for one in operands if isinstance(one, Number)]
        if len(values) == len(operands):
            if len(values) == 1 and sign in "+-":
                return Number(-values[0] if sign == "-" else values[0])
            if len(values) == 2 and sign in _ARITHMETIC and not (sign == "/" and values[1] == 0.0):
                return Number(_ARITHMETIC[sign](*values))
        if sign == "+" and any(isinstance(one, Text) for one in operands):
            return sum_of(operands, at)
        return next(
            (one for one in operands if isinstance(one, Unknown)), Unknown(f"the result of {sign} cannot be traced", at)
        )

    return result
