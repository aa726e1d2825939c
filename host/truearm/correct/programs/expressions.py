"""Sums and products of constants."""

from __future__ import annotations

from collections.abc import Callable

from truearm.correct.programs.reading import Uncertain
from truearm.correct.programs.tokens import Tokens, separated


def sum_or_product(tokens: Tokens, evaluate: Callable[[Tokens], object]) -> float | None:
    """Return the value of a sum or product, None if tokens are neither. Raises Uncertain.

    ``evaluate`` returns the value of an operand, which must be a number, or raises Uncertain.
    """
    for signs in ("+-", "*/"):
        operands = list(separated(tokens, *signs))
        if len(operands) > 1:
            break
    else:
        return None
    total = 0.0
    for operand in operands if operands[0] or signs == "*/" else operands[1:]:  # the first operand may have a sign
        sign = operand[0].text if operand and operand[0].text in signs else ""
        value = evaluate(operand[bool(sign) :])
        if not isinstance(value, float) or (sign == "/" and not value):
            raise Uncertain("run-time")
        if sign == "*":
            total *= value
        elif sign == "/":
            total /= value
        else:
            total += -value if sign == "-" else value
    return total
