"""The execution of loops: turn by turn where the text says how many, otherwise all turns at once."""

from __future__ import annotations

from abc import abstractmethod

from truearm.files.programs.calls import Calls
from truearm.files.programs.environment import Key
from truearm.files.programs.known_turns import Turns, counter_values, holds
from truearm.files.programs.routines import Routines
from truearm.files.programs.syntax import Expression, Loop, Number
from truearm.files.programs.values import Unknown, Values, counts, origin_of
from truearm.files.programs.variables import Turn
from truearm.files.programs.work import Work

MAX_TURNS = 4  # of a loop, before values that still change become unknown
CHANGES = "changes between iterations of a loop; write the targets out as a list, and let the loop go through it"


class Loops(Calls):
    """Loops that are executed."""

    def __init__(self, work: Work, routines: Routines) -> None:
        super().__init__(work, routines)
        self._turns = Turns(work)

    @abstractmethod
    def decide(self, condition: Expression) -> None:
        """Evaluate a condition."""

    def loop(self, loop: Loop) -> None:
        """Execute a loop."""
        if self.loose or not self._turns.worth(loop) or not self._turn_by_turn(loop):
            self._all_at_once(loop)

    def _turn_by_turn(self, loop: Loop) -> bool:
        """Execute a loop in order as far as its turns are known; return False if nothing is known of them."""
        condition = loop.condition
        counted = counter_values(loop, self.value) if loop.counter else ()
        if not self._turns.fits(max(1, len(counted))) or not (counted or self._begins(condition)):
            return False
        depth, breaks = self.environment.depth, list[dict[Key, Values]]()
        self.environment.begin({})
        goes_on, at = True, 0
        while goes_on:
            if condition is None and at == len(counted):
                break
            held = True if condition is None else holds(condition, self.value)
            if held is None or (held and not self._turns.take()):
                self._all_at_once(loop)
                break
            if not held:
                break
            goes_on = self._turn(loop, depth, breaks, (Number(counted[at]),) if condition is None else ())
            at += 1
        whole = self.environment.end()
        self.environment.join([*([whole] if goes_on or not breaks else []), *breaks])
        return True

    def _begins(self, condition: Expression | None) -> bool:
        """Return whether a condition is known to hold at first."""
        if condition is None or self.routines.runs_routine(condition):
            return False
        return holds(condition, self.value) is True

    def _turn(self, loop: Loop, depth: int, breaks: list[dict[Key, Values]], counter: Values) -> bool:
        """Execute one turn; return whether another one may follow. ``breaks``: what was assigned since ``depth`` where it is left."""
        turn, end = self._executed_turn(loop, depth, counter)
        breaks += turn.breaks
        ways = [*turn.continues, *([] if end is None else [end])]
        if ways:
            self.environment.join(ways)
        return bool(ways)

    def _executed_turn(self, loop: Loop, depth: int, counter: Values) -> tuple[Turn, dict[Key, Values] | None]:
        """Execute one turn; return what was assigned since ``depth`` where it is left or cut short, and in it if its end is reached.

        The counter is known only in it, and hides a variable of its name.
        """
        key: Key = (self.stack[-1].scope, loop.counter)
        turn = Turn(depth)
        self.environment.begin({key: counter} if loop.counter else {})
        self.stack[-1].turns.append(turn)
        if loop.condition is not None:
            self.decide(loop.condition)
        reached = self.run(loop.body)
        self.stack[-1].turns.pop()
        end = self.environment.end()
        for way in (end, *turn.breaks, *turn.continues) if loop.counter else ():
            way.pop(key, None)
        return turn, end if reached else None

    def _all_at_once(self, loop: Loop) -> None:
        """Follow all turns of a loop together, until its variables have no new possibilities."""
        environment = self.environment
        counter: Values = (Unknown(f"{loop.counter} counts in a loop", 0),)
        for turns in range(MAX_TURNS + 2):
            turn, end = self._executed_turn(loop, environment.depth, counter)
            ways = [*turn.continues, *([] if end is None else [end])]
            before = {key: environment.get(key) for way in ways for key in way}
            self.work.spend(len(before))
            environment.join([{}, *ways])
            grown = [key for key, values in before.items() if environment.get(key) != values]
            if not grown:
                break
            for key in grown:
                if turns >= MAX_TURNS or (turns and counts(before[key], environment.get(key))):
                    origin = origin_of(environment.get(key) or ())
                    environment.set(key, (Unknown(f"{key[1]} {CHANGES}", 0, "", origin),))
        if loop.condition is not None and self.routines.runs_routine(loop.condition):
            self.decide(loop.condition)  # it is evaluated once more often than the body
        environment.join([{}, *turn.breaks])
