"""What the readers of all languages share: reasons, values that are computed once, sums of constants, and moves with their goals."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np

from truearm.correct.programs.data import Datum, Place, Scope
from truearm.correct.programs.program import Goal, Move, Program, Surroundings
from truearm.correct.programs.tokens import Tokens, is_bracketed, separated
from truearm.findings import Reason
from truearm.types import Floats

MOST_TARGETS = 1_000  # of one argument, such as the elements of a list
MOST_GOALS = 100_000  # of all moves
T = TypeVar("T")


class Uncertain(Exception):
    """Why something has no certain value, by the name of a reason with its values."""

    def __init__(self, name: str, /, **values: object) -> None:
        super().__init__(name)
        self.reason = Reason(name, values)

    def again(self, **values: object) -> Uncertain:
        """Return the same reason, with values: an exception that is raised again keeps all its tracebacks."""
        return Uncertain(self.reason.name, **{**self.reason.values, **values})


@dataclass(eq=False)
class Reading:
    """A program while it is read. ``results``: values and failures of names, each computed once.

    ``displaced``: why no pose of the program is certain.
    """

    program: Program
    surroundings: Surroundings
    displaced: Uncertain | None = None
    results: dict[object, Any] = field(default_factory=dict)
    n_goals: int = 0

    def once(self, key: object, compute: Callable[[], T]) -> T:
        """Return the value of a key, computed if it is not known yet. Raises Uncertain."""
        if key not in self.results:
            self.results[key] = Uncertain("deep", circular=True)  # while it is computed
            try:
                self.results[key] = compute()
            except Uncertain as uncertain:
                self.results[key] = uncertain.again()
        result = self.results[key]
        if isinstance(result, Uncertain):
            raise result.again()
        value: T = result
        return value

    def through(self, datum: Datum, evaluate: Callable[[Tokens, Scope], list[T]], key: object = None) -> list[T]:
        """Return what a name stands for, as ``evaluate`` and ``key`` understand it. Raises Uncertain."""
        self.check(datum)
        if not datum.values:
            raise Uncertain("no-value", name=datum.name)
        return self.once((datum, key), lambda: self.all_values(datum.values, evaluate))

    def all_values(
        self, values: Iterable[tuple[Tokens, Scope]], evaluate: Callable[[Tokens, Scope], list[T]]
    ) -> list[T]:
        """Return what values, each with its scope, stand for. Raises Uncertain, with where a value is computed."""
        alternatives: list[T] = []
        for tokens, scope in values:
            try:
                alternatives += evaluate(tokens, scope)
            except Uncertain as uncertain:
                if uncertain.reason.name != "run-time" or "where" in uncertain.reason.values or not tokens:
                    raise
                raise uncertain.again(where=self.program.where(scope.place(tokens[0]))) from None
            if len(alternatives) > MOST_TARGETS:
                raise Uncertain("many", most=MOST_TARGETS)
        return alternatives

    def check(self, datum: Datum) -> None:
        """Raise Uncertain if a datum may have other values than those that are assigned to it as a whole."""
        if datum.kind in ("parameter", "counter"):
            raise Uncertain("parameter", name=datum.name, kind=datum.kind)
        is_trusted = datum.name.lower() in self.surroundings.unchanged
        for place, code, function in [*datum.changes, *([] if is_trusted else datum.outside)]:
            location = self.program.where(place)
            raise Uncertain(code, name=datum.name, where=location, function=function, outside=not datum.changes)
        is_visible = datum.kind != "const" and not datum.local
        if is_visible and not is_trusted:
            self.check_absent()

    def given(self, name: str, otherwise: Uncertain) -> Floats:
        """Return the tool or work object that is given by a name. Raises ``otherwise`` if it is not."""
        self.program.needed_frames.add(name)
        if name not in self.surroundings.frames:
            raise otherwise
        return self.surroundings.frames[name]

    def check_displacement(self) -> None:
        """Raise Uncertain if no pose is certain."""
        if self.displaced is not None:
            raise self.displaced.again()
        self.check_absent()

    def check_absent(self) -> None:
        """Raise Uncertain if a routine in none of the files may do anything."""
        if self.surroundings.strict and self.program.absent:
            raise Uncertain("absent-routine", name=next(iter(self.program.absent)))

    def displace(self, code: str, name: str, place: Place) -> None:
        """Note why no pose is certain."""
        self.displaced = self.displaced or Uncertain(code, name=name, where=self.program.where(place))

    def add_move(self, move: Move, goals: Callable[[], list[Goal]]) -> None:
        """Add a move with its goals, or with the reason why they are not certain."""
        self.program.moves.append(move)
        self.program.steps.append(move)
        try:
            move.goals = goals()
            self.n_goals += len(move.goals)
            if self.n_goals > MOST_GOALS:
                raise Uncertain("many", most=MOST_GOALS)
        except Uncertain as uncertain:
            move.goals, move.reason = [], uncertain.reason
        except RecursionError:
            move.goals, move.reason = [], Reason("deep")


def only(poses: Sequence[Floats], otherwise: Uncertain) -> Floats:
    """Return the pose that all are. Raises Uncertain."""
    if not poses or np.ptp(poses, axis=0).max() > 1e-12:
        raise otherwise
    return poses[0]


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
