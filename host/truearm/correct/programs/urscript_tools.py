"""The tool in force at each move of a URScript: that of every set_tcp that may be the last one before it.

A call of a function that sets the tool counts as its last set_tcp. If several may be in force, they must be equal.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np

from truearm.correct.programs.order import preceding
from truearm.correct.programs.program import Step, Uncertain
from truearm.correct.programs.tokens import DEEPEST, Token, Tokens, closing
from truearm.correct.programs.urscript_names import Routine, Script, Statement, calls_in
from truearm.types import Floats

MOST_SETTERS = 100  # that may be the last one before a move


@dataclass(eq=False)
class Event:
    """A call in a statement: of set_tcp, of a function of the script, of a move; or the end of a function (no name)."""

    name: str
    tokens: Tokens
    statement: Statement


@dataclass(eq=False)
class Tools:
    """The tools of a script. ``pose_of`` returns the pose (4, 4) that a set_tcp sets, or raises Uncertain."""

    script: Script
    pose_of: Callable[[Event], Floats]
    events: dict[tuple[int, int], Event] = field(default_factory=dict)
    last: dict[Event | Routine, frozenset[Event | Routine | None]] = field(default_factory=dict)
    calls: dict[str, list[Event]] = field(default_factory=lambda: defaultdict(list))
    exits: dict[Routine, list[Event]] = field(default_factory=lambda: defaultdict(list))
    setting: frozenset[str] = frozenset()
    _tools: dict[Event | Routine, Floats] = field(default_factory=dict)
    _pending: set[Event | Routine] = field(default_factory=set)

    def __post_init__(self) -> None:
        """Order all calls and find the functions that set the tool."""
        steps = list(self._steps())
        events = [step for step in steps if isinstance(step, Event)]
        setting = {"set_tcp"}
        callers: dict[str, set[str]] = defaultdict(set)
        for event in events:
            self.calls[event.name].append(event)
            if event.statement.routine is not None:
                callers[event.name].add(event.statement.routine.name)
        waiting = ["set_tcp"]
        while waiting:
            new = callers[waiting.pop()] - setting
            setting |= new
            waiting += new
        self.setting = frozenset(setting)
        self.last = preceding(steps, lambda entry: isinstance(entry, Routine) or entry.name in setting, MOST_SETTERS)

    def _steps(self) -> Iterable[Step | Event | Routine]:
        """Yield the structure with all calls; a call within an expression may not be run."""
        routines: list[Routine | None] = []
        for entry in self.script.outline:
            if entry is Step.END:
                yield from self._end(routines)
            elif isinstance(entry, Step):
                if entry in (Step.IF, Step.LOOP, Step.ROUTINE):
                    routines.append(None)
                yield entry
            elif isinstance(entry, Routine):
                routines[-1] = entry
                yield entry
            else:
                yield from self._calls(entry)

    def _end(self, routines: list[Routine | None]) -> Iterable[Step | Event]:
        """Yield the end of a function, choice or loop."""
        routine = routines.pop() if routines else None
        if routine is not None:
            yield self._exit(Statement((), 0, routine), routine)
        yield Step.END

    def _exit(self, statement: Statement, routine: Routine) -> Event:
        event = Event("", (), statement)
        self.exits[routine].append(event)
        return event

    def _calls(self, statement: Statement) -> Iterable[Step | Event]:
        """Yield the calls of a statement."""
        for index, token in calls_in(statement.tokens):
            end = closing(statement.tokens, index + 1) if token.text == "set_tcp" else index
            tokens = statement.tokens[index : end + 1] if end < len(statement.tokens) else ()
            event = Event(token.text, tokens, statement)
            self.events.setdefault((statement.file, token.start), event)
            if index:
                yield Step.IF
                yield event
                yield Step.END
            else:
                yield event
        if statement.returns and statement.routine is not None:
            yield self._exit(statement, statement.routine)

    def in_force(self, statement: Statement, token: Token) -> Floats:
        """Return the tool (4, 4) in force at a call. Raises Uncertain."""
        event = self.events.get((statement.file, token.start))
        if event is None:
            raise Uncertain("tool")
        if not self.calls["set_tcp"]:
            return self._initial()
        for name in self.setting:
            if any(routine.kind != "def" for routine in self.script.routines.get(name, ())):
                raise Uncertain("thread")
        return self._in_force(event, 0)

    def _initial(self) -> Floats:
        if self.script.surroundings.tool is None:
            raise Uncertain("tool")
        return self.script.surroundings.tool

    def _in_force(self, event: Event | Routine, depth: int) -> Floats:
        """Return the only tool that may be in force before an event."""
        return self._equal([self._left_by(setter, depth + 1) for setter in self.last[event]])

    def _left_by(self, setter: Event | Routine | None, depth: int) -> Floats:
        """Return the tool that a setter leaves in force, or with which a function begins."""
        if setter is None:
            return self._initial()
        if depth > DEEPEST or setter in self._pending:
            raise Uncertain("deep")
        if setter not in self._tools:
            self._pending.add(setter)
            try:
                self._tools[setter] = self._computed(setter, depth)
            finally:
                self._pending.discard(setter)
        return self._tools[setter]

    def _computed(self, setter: Event | Routine, depth: int) -> Floats:
        """Return the tool of ``_left_by`` for a setter that is not known yet."""
        if isinstance(setter, Routine):
            return self._at_entry(setter, depth)
        if setter.name == "set_tcp":
            return self.pose_of(setter)
        exits = [event for routine in self.script.routines[setter.name] for event in self.exits[routine]]
        return self._equal([self._in_force(event, depth) for event in exits])

    def _at_entry(self, routine: Routine, depth: int) -> Floats:
        """Return the tool in force wherever a function is called."""
        calls = self.calls.get(routine.name, ())
        if not calls:
            return self._initial()
        if routine.kind != "def":
            raise Uncertain("thread")
        return self._equal([self._in_force(call, depth) for call in calls])

    def _equal(self, tools: list[Floats]) -> Floats:
        if not tools:
            raise Uncertain("tool")
        if any(tool is not tools[0] and not np.allclose(tool, tools[0], rtol=0.0, atol=1e-12) for tool in tools):
            raise Uncertain("several-tools")
        return tools[0]
