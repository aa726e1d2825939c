"""The routines of a program, and what their text alone says: what may change at any time, and what each uses and changes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

from truearm.files.programs.environment import TOOL
from truearm.files.programs.syntax import Assign, Call, Expression, Jump, Routine
from truearm.files.programs.tree_walks import (
    WITHOUT_CALLS,
    assigns_parameters,
    calls_in,
    root_of,
    statements_in,
    touched_by,
)
from truearm.files.programs.work import SEVERAL, Work

Names = set[str]


class Routines:
    """Routines by name, and those in which they are defined.

    ``volatile``: names that code assigns which may run at any time. ``changed_by`` returns the arguments that an
    instruction may change which the program does not define; ``effects`` are functions with other effects. What is asked of a routine or condition is kept.
    """

    def __init__(
        self,
        work: Work,
        changed_by: Callable[[Call], Sequence[Expression]],
        effects: frozenset[str],
        routines: Iterable[Routine],
    ) -> None:
        self.work, self._changed_by, self._effects = work, changed_by, effects
        self.by_name: dict[str, Routine] = {}
        self.parents: dict[str, str | None] = {}
        self.volatile: Names = set()
        self._assigning: dict[str, bool] = {}  # whether they assign to what is given to them
        self._touched: dict[str, tuple[Names, Names, Names]] = {}  # what they themselves use, change and call
        self._reached: dict[str, tuple[Names, Names]] = {}  # what they and those that they call use and change
        self._running: dict[int, bool] = {}  # whether conditions run a routine, by their identity
        self._first_jumps: dict[str, int] = {}  # the place of the first statement of a routine with a jump
        for routine in routines:
            self._declare(routine, None)
        self._find_volatile()

    def _declare(self, routine: Routine, parent: str | None) -> None:
        if routine.name in self.by_name:
            raise self.work.source.wrong(routine.start, f"{routine.name} is defined twice; rename one")
        self.by_name[routine.name], self.parents[routine.name] = routine, parent
        for inner in routine.inner:
            self._declare(inner, routine.name)

    def _find_volatile(self) -> None:
        """Record what may change at any time: everything assigned in concurrent code and the routines it calls."""
        blocks = [block for one in self.by_name.values() for block in one.handlers]
        blocks += [one.body for one in self.by_name.values() if one.kind == "beside"]
        seen: set[str] = set()
        while blocks:
            block = blocks.pop()
            self.volatile |= {
                root_of(one.target) for one in statements_in(block) if isinstance(one, Assign) and one.scope != "local"
            }
            for call in calls_in(block):
                routine = self.by_name.get(call.function)
                self.volatile |= {TOOL} if call.function == "set_tcp" else set()
                if routine is None:
                    self.volatile |= {root_of(one) for one in self._changed_by(call)}
                elif self._assigns_parameters(routine):
                    self.volatile |= {root_of(one) for one in call.arguments}
                if routine is not None and routine.name not in seen:
                    seen.add(routine.name)
                    blocks.append(routine.body)
        self.volatile.discard("")

    def _assigns_parameters(self, routine: Routine) -> bool:
        if routine.name not in self._assigning:
            self._assigning[routine.name] = assigns_parameters(routine)
        return self._assigning[routine.name]

    def runs_routine(self, expression: Expression) -> bool:
        """Return whether an expression calls a routine of the program or a function with an effect on what follows."""
        if type(expression) in WITHOUT_CALLS:
            return False
        found = self._running.get(id(expression))
        if found is None:
            found = self._running[id(expression)] = any(map(self._does_more, calls_in(expression)))
        return found

    def _does_more(self, call: Call) -> bool:
        name = call.function
        return name in self.by_name or name in self._effects or bool(self._changed_by(call))

    def first_jump(self, routine: Routine) -> int:
        """The place of the first statement of a routine with a jump in it, or behind the last."""
        if not routine.jumps:
            return len(routine.body)
        if routine.name not in self._first_jumps:
            jumps = (
                k for k, one in enumerate(routine.body) if any(isinstance(part, Jump) for part in statements_in((one,)))
            )
            self._first_jumps[routine.name] = next(jumps, len(routine.body))
        return self._first_jumps[routine.name]

    def doubled(self, routine: Routine, places: Mapping[str, Expression]) -> dict[str, str]:
        """Return parameters (and their variables) that the routine reaches by two names and changes by one of them."""
        roots = {
            one.name: root for one in routine.parameters if one.shared and (root := root_of(places.get(one.name))) != ""
        }
        if not roots:
            return {}
        if routine.name not in self._reached:
            self._reached[routine.name] = self._reached_by(routine)
        used, changed = self._reached[routine.name]
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
            if name not in self._touched:
                self._touched[name] = touched_by(self.by_name[name], self.by_name, self._changed_by)
            own_used, own_changed, called = self._touched[name]
            self.work.spend(4 + (len(own_used) + len(own_changed) + len(called)) // SEVERAL)
            used |= own_used
            changed |= own_changed
            waiting += called - found
            found |= called
        return used, changed
