"""The operators of a program, applied to numbers and texts."""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping

from truearm.files.programs.choices import GIVEN, NOT_GIVEN, PRESENT
from truearm.files.programs.sent_moves import sum_of
from truearm.files.programs.syntax import Number, Text, Truth
from truearm.files.programs.values import Unknown, Value

_ARITHMETIC: Mapping[str, Callable[[float, float], float]] = {
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
    "/": operator.truediv,
}
_WHOLE: Mapping[str, Callable[[float, float], float]] = {
    "div": operator.floordiv,
    "mod": operator.mod,
    "%": operator.mod,
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
            if (
                len(values) == 2
                and sign in _WHOLE
                and values[0] >= 0.0 < values[1]
                and all(map(float.is_integer, values))
            ):
                return Number(_WHOLE[sign](*values))
        if sign == "not" and isinstance(operands[0], Truth) and operands[0].type == PRESENT:
            return GIVEN if operands[0] == NOT_GIVEN else NOT_GIVEN
        if sign == "+" and any(isinstance(one, Text) for one in operands):
            return sum_of(operands, at)
        return next(
            (one for one in operands if isinstance(one, Unknown)), Unknown(f"the result of {sign} cannot be traced", at)
        )

    return result
