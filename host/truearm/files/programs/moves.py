"""The moves that are found in a program, each with its goals and with the places where it begins and ends."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain

from truearm.files.programs.environment import HERE, begins, few
from truearm.files.programs.motions import Motion, goal_of
from truearm.files.programs.routines import Routines
from truearm.files.programs.syntax import Call, Expression, Number, Text, Truth
from truearm.files.programs.values import Begin, Goal, Unknown, Value, Values, distinct, joined
from truearm.files.programs.variables import Variables
from truearm.files.programs.work import GOAL, MOVE, SEVERAL, Work

ANYWHERE: Values = (Unknown("the position in which the program starts is not known", 0),)


class Moves(Variables):
    """The moves found, by their places in the text; ``begins``: where the robot was when a routine began, by its scope."""

    def __init__(self, work: Work, routines: Routines) -> None:
        super().__init__(work, routines)
        self.motions: dict[int, Motion] = {}
        self.begins: dict[int, Values] = {}

    def motion(self, name: str, start: int, end: int) -> Motion:
        """Return the record of a statement that moves the robot."""
        found = self.motions.get(start)
        if found is None:
            found = self.motions[start] = Motion(name, start, end)
        return found

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
        choices = len(tools) * len(frames) * sum([len(values) for values, _ in targets])
        self.work.spend(MOVE + GOAL * choices)
        motion.straight = straight
        reached = self.environment.get(HERE) or ANYWHERE
        for values, argument in targets:  # one after the other, as the point on a circle and its end
            place = self._place(argument)
            ends: dict[Value, None] = {}
            for tool in tools:
                for frame in frames:
                    for value in values:
                        found = goal_of(value, tool, frame, place)
                        if isinstance(found, Goal):
                            ends[found] = None
                        else:
                            motion.problems[found] = None
                            ends[Unknown(found[0], call.start)] = None
            there = tuple(ends)
            self._leg(motion, reached, there)
            reached = few(there)
        self.environment.set(HERE, joined(self.environment.get(HERE), reached) if self.loose else reached)

    def _place(self, argument: Expression) -> tuple[int, int]:
        """Return the place of an argument; without an end if nothing can replace it, because it does something too."""
        if isinstance(argument, Number | Text | Truth):
            return -1, -1
        return argument.start, -1 if self.routines.runs_routine(argument) else argument.end

    def _leg(self, motion: Motion, starts: Values, ends: Values) -> None:
        """Record from where and to where a move is made. What begins where a routine does is made for each of its calls."""
        if begins(starts):
            self.environment.traces[-1].legs[motion.start, starts, ends] = None
        leg = (self._places(starts), ends)
        if leg not in motion.legs[-2:]:  # as many as one move has
            self.work.spend(len(leg[0]) * len(ends) // SEVERAL)
            motion.legs.append(leg)

    def _places(self, values: Values) -> Values:
        """Return where the robot is, with the places themselves for those where routines begin."""
        if not begins(values):
            return values
        return distinct(
            chain.from_iterable(self.begins[one.scope] if isinstance(one, Begin) else (one,) for one in values)
        )


def placed(values: Values, here: Values) -> Values:
    """Return where the robot is after a routine that was called ``here``."""
    if not begins(values):
        return values
    return distinct(chain.from_iterable(here if isinstance(one, Begin) else (one,) for one in values))
