"""Which calls may be the last ones before a call of a URScript, through branches, loops and functions.

The tool in force at a move is that of the last set_tcp, and the arm's configuration comes from the last move.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from truearm.correct.programs.order import closure, preceding
from truearm.correct.programs.urscript_names import Border, Call, Entry, Script


@dataclass(eq=False)
class LastCalls:
    """The calls of the functions ``names`` that may be the last before any call, if they are not more than ``limit``.

    ``acting``: these functions and those of the script that lead to them. ``in_thread``: whether a thread does.
    ``ends``: of each entry, where looking back from it ends, one more than ``limit`` if there are more.
    """

    script: Script
    names: frozenset[str]
    limit: int

    def __post_init__(self) -> None:
        """Find the functions that lead to the calls, and what may come before each call within its function."""
        callers: dict[str, set[str]] = defaultdict(set)
        for name, calls in self.script.calls.items():
            callers[name] = {call.statement.routine.name for call in calls}
        self.acting = closure(self.names, callers.__getitem__)
        routines = (routine for name in self.acting for routine in self.script.routines.get(name, ()))
        self.in_thread = any(routine.kind != "def" for routine in routines)
        self.last: dict[Entry, frozenset[Entry | None]] = preceding(
            self.script.steps,
            lambda entry: entry.name in self.acting if isinstance(entry, Call) else not entry.is_end,
            self.limit,
        )
        entries = closure({entry for predecessors in self.last.values() for entry in predecessors}, self._earlier)
        later: dict[Entry | None, list[Entry | None]] = defaultdict(list)
        for entry in entries:
            for earlier in self._earlier(entry):
                later[earlier].append(entry)
        self.ends: dict[Entry | None, set[Entry | None]] = defaultdict(set)
        for end in entries:
            waiting = [] if self._places(end) else [end]
            while waiting:
                ends = self.ends[entry := waiting.pop()]
                if end not in ends and len(ends) <= self.limit:
                    ends.add(end)
                    waiting += later[entry]

    def before(self, call: Call) -> frozenset[Entry | None]:
        """Return the calls that may be the last; the beginning of a file or function if none was; None: unknown."""
        ends = frozenset[Entry | None]().union(*(self.ends[entry] for entry in self.last[call]))
        return ends if 0 < len(ends) <= self.limit and not self.in_thread else frozenset([None])

    def _earlier(self, entry: Entry | None) -> Iterable[Entry | None]:
        return {earlier for place in self._places(entry) for earlier in self.last.get(place, (None,))}

    def _places(self, entry: Entry | None) -> Sequence[Entry]:
        """Return where to look on: the calls of a function that begins, the ends of one that is called."""
        if isinstance(entry, Border):
            return self.script.calls.get(entry.routine.name, ())
        if isinstance(entry, Call) and entry.name not in self.names:
            return [Border(routine, is_end=True) for routine in self.script.routines[entry.name]]
        return ()
