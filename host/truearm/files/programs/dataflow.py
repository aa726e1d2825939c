"""The values that reach the moves of a program, along every path that it may take.

The program is executed with *possibilities* in place of values. Where it branches, every block is executed and the
results are joined. A loop is repeated until its variables have no new possibilities; values that keep changing become
unknown. A routine is executed for each call, unless everything that it reads is as it was in an earlier call. Every
target found is therefore one to which the move can go. If a target may be computed at run time, the move records this.
A ``Language`` defines the meaning of the language's own functions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain, pairwise, product
from math import prod
from typing import NamedTuple, Protocol, assert_never

from truearm.files.programs.environment import GLOBAL, HERE, Environment, Key, Trace, few
from truearm.files.programs.motions import UNDECLARED, Motion, goal_of
from truearm.files.programs.operators import operator_of
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
from truearm.files.programs.tree_walks import (
    assigns_parameters,
    calls_in,
    root_of,
    routines_in,
    statements_in,
    touched_by,
)
from truearm.files.programs.values import (
    MAX_NESTED,
    MOST_LISTS,
    MOST_NUMBERS,
    Begin,
    Fields,
    Goal,
    Listed,
    Pose,
    Unknown,
    Value,
    Values,
    all_of,
    combined,
    counts,
    distinct,
    joined,
    merged,
    most_choices,
)
from truearm.files.programs.work import CALL, ELEMENT, GEOMETRY, GOAL, LETTERS, MOVE, OPENED, SEVERAL, Work

MAX_CALLS = 20  # nesting depth of routines
MAX_TURNS = 4  # of a loop, before values that still change become unknown

TOOL = "tool in force"  # variable names contain no spaces
_ANYWHERE: Values = (Unknown("the position in which the program starts is not known", 0),)
MOST_EFFECTS = 8  # of a routine with the same arguments: maximum number that are remembered

Names = set[str]


class Language(Protocol):
    """The functions and operators of a language."""

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


@dataclass
class _Activation:
    """A routine that is being executed."""

    routine: Routine | None
    scope: int
    parent: _Activation | None  # of the enclosing routine
    depth: int  # of its own layer
    returns: list[tuple[Values, dict[Key, Values]]] = field(default_factory=list)


class _Effect(NamedTuple):
    """What a routine does: what it returns, what it assigns on each way through it, to its own names, and its trace."""

    results: Values
    ways: Sequence[Mapping[Key, Values]]
    after: Sequence[Mapping[str, Values]]
    trace: Trace


class _Entry(NamedTuple):
    """What a routine is entered with. ``called``: by a statement of the program."""

    routine: Routine
    called: bool
    given: Mapping[str, Values]
    doubled: Mapping[str, str]
    parent: _Activation | None


@dataclass
class _Turn:
    """A loop that is being executed."""

    depth: int
    breaks: list[dict[Key, Values]] = field(default_factory=list)
    continues: list[dict[Key, Values]] = field(default_factory=list)


class Flow:
    """A program that is followed; ``motions`` contains the moves found, by place."""

    def __init__(self, work: Work, language: Language, routines: Iterable[Routine]) -> None:
        self.work, self.source, self.language = work, work.source, language
        self.motions: dict[int, Motion] = {}
        self.environment = Environment(self.work)
        self.parents: dict[str, str | None] = {}
        self.routines: dict[str, Routine] = {}
        self.called: set[str] = set()
        self.volatile: set[str] = set()
        # of routines and conditions, once it was asked
        self.assigning: dict[str, bool] = {}  # whether they assign to what is given to them
        self.touched: dict[str, tuple[set[str], set[str], set[str]]] = {}  # what they themselves use, change and call
        self.reached: dict[str, tuple[set[str], set[str]]] = {}  # what they and those that they call use and change
        self.running_routines: dict[int, bool] = {}  # whether they run a routine, by their identity
        self.first_jumps: dict[str, int] = {}  # the place of the first statement of a routine with a jump
        for routine in routines:
            self._declare(routine, None)
        self._find_volatile()
        self.scopes = GLOBAL
        self.stack = [_Activation(None, GLOBAL, None, 0)]
        self.turns: list[_Turn] = []
        self.effects: dict[object, list[_Effect]] = {}  # of routines by their arguments
        self.begins: dict[int, Values] = {}  # where the robot was when a routine began, by its scope
        self.loose = False  # jumps: statements may be executed in any order
        self.running: dict[
            str, dict[Key, dict[Value, None]]
        ] = {}  # threads, and all values of names since they were started

    def _declare(self, routine: Routine, parent: str | None) -> None:
        if routine.name in self.routines:
            raise self.source.wrong(routine.start, f"{routine.name} is defined twice; rename one")
        self.routines[routine.name], self.parents[routine.name] = routine, parent
        for inner in routines_in(routine.body):
            self._declare(inner, routine.name)

    def _find_volatile(self) -> None:
        """Record what may change at any time: everything assigned in concurrent code and the routines it calls."""
        blocks = [block for one in self.routines.values() for block in one.handlers]
        blocks += [one.body for one in self.routines.values() if one.kind == "beside"]
        seen: set[str] = set()
        while blocks:
            block = blocks.pop()
            self.volatile |= {
                root_of(one.target) for one in statements_in(block) if isinstance(one, Assign) and one.scope != "local"
            }
            for call in calls_in(block):
                routine = self.routines.get(call.function)
                self.volatile |= {TOOL} if call.function == "set_tcp" else set()
                if routine is None:
                    self.volatile |= {root_of(one) for one in self.language.changed_by(call)}
                elif self._assigns_parameters(routine):
                    self.volatile |= {root_of(one) for one in call.arguments}
                if routine is not None and routine.name not in seen:
                    seen.add(routine.name)
                    blocks.append(routine.body)
        self.volatile.discard("")

    def _assigns_parameters(self, routine: Routine) -> bool:
        if routine.name not in self.assigning:
            self.assigning[routine.name] = assigns_parameters(routine)
        return self.assigning[routine.name]

    # variables

    def get(self, name: str) -> Values | None:
        """Return the possible values of a name here; None if it is unknown."""
        if name in self.volatile and not any(one.routine and one.routine.kind == "beside" for one in self.stack):
            return (Unknown(f"{name} is changed by code that runs concurrently (a trap, a handler or a thread)", 0),)
        at: _Activation | None = self.stack[-1]
        while at is not None:
            if (found := self.environment.get((at.scope, name))) is not None:
                return found
            at = at.parent
        return self.environment.get((GLOBAL, name))

    def set(self, name: str, values: Values, scope: str = "") -> None:
        """Assign to a name.

        If a routine assigns to a name without declaring it, that is the program's variable of this name if there is
        one. If an enclosing routine has a variable of this name, either may be meant.
        """
        if any(isinstance(one, Listed | Fields) and one.depth > MAX_NESTED for one in values):
            values = (Unknown(f"{name} has too many nested lists to trace", 0),)
        own = (self.stack[-1].scope, name)
        if self.loose:
            values = joined(self.get(name), values)
        if scope == "global" or (not scope and name == TOOL):
            for trace in self.environment.traces[-1:]:
                trace.swept.add(name)
            for one in self.stack[1:]:  # or the variable of a caller that has its own
                if (before := self.environment.get((one.scope, name))) is not None:
                    self.environment.set((one.scope, name), joined(before, values))
                    for trace in self.environment.traces:
                        trace.repeatable &= one.scope >= trace.scope
            self.environment.set((GLOBAL, name), values)
            return
        if not scope and self.environment.get(own) is None:
            at = self.stack[-1].parent
            outside = [(one.scope, name) for one in _upward(at)] + [(GLOBAL, name)]
            for key in outside:
                if key != own and (before := self.environment.get(key)) is not None:
                    self.environment.set(key, values if key[0] == GLOBAL else joined(before, values))
                    return
        self.environment.set(own, values)

    # statements

    def run(self, block: Block) -> bool:
        """Execute a block; return False if its end is never reached."""
        if self.loose:
            for statement in block:
                self._step(statement)
            return True
        return all(self._step(statement) for statement in block)

    def _step(self, statement: Statement) -> bool:
        if not isinstance(statement, Leave | Return):  # these may have no place
            self.work.statement = statement
        self.work.spend(1)
        match statement:
            case Do(what):
                self.value(what)
            case Assign(target, value, scope):
                self._assign(target, self.value(value), scope)
            case If():
                return self._choose(statement)
            case Loop():
                self._loop(statement)
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

    def _leave(self, what: str) -> bool:
        if what != "halt" and self.turns:
            turn = self.turns[-1]
            (turn.breaks if what == "break" else turn.continues).append(self._since(turn.depth))
        return False

    def _since(self, depth: int) -> dict[Key, Values]:
        """Return what was assigned since a depth: a copy, which each further end of a loop or routine has."""
        self.work.spend((self.environment.depth - depth) // SEVERAL)
        way = self.environment.since(depth)
        self.work.spend(len(way))
        return way

    def _assign(self, target: Name | Element, values: Values, scope: str) -> None:
        if isinstance(target, Name):
            self.set(target.name, values, scope)
            return
        of = self.value(target.of)
        places = (target.at,) if isinstance(target.at, str) else self.value(target.at)
        changed: Values = ()
        self.work.spend(len(places) * sum(OPENED if isinstance(one, Taught | Pose) else ELEMENT for one in of))
        for place in places:
            each = tuple(self.language.changed(one, place, values, target.start) for one in of)
            self.work.spend(sum(len(one.items) for one in each if isinstance(one, Listed)) // SEVERAL)
            changed = joined(changed, each)
            if len(changed) > MOST_LISTS:
                changed = merged(changed)
        if isinstance(target.of, Name | Element):
            self._assign(target.of, changed, scope)

    def _choose(self, choice: If) -> bool:
        """Execute the blocks of a choice. A condition that calls a routine is reached only if none before it holds."""
        conditions, blocks, whole = choice
        parts = [k for k, one in enumerate(conditions) if k and self._runs_routine(one)]
        ways: list[list[dict[Key, Values]]] = []  # of each part of the choice, a layer deeper than the part before
        for start, end in pairwise([0, *parts, len(conditions)]):
            if start:
                self.environment.begin({})
            for condition in conditions[start:end]:
                self.value(condition)
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

    def _runs_routine(self, expression: Expression) -> bool:
        """Return whether the value of an expression calls a routine of the program, which may change variables."""
        found = self.running_routines.get(id(expression))
        if found is None:
            found = any(call.function in self.routines for call in calls_in(expression))
            self.running_routines[id(expression)] = found
        return found

    def _ways(self, blocks: Sequence[Block]) -> list[dict[Key, Values]]:
        """Execute blocks, of which one is taken; return what each assigns whose end is reached."""
        ways = []
        for block in blocks:
            self.environment.begin({})
            reached = self.run(block)
            way = self.environment.end()
            if reached:
                ways.append(way)
        return ways

    def _loop(self, loop: Loop) -> None:
        environment = self.environment
        for turns in range(MAX_TURNS + 2):
            turn = _Turn(environment.depth)
            environment.begin({})
            self.turns.append(turn)
            if loop.counter:
                self.set(loop.counter, (Unknown(f"{loop.counter} counts", 0),), "local")
            if loop.condition is not None:
                self.value(loop.condition)
            reached = self.run(loop.body)
            self.turns.pop()
            end = environment.end()
            before = {key: environment.get(key) for way in (end, *turn.continues) for key in way}
            self.work.spend(len(before))
            environment.join([{}, *turn.continues, *([end] if reached else [])])
            grown = [key for key, values in before.items() if environment.get(key) != values]
            if not grown:
                break
            for key in grown:
                if turns >= MAX_TURNS or (turns and counts(before[key], environment.get(key))):
                    environment.set(key, (Unknown(f"{key[1]} changes between iterations of a loop", 0),))
        if loop.condition is not None and self._runs_routine(loop.condition):
            self.value(loop.condition)  # it is evaluated once more often than the body
        environment.join([{}, *turn.breaks])

    # expressions

    def value(self, expression: Expression) -> Values:
        """Return the possible values of an expression."""
        self.work.spend(1)
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
                for one, place in product(lists, places):
                    whole = OPENED if isinstance(one, Taught | Pose) else ELEMENT
                    self.work.spend(whole if isinstance(place, str | Number) else _size(one))
                    reached = self.language.item(one, place, start)
                    self.work.spend(len(reached) // SEVERAL)
                    found += reached
                # beyond the end of a list the program would stop, so such a path is not followed further
                return distinct(found) or (Unknown("the list has no such element", start),)
            case Operation(sign, operands, start):
                if sign in ("and", "or") and self._runs_routine(operands[1]):
                    return self._either(expression)
                given = [self.value(operand) for operand in operands]
                self.work.spend(length_of_texts(given) // LETTERS)
                self.work.spend(ELEMENT * min(prod(map(len, given)), most_choices(given)))
                results = combined(start, operator_of(sign, start), given)
                if len(results) > MOST_NUMBERS and isinstance(results[0], Number):
                    return (Unknown("it has too many possible values to trace", start),)
                return results
            case _:
                assert_never(expression)

    def _either(self, of: Operation) -> Values:
        """Evaluate ``and`` or ``or``: the second operand is evaluated if the first does not decide."""
        first, second = of.operands
        self.value(first)
        self.environment.join([{}, *self._ways(((Do(second),),))])
        return (Unknown(f"the result of {of.sign} cannot be traced", of.start),)

    def _call(self, call: Call) -> Values:
        arguments = [self.value(argument) for argument in call.arguments]
        named = {name: self.value(argument) for name, argument in call.named}
        if (routine := self.routines.get(call.function)) is not None:
            if routine.kind == "beside" and routine.name not in self.running:
                self.running[routine.name] = {HERE: dict.fromkeys(self.environment.get(HERE) or ())}
                self.environment.records.append(self.running[routine.name])
            return self.enter(routine, call, arguments, named)
        if (choices := prod(map(len, (*arguments, *named.values())))) > 1:
            self.work.spend(min(choices, most_choices((*arguments, *named.values()))))
        found = self.language.call(self, call, arguments, named)
        if found is None:
            why = f"{call.function} is not defined in this file; it may move the robot"
            self.uncertain(call.function, call.start, call.end, why, "harmless")
            found = (Unknown(f"the result of {call.function} is known only at run time", call.start),)
        for argument in self.language.changed_by(call):
            if isinstance(argument, Name | Element) and self.get(root_of(argument)) is not None:
                self._assign(argument, (Unknown(f"{call.function} may change it at run time", 0),), "")
        return found

    def posed(self, at: int, function: Callable[..., Value], arguments: Sequence[Values]) -> Values:
        """Return what a function of poses gives for every choice of its arguments' possibilities (``combined``)."""
        self.work.spend(GEOMETRY * min(prod(map(len, arguments)), most_choices(arguments)))
        return combined(at, function, arguments)

    def enter(
        self, routine: Routine, call: Call | None, arguments: Sequence[Values], named: Mapping[str, Values]
    ) -> Values:
        """Execute a routine with the possibilities of its arguments."""
        self.called.add(routine.name)
        self.work.spend(CALL + len(routine.parameters))
        if len(self.stack) > MAX_CALLS or any(one.routine is routine for one in self.stack):
            at = call or Call(routine.name, (), (), routine.start, routine.start)
            self.uncertain(
                at.function,
                at.start,
                at.end,
                f"{routine.name} calls itself, or its calls are nested too deeply to trace",
            )
            self._unrepeatable()
            return (Unknown(f"{routine.name} calls itself", at.start),)
        parent = next(
            (one for one in reversed(self.stack) if one.routine and one.routine.name == self.parents[routine.name]),
            None,
        )
        places = dict[str, Expression]()
        required = [one for one in routine.parameters if not one.optional or one.default is not None]
        if call is not None:
            places = dict(zip((one.name for one in required), call.arguments, strict=False)) | dict(call.named)
        doubled = self._doubled(routine, places)
        for name, root in doubled.items():
            self.set(root, (Unknown(f"{routine.name} changes it under two names, {root} and {name}", routine.start),))
        given = dict(zip((one.name for one in required), arguments, strict=False)) | dict(named)
        effect = self._effect(_Entry(routine, call is not None, given, doubled, parent))
        here = self.environment.get(HERE) or _ANYWHERE
        self.environment.join([{**way, HERE: _from(way[HERE], here)} for way in effect.ways])
        shared = {one.name for one in routine.parameters if one.shared}
        if call is not None:  # an argument passed by reference may have changed
            for name, place in places.items():
                if name not in shared:
                    continue
                for way in effect.after:
                    if isinstance(place, Name | Element) and way.get(name, given[name]) != given[name]:
                        self._assign(place, joined(self.value(place), way[name]), "")
        return effect.results or (Unknown(f"{routine.name} gives nothing", routine.start),)

    def _effect(self, entry: _Entry) -> _Effect:
        """Execute a routine, unless it was executed with the same arguments where all that it reads was the same."""
        environment = self.environment
        known = self.effects.setdefault(self._inputs(entry), [])
        effect = next((one for one in reversed(known) if self._repeats(one.trace)), None)
        repeated = effect is not None
        if effect is None:
            self.scopes += 1
            self.begins[self.scopes] = self._places(environment.get(HERE) or _ANYWHERE)
            trace = Trace(environment.depth, self.scopes, len(environment.records))
            environment.traces.append(trace)
            effect = self._executed(entry, trace)
            environment.traces.pop()
            if trace.repeatable:
                known.append(effect)
                del known[:-MOST_EFFECTS]
            else:
                self._unrepeatable()
        self._inherit(effect.trace, repeated)
        return effect

    def _inputs(self, entry: _Entry) -> object:
        """Return what decides, besides what a routine reads, what it does."""
        beside = any(one.routine and one.routine.kind == "beside" for one in self.stack)
        scope = GLOBAL if entry.parent is None else entry.parent.scope
        given = (tuple(entry.given.items()), tuple(entry.doubled.items()))
        return entry.routine.name, entry.called, given, scope, beside, self.loose

    def _repeats(self, trace: Trace) -> bool:
        """Return whether all that a routine read is the same here."""
        environment = self.environment
        self.work.spend(1 + (len(trace.read) + len(trace.written)) // 2)
        for key, values in trace.read.items():
            found, _ = environment.find(key)
            if not (found is values or found == values):
                return False
        return all(environment.find((one.scope, name))[0] is None for one in self.stack[1:] for name in trace.swept)

    def _inherit(self, trace: Trace, repeated: bool) -> None:
        """Note what a routine does as done by its caller, and if it was not executed again, in the records and moves too."""
        environment = self.environment
        here = environment.get(HERE) or _ANYWHERE
        for start, starts, ends in trace.legs:
            self._leg(self.motions[start], _from(starts, here), ends)
        for key, values in trace.written.items():
            environment.trace(key, values)
            if repeated:
                environment.record(key, values)
        for outer in environment.traces[-1:]:
            for key in trace.read:
                outer.reads(key, *environment.find(key))
            outer.swept |= trace.swept

    def _unrepeatable(self) -> None:
        """Note that what is executed now depends on more than what it reads."""
        for trace in self.environment.traces:
            trace.repeatable = False

    def _executed(self, entry: _Entry, trace: Trace) -> _Effect:
        routine = entry.routine
        trace.repeatable = routine.kind != "beside"
        here = _Activation(routine, trace.scope, entry.parent, trace.depth)
        begin: Values = (Begin(routine.name, trace.scope),)
        record: dict[Key, dict[Value, None]] = {HERE: dict.fromkeys(begin)}
        self.environment.begin({HERE: begin})
        self.stack.append(here)
        for parameter in routine.parameters:
            value = entry.given.get(parameter.name)
            if value is None and parameter.default is not None:
                value = self.value(parameter.default)
            if value is None and parameter.optional and entry.called:
                value = (Truth(False),)
            why = f"{parameter.name} is an argument of {routine.name} that no call in this file passes"
            self.set(parameter.name, value or (Unknown(why, routine.start),), "local")
        for name, root in entry.doubled.items():
            self.set(
                name,
                (Unknown(f"{routine.name} changes it under two names, {root} and {name}", routine.start),),
                "local",
            )
        outer, self.turns = self.turns, []
        if routine.handlers:
            self.environment.records.append(record)
        ordered = not self.loose
        first = self._first_jump(routine)
        reached = self.run(routine.body[:first])
        if reached and first < len(routine.body):
            self.loose = True
            self._loop(Loop(None, routine.body[first:]))
        if routine.handlers:
            self.environment.records.pop()
            self._any_time(record, routine.handlers)
        self.loose = not ordered
        self.end_threads(routine.name)
        self.turns = outer
        self.stack.pop()
        end = self.environment.end()
        ways = [*(way for _, way in here.returns), *([end] if reached else [])]
        self.work.spend(sum(len(values) for values, _ in here.returns))
        results = all_of([values for values, _ in here.returns if values])
        after = [{name: values for (scope, name), values in way.items() if scope == here.scope} for way in ways]
        ways = [{key: v for key, v in way.items() if key[0] != here.scope} for way in ways]
        return _Effect(results, ways, after, trace)

    def _first_jump(self, routine: Routine) -> int:
        """The place of the first statement of a routine with a jump in it, or behind the last."""
        if routine.name not in self.first_jumps:
            jumps = (
                k for k, one in enumerate(routine.body) if any(isinstance(part, Jump) for part in statements_in((one,)))
            )
            self.first_jumps[routine.name] = next(jumps, len(routine.body))
        return self.first_jumps[routine.name]

    def _doubled(self, routine: Routine, places: Mapping[str, Expression]) -> dict[str, str]:
        """Return parameters (and their variables) that the routine reaches by two names and changes by one of them."""
        roots = {
            one.name: root for one in routine.parameters if one.shared and (root := root_of(places.get(one.name))) != ""
        }
        if not roots:
            return {}
        if routine.name not in self.reached:
            self.reached[routine.name] = self._reached_by(routine)
        used, changed = self.reached[routine.name]
        given = list(roots.values())
        return {
            name: root
            for name, root in roots.items()
            if (root in used or given.count(root) > 1) and not changed.isdisjoint((name, *roots, root))
        }

    def _reached_by(self, routine: Routine) -> tuple[Names, Names]:
        """The names that a routine and those that it calls use, and those that they change."""
        used, changed, found, waiting = set[str](), set[str](), {routine.name}, [routine.name]
        while waiting:
            name = waiting.pop()
            if name not in self.touched:
                self.touched[name] = touched_by(self.routines[name], self.routines, self.language.changed_by)
            own_used, own_changed, called = self.touched[name]
            self.work.spend(4 + (len(own_used) + len(own_changed) + len(called)) // SEVERAL)
            used |= own_used
            changed |= own_changed
            waiting += called - found
            found |= called
        return used, changed

    def end_threads(self, parent: str | None) -> None:
        """Execute the threads of a routine once more with everything that the routine assigned while they ran."""
        for name in [name for name in self.running if self.parents[name] == parent]:
            record = self.running.pop(name)
            self.environment.records = [one for one in self.environment.records if one is not record]
            self.environment.begin_any_time(record)
            self.enter(self.routines[name], None, (), {})
            self.environment.end()

    def _any_time(self, record: Mapping[Key, Mapping[Value, None]], blocks: Sequence[Block]) -> None:
        """Execute blocks with everything in a record. Their assignments are volatile, so none of them is kept."""
        for block in blocks:
            self.environment.begin_any_time(record)
            self.run(block)
            self.environment.end()

    # moves

    def motion(self, name: str, start: int, end: int) -> Motion:
        """Return the record of a statement that moves the robot."""
        return self.motions.setdefault(start, Motion(name, start, end))

    def uncertain(self, name: str, start: int, end: int, why: str, remedy: str = "") -> None:
        """Record a statement that may move the robot and cannot be corrected; ``remedy``: the argument to resolve it."""
        self.motion(name, start, end).problems[why, remedy] = None
        self.environment.set(HERE, (Unknown(why, start),))

    def goes_to(
        self,
        call: Call,
        targets: Sequence[tuple[Values, Expression]],
        tools: Values,
        frames: Values,
        straight: bool = False,
    ) -> None:
        """Record a move to every possible target; joints computed for a pose have their own tool.

        ``straight``: along a line from the robot's position.
        """
        motion = self.motion(call.function, call.start, call.end)
        self.work.spend(MOVE + GOAL * len(tools) * len(frames) * sum(len(values) for values, _ in targets))
        ends: dict[Value, None] = {}
        for tool in tools:
            for frame in frames:
                for k, (values, argument) in enumerate(targets, start=1):
                    for value in values:
                        found = goal_of(value, tool, frame, argument)
                        if isinstance(found, Goal):
                            motion.goals[found] = None
                        else:
                            motion.problems[found] = None
                        if k == len(targets):
                            ends[found if isinstance(found, Goal) else Unknown(found[0], call.start)] = None
        reached = few(tuple(ends))
        motion.straight = straight
        self._leg(motion, self.environment.get(HERE) or _ANYWHERE, tuple(ends))
        self.environment.set(HERE, joined(self.environment.get(HERE), reached) if self.loose else reached)

    def _leg(self, motion: Motion, starts: Values, ends: Values) -> None:
        """Record from where and to where a move is made. What begins where a routine does is made for each of its calls."""
        if any(isinstance(one, Begin) for one in starts):
            self.environment.traces[-1].legs[motion.start, starts, ends] = None
        leg = (self._places(starts), ends)
        if not motion.legs or motion.legs[-1] != leg:
            self.work.spend(len(leg[0]) * len(ends) // SEVERAL)
            motion.legs.append(leg)

    def _places(self, values: Values) -> Values:
        """Return where the robot is, with the places themselves for those where routines begin."""
        known = chain.from_iterable(self.begins[one.scope] if isinstance(one, Begin) else (one,) for one in values)
        return distinct(known) if any(isinstance(one, Begin) for one in values) else values


def _from(values: Values, here: Values) -> Values:
    """Return where the robot is after a routine that was called ``here``."""
    if not any(isinstance(one, Begin) for one in values):
        return values
    return distinct(chain.from_iterable(here if isinstance(one, Begin) else (one,) for one in values))


def length_of_texts(given: Iterable[Values]) -> int:
    """Return the number of characters of all possible texts."""
    return sum(len(one.text) for values in given for one in values if isinstance(one, Text))


def _size(value: Value) -> int:
    """Return how many items a list may have."""
    return len(value.items) if isinstance(value, Listed | Fields) else 1


def _upward(at: _Activation | None) -> Iterator[_Activation]:
    while at is not None:
        yield at
        at = at.parent
