"""The values that reach the moves of a program, along every path that it may take.

The program is executed with *possibilities* in place of values. Where it branches, every block is executed and the
results are joined. A loop is repeated until its variables have no new possibilities; values that keep changing become
unknown. A routine is executed for each call, unless everything that it reads is as it was in an earlier call. Every
target found is therefore one to which the move can go. If a target may be computed at run time, the move records this.
A ``Language`` defines the meaning of the language's own functions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import chain, pairwise, product
from math import prod
from typing import Protocol, assert_never

from truearm.files.programs.choices import Choices
from truearm.files.programs.environment import HERE, Key
from truearm.files.programs.index_ways import Indexed, indexed_by, values_of_index
from truearm.files.programs.loop_execution import Loops
from truearm.files.programs.motions import UNDECLARED
from truearm.files.programs.operators import operator_of
from truearm.files.programs.routines import Routines
from truearm.files.programs.syntax import (
    Assign,
    Block,
    Call,
    Do,
    Element,
    Expression,
    If,
    Items,
    Jump,
    Leave,
    Loop,
    Name,
    Number,
    Operation,
    Return,
    Routine,
    Statement,
    Taught,
    Text,
    Truth,
)
from truearm.files.programs.tree_walks import places_in, root_of
from truearm.files.programs.values import (
    MOST_LISTS,
    MOST_NUMBERS,
    NO_ORIGIN,
    Fields,
    Listed,
    Origin,
    Pose,
    Unknown,
    Value,
    Values,
    combined,
    computed,
    distinct,
    first_unknown,
    joined,
    merged,
    most_choices,
    numbers_origin,
    origin_of,
    united,
)
from truearm.files.programs.work import BLOCK, CHANGED, ELEMENT, GEOMETRY, LETTERS, OPENED, SEVERAL, Work


class Language(Protocol):
    """The functions and operators of a language."""

    @property
    def effects(self) -> frozenset[str]:
        """Return the functions that move the robot or change what later moves do."""

    @property
    def distances(self) -> frozenset[str]:
        """Return the functions whose result depends on the numbers of the poses that they are given."""

    def call(self, flow: Flow, call: Call, arguments: Sequence[Values], named: Mapping[str, Values]) -> Values | None:
        """Apply a built-in function and return its result; None for any other function."""

    def item(self, of: Value, at: Value | str, place: int) -> Values:
        """Return an element of a list, counted from 0, or a field; nothing beyond the end of the list."""

    def changed(self, of: Value, at: Value | str, new: Values, place: int) -> Value:
        """Return a list or record with another item."""

    def literal(self, of: Taught) -> Value:
        """Return the value of a literal."""

    def changed_by(self, call: Call) -> Sequence[Expression]:
        """Return the arguments to which an instruction may assign that the program does not define."""


class Flow(Loops):
    """A program that is followed; ``motions`` contains the moves found, by place.

    ``unused``: names given from outside that the program does not mention, each with a similar one that it does, or "".

    ``judged``: the literals from whose numbers something is decided, by their places, each with the place of the first
    decision: a condition, a loop's bound or an index. What a function of poses returns does not count: it compares with
    the robot's own position, or asks for a solution, and either is right for the corrected numbers. Distances count,
    except from a place that is known only at run time.
    """

    def __init__(self, work: Work, language: Language, routines: Iterable[Routine]) -> None:
        super().__init__(work, Routines(work, language.changed_by, language.effects, routines))
        self.language = language
        self.judged: dict[int, int] = {}
        self.unused: dict[str, str] = {}
        self.choices = Choices()

    # statements

    def run(self, block: Block) -> bool:
        """Execute a block; return False if its end is never reached."""
        if self.loose:
            for statement in block:
                self._step(statement)
            return True
        return all(map(self._step, block))

    def _step(self, statement: Statement) -> bool:
        if not isinstance(statement, Leave | Return):  # these may have no place
            self.work.statement = statement
        self.work.spend(1)
        match statement:
            case Do() | Assign():
                indexed = self.work.indexed
                if indexed and next(places_in(statement), -1) in indexed:
                    self._each_index(statement, indexed_by(_expression_of(statement)))
                else:
                    self._simple(statement)
            case If():
                return self._choose(statement)
            case Loop():
                self.loop(statement)
            case Return(value):
                found = () if value is None else self.value(value)
                here = self.stack[-1]
                here.returns.append((found, self._since(here.depth)))
                return False
            case Leave(what):
                return self._leave(what)
            case Jump() | Routine():
                pass
            case _:
                assert_never(statement)
        return True

    def _simple(self, statement: Do | Assign) -> None:
        if isinstance(statement, Do):
            self.value(statement.what)
        else:
            self.assign(statement.target, self.value(statement.value), statement.scope)

    def _each_index(self, statement: Do | Assign, indexed: Mapping[str, Sequence[Indexed]]) -> None:
        """Execute a statement once for each value of its indexes, so that elements with one index stay together."""
        whole = _expression_of(statement)
        for name in indexed if not self._has_effects(whole) else ():
            key, rest = self.key_of(name), {other: ones for other, ones in indexed.items() if other != name}
            known = () if key is None else self.get(name) or ()
            values = values_of_index(name, indexed[name], whole, known, self.value)
            if key is None or not values:
                continue
            ways = []
            for each in values:
                self.environment.begin({key: (each,)})
                self._each_index(statement, rest)
                way = self.environment.end()
                ways.append({at: given for at, given in way.items() if at != key or given != (each,)})
            self.environment.join(ways)
            return
        self._simple(statement)

    def _has_effects(self, expression: Expression) -> bool:
        """Return whether the parts of an expression do more than give values; the outermost call follows after them."""
        if not isinstance(expression, Call):
            return self.routines.runs_routine(expression)
        routine = self.routines.by_name.get(expression.function)
        parts = (*expression.arguments, *(value for _, value in expression.named))
        return (routine is not None and routine.kind == "beside") or any(map(self.routines.runs_routine, parts))

    def _leave(self, what: str) -> bool:
        if what != "halt" and self.stack[-1].turns:
            turn = self.stack[-1].turns[-1]
            (turn.breaks if what == "break" else turn.continues).append(self._since(turn.depth))
        return False

    def _since(self, depth: int) -> dict[Key, Values]:
        """Return what was assigned since a depth: a copy, which each further end of a loop or routine has."""
        self.work.spend((self.environment.depth - depth) // SEVERAL)
        way = self.environment.since(depth)
        self.work.spend(len(way))
        return way

    def assign(self, target: Name | Element, values: Values, scope: str) -> None:
        if isinstance(target, Name):
            self.set(target.name, values, scope)
            return
        of = self.value(target.of)
        places = (target.at,) if isinstance(target.at, str) else self.value(target.at)
        self._decided(places, target.start)
        changed: Values = ()
        self.work.spend(
            CHANGED + len(places) * sum(OPENED if isinstance(one, Taught | Pose) else ELEMENT for one in of)
        )
        for place in places:
            each = tuple(self.language.changed(one, place, values, target.start) for one in of)
            self.work.spend(sum(_size(one) for one in each) // SEVERAL)
            changed = joined(changed, each)
            if len(changed) > MOST_LISTS:
                changed = merged(changed)
        if isinstance(target.of, Name | Element):
            self.assign(target.of, changed, scope)

    def _choose(self, choice: If) -> bool:
        """Execute the blocks of a choice. A condition that calls a routine is reached only if none before it holds."""
        conditions, blocks, whole = self.choices.reachable(choice, self.value)
        parts = [k for k, one in enumerate(conditions) if k and self.routines.runs_routine(one)]
        ways: list[list[dict[Key, Values]]] = []  # of each part of the choice, a layer deeper than the part before
        for start, end in pairwise([0, *parts, len(conditions)]):
            if start:
                self.environment.begin({})
            for condition in conditions[start:end]:
                self.decide(condition)
            ways.append(self._ways(blocks[start : end if end < len(conditions) else None]))
        if not whole:
            ways[-1].append({})
        while True:
            reached = ways.pop()
            if reached:
                self.environment.join(reached)
            if not ways:
                return bool(reached)
            end_of_part = self.environment.end()
            if reached:
                ways[-1].append(end_of_part)

    def _ways(self, blocks: Sequence[Block]) -> list[dict[Key, Values]]:
        """Execute blocks, of which one is taken; return what each assigns whose end is reached."""
        ways = []
        self.work.spend(BLOCK * len(blocks))
        for block in blocks:
            self.environment.begin({})
            reached = self.run(block)
            way = self.environment.end()
            if reached:
                ways.append(way)
        return ways

    # expressions

    def decide(self, condition: Expression) -> None:
        """Evaluate a condition and record in ``judged`` from which literals' numbers it is computed."""
        self._decided(self.value(condition), next(places_in(condition), 0))

    def _decided(self, values: Iterable[Value | str], place: int) -> None:
        """Record that these values decide what the program does."""
        for literal in origin_of(one for one in values if not isinstance(one, str)):
            self.judged.setdefault(literal.start, place)

    def value(self, expression: Expression) -> Values:
        """Return the possible values of an expression."""
        self.work.left -= 1  # it is checked at the next statement
        match expression:  # the most frequent first
            case Call():
                return self._call(expression)
            case Name(name, start):
                return self.get(name) or (Unknown(f"{name} has no value in this file", start, UNDECLARED),)
            case Taught():
                return (self.language.literal(expression),)
            case Number() | Text() | Truth():
                return (expression,)
            case Items(items, pose):
                self.work.spend(ELEMENT)
                return (Listed(tuple(self.value(item) for item in items), pose),)
            case Element(of, at, start):
                lists, places = self.value(of), (at,) if isinstance(at, str) else self.value(at)
                found: list[Value] = []
                self._decided(places, start)
                for one, place in product(lists, places):
                    whole = OPENED if isinstance(one, Taught | Pose) else ELEMENT
                    self.work.spend(whole if isinstance(place, str | Number) else _size(one))
                    reached = self.language.item(one, place, start)
                    self.work.spend(len(reached) // SEVERAL)
                    found += reached
                # beyond the end of a list the program would stop, so such a path is not followed further
                return distinct(tuple(found)) or (Unknown("the list has no such element", start),)
            case Operation(sign, operands, start):
                if sign in ("and", "or") and self.routines.runs_routine(operands[1]):
                    return self._either(expression)
                given = [self.value(operand) for operand in operands]
                self.work.spend(length_of_texts(given) // LETTERS)
                self.work.spend(ELEMENT * min(prod(map(len, given)), most_choices(given)))
                results = combined(start, operator_of(sign, start), given)
                if len(results) > MOST_NUMBERS and isinstance(results[0], Number):
                    results = (Unknown("it has too many possible values to trace", start),)
                return self._computed(results, origin_of(chain.from_iterable(given)))
            case _:
                assert_never(expression)

    def _either(self, of: Operation) -> Values:
        """Evaluate ``and`` or ``or``: the second operand is evaluated if the first does not decide."""
        first, second = of.operands
        found = self.value(first)
        self._decided(found, of.start)
        self.environment.begin({})
        found += self.value(second)
        self.environment.join([{}, self.environment.end()])
        origin = origin_of(found)
        return (Unknown(f"the result of {of.sign} cannot be traced", of.start, "", origin),)

    @staticmethod
    def _computed(values: Values, origin: Origin) -> Values:
        """Return values as computed also from the numbers of these literals."""
        return distinct(tuple(computed(one, origin) for one in values)) if origin else values

    def _call(self, call: Call) -> Values:
        arguments = [self.value(argument) for argument in call.arguments]
        named = {name: self.value(argument) for name, argument in call.named}
        if (routine := self.routines.by_name.get(call.function)) is not None:
            if routine.kind == "beside" and routine.name not in self.running:
                self.running[routine.name] = {HERE: dict.fromkeys(self.environment.get(HERE) or ())}
                self.environment.records.append(self.running[routine.name])
            return self.enter(routine, call, arguments, named)
        given = [*arguments, *named.values()] if named else arguments
        if (choices := prod(map(len, given))) > 1:
            self.work.spend(min(choices, most_choices(given)))
        found = self.language.call(self, call, arguments, named)
        if found is None:
            why = f"{call.function} is not defined in this file; it may move the robot"
            self.uncertain(call.function, call.start, call.end, why, "harmless")
            found = (Unknown(f"the result of {call.function} is known only at run time", call.start),)
        changed = self.language.changed_by(call)
        if not found and not changed:
            return ()
        origin = self._read(call.function, [*chain.from_iterable(given)])
        for argument in changed:
            if isinstance(argument, Name | Element) and self.get(root_of(argument)) is not None:
                was = united((origin, origin_of(self.value(argument))))
                self.assign(argument, (Unknown(f"{call.function} may change it at run time", 0, "", was),), "")
        return self._computed(found, origin)

    def _read(self, function: str, given: Sequence[Value]) -> Origin:
        """Return the literals from whose numbers the result of a built-in function is computed."""
        if function in self.language.distances:
            return NO_ORIGIN if first_unknown(given) else origin_of(given)
        return numbers_origin(given)

    def posed(self, at: int, function: Callable[..., Value], arguments: Sequence[Values]) -> Values:
        """Return what a function of poses gives for every choice of its arguments' possibilities (``combined``)."""
        self.work.spend(GEOMETRY * min(prod(map(len, arguments)), most_choices(arguments)))
        return combined(at, function, arguments)


def _expression_of(statement: Do | Assign) -> Expression:
    return statement.what if isinstance(statement, Do) else statement.value


def length_of_texts(given: Iterable[Values]) -> int:
    """Return the number of characters of all possible texts."""
    return sum(len(one.text) for values in given for one in values if isinstance(one, Text))


def _size(value: Value) -> int:
    """Return how many items a list may have."""
    return len(value.items) if isinstance(value, Listed | Fields) else 1
