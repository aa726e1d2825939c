"""Numbers, and sums and products of constants."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from truearm.correct.programs.reading import Uncertain
from truearm.correct.programs.tokens import Tokens, is_bracketed, separated

T = TypeVar("T")


def arithmetic(tokens: Tokens, evaluate: Callable[[Tokens], T]) -> T | float | None:
    """Return the value of a number, a sum, a product or an expression in brackets, None of others. Raises Uncertain.

    ``evaluate`` returns the value of what is in brackets or of an operand, which must be a number, or raises Uncertain.
    """
    if len(tokens) == 1 and tokens[0].kind == "number":
        return float(tokens[0].text)
    if is_bracketed(tokens, 0, "("):
        return evaluate(tokens[1:-1])
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
