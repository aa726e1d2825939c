"""The variables of a program that is followed, as each routine being executed sees them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

from truearm.files.programs.environment import GLOBAL, TOOL, Environment, Key
from truearm.files.programs.routines import Routines
from truearm.files.programs.syntax import Routine
from truearm.files.programs.values import (
    MAX_NESTED,
    NO_ORIGIN,
    Fields,
    Listed,
    Origin,
    Unknown,
    Values,
    joined,
    origin_of,
    united,
)
from truearm.files.programs.work import Work


@dataclass
class Turn:
    """A loop that is being executed."""

    depth: int
    breaks: list[dict[Key, Values]] = field(default_factory=list)
    continues: list[dict[Key, Values]] = field(default_factory=list)


@dataclass
class Activation:
    """A routine that is being executed."""

    routine: Routine | None
    scope: int
    parent: Activation | None  # of the enclosing routine
    depth: int  # of its own layer
    returns: list[tuple[Values, dict[Key, Values]]] = field(default_factory=list)
    turns: list[Turn] = field(default_factory=list)  # of its loops, the innermost last


class Variables:
    """The possible values of names. ``loose``: after jumps, statements may be executed in any order."""

    def __init__(self, work: Work, routines: Routines) -> None:
        self.work, self.routines = work, routines
        self.environment = Environment(work)
        self.stack = [Activation(None, GLOBAL, None, 0)]
        self.loose = False
        self._origins: dict[str, Origin] = {}  # of all values so far of names that may change at any time

    def get(self, name: str) -> Values | None:
        """Return the possible values of a name here; None if it is unknown."""
        if name in self.routines.volatile and not any(
            one.routine and one.routine.kind == "beside" for one in self.stack
        ):
            why = f"{name} is changed by code that runs concurrently (a trap, a handler or a thread)"
            return (Unknown(why, 0, "", self._origins.get(name, NO_ORIGIN)),)
        at: Activation | None = self.stack[-1]
        while at is not None:
            if (found := self.environment.get((at.scope, name))) is not None:
                return found
            at = at.parent
        return self.environment.get((GLOBAL, name))

    def key_of(self, name: str) -> Key | None:
        """Return where the possible values of a name are kept; None if it has none, or if they may change at any time."""
        if name in self.routines.volatile or self.loose:
            return None
        keys = [*((one.scope, name) for one in _upward(self.stack[-1])), (GLOBAL, name)]
        return next((key for key in keys if self.environment.get(key) is not None), None)

    def set(self, name: str, values: Values, scope: str = "") -> None:
        """Assign to a name.

        If a routine assigns to a name without declaring it, that is the program's variable of this name if there is
        one. If an enclosing routine has a variable of this name, either may be meant.
        """
        if any(isinstance(one, Listed | Fields) and one.depth > MAX_NESTED for one in values):
            values = (Unknown(f"{name} has too many nested lists to trace", 0),)
        own = (self.stack[-1].scope, name)
        if name in self.routines.volatile:
            self._origins[name] = united((self._origins.get(name, NO_ORIGIN), origin_of(values)))
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


def _upward(at: Activation | None) -> Iterator[Activation]:
    while at is not None:
        yield at
        at = at.parent
