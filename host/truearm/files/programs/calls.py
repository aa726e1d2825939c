"""The execution of routines. What a routine does is remembered, with all that it read: it is not executed again where that is the same."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from truearm.files.programs.choices import ABSENT
from truearm.files.programs.environment import GLOBAL, HERE, Key, Trace
from truearm.files.programs.moves import ANYWHERE, Moves, placed
from truearm.files.programs.routines import Routines
from truearm.files.programs.syntax import Block, Call, Element, Expression, Loop, Name, Routine
from truearm.files.programs.values import Begin, Unknown, Value, Values, all_of, joined
from truearm.files.programs.variables import Activation
from truearm.files.programs.work import CALL, SEVERAL, Work

MAX_CALLS = 20  # nesting depth of routines
MOST_EFFECTS = 8  # of a routine with the same arguments: maximum number that are remembered


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
    parent: Activation | None


class Calls(Moves, ABC):
    """Routines that are executed.

    ``called``: their names; ``running``: threads, and all values of names since they were started.
    """

    def __init__(self, work: Work, routines: Routines) -> None:
        super().__init__(work, routines)
        self.called: set[str] = set()
        self.running: dict[str, dict[Key, dict[Value, None]]] = {}
        self._scopes = GLOBAL
        self._effects: dict[object, list[_Effect]] = {}  # of routines by their arguments

    @abstractmethod
    def run(self, block: Block) -> bool:
        """Execute a block; return False if its end is never reached."""

    @abstractmethod
    def loop(self, loop: Loop) -> None:
        """Execute a loop."""

    @abstractmethod
    def value(self, expression: Expression) -> Values:
        """Return the possible values of an expression."""

    @abstractmethod
    def assign(self, target: Name | Element, values: Values, scope: str) -> None:
        """Assign to a variable or a part of it."""

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
        parent = self._enclosing(self.routines.parents[routine.name])
        places = dict[str, Expression]()
        required = [one for one in routine.parameters if not one.optional or one.default is not None]
        if call is not None:
            places = dict(zip((one.name for one in required), call.arguments, strict=False)) | dict(call.named)
        doubled = self.routines.doubled(routine, places)
        for name, root in doubled.items():
            self.set(root, _under_two_names(routine, root, name))
        given = dict(zip((one.name for one in required), arguments, strict=False)) | dict(named)
        effect = self._effect(_Entry(routine, call is not None, given, doubled, parent))
        here = self.environment.get(HERE) or ANYWHERE
        self.environment.join([{**way, HERE: placed(way[HERE], here)} for way in effect.ways])
        shared = {one.name for one in routine.parameters if one.shared}
        if call is not None:  # an argument passed by reference may have changed
            for name, place in places.items():
                if name not in shared:
                    continue
                for way in effect.after:
                    if isinstance(place, Name | Element) and way.get(name, given[name]) != given[name]:
                        self.assign(place, joined(self.value(place), way[name]), "")
        return effect.results or (Unknown(f"{routine.name} gives nothing", routine.start),)

    def _enclosing(self, name: str | None) -> Activation | None:
        """Return the innermost execution of a routine; None for no routine, or if it is not being executed."""
        if name is None:
            return None
        return next((one for one in reversed(self.stack) if one.routine and one.routine.name == name), None)

    def _effect(self, entry: _Entry) -> _Effect:
        """Execute a routine, unless it was executed with the same arguments where all that it reads was the same."""
        environment = self.environment
        known = self._effects.setdefault(self._inputs(entry), [])
        effect = next((one for one in reversed(known) if self._repeats(one.trace)), None)
        repeated = effect is not None
        if effect is None:
            self._scopes += 1
            self.begins[self._scopes] = self._places(environment.get(HERE) or ANYWHERE)
            trace = Trace(environment.depth, self._scopes, len(environment.records))
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
        here = environment.get(HERE) or ANYWHERE
        for start, starts, ends in trace.legs:
            self._leg(self.motions[start], placed(starts, here), ends)
        self.work.spend(sum(map(len, trace.written.values())) // SEVERAL)
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
        here = Activation(routine, trace.scope, entry.parent, trace.depth)
        begin: Values = (Begin(routine.name, trace.scope),)
        record: dict[Key, dict[Value, None]] = {HERE: dict.fromkeys(begin)}
        self.environment.begin({HERE: begin})
        self.stack.append(here)
        for parameter in routine.parameters:
            value = entry.given.get(parameter.name)
            if value is None and parameter.default is not None:
                value = self.value(parameter.default)
            if value is None and parameter.optional and entry.called:
                value = (ABSENT,)
            why = f"{parameter.name} is an argument of {routine.name} that no call in this file passes"
            self.set(parameter.name, value or (Unknown(why, routine.start),), "local")
        for name, root in entry.doubled.items():
            self.set(name, _under_two_names(routine, root, name), "local")
        if routine.handlers:
            self.environment.records.append(record)
        ordered = not self.loose
        first = self.routines.first_jump(routine)
        reached = self.run(routine.body[:first])
        if reached and first < len(routine.body):
            self.loose = True
            self.loop(Loop(None, routine.body[first:]))
        if routine.handlers:
            self.environment.records.pop()
            self._any_time(record, routine.handlers)
        self.loose = not ordered
        self.end_threads(routine.name)
        self.stack.pop()
        end = self.environment.end()
        ways = [*(way for _, way in here.returns), *([end] if reached else [])]
        self.work.spend(sum(len(values) for values, _ in here.returns))
        results = all_of([values for values, _ in here.returns if values])
        after = [{name: values for (scope, name), values in way.items() if scope == here.scope} for way in ways]
        ways = [{key: v for key, v in way.items() if key[0] != here.scope} for way in ways]
        return _Effect(results, ways, after, trace)

    def end_threads(self, parent: str | None) -> None:
        """Execute the threads of a routine once more with everything that the routine assigned while they ran."""
        for name in [name for name in self.running if self.routines.parents[name] == parent]:
            record = self.running.pop(name)
            self.environment.records = [one for one in self.environment.records if one is not record]
            self.environment.begin_any_time(record)
            self.enter(self.routines.by_name[name], None, (), {})
            self.environment.end()

    def _any_time(self, record: Mapping[Key, Mapping[Value, None]], blocks: Sequence[Block]) -> None:
        """Execute blocks with everything in a record. Their assignments are volatile, so none of them is kept."""
        for block in blocks:
            self.environment.begin_any_time(record)
            self.run(block)
            self.environment.end()


def _under_two_names(routine: Routine, root: str, name: str) -> Values:
    return (
        Unknown(f"{routine.name} reaches and changes one variable under two names, {root} and {name}", routine.start),
    )
