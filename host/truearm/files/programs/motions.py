"""A move of a program and its goal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import chain

from truearm.files.programs.syntax import Taught
from truearm.files.programs.values import Goal, Pose, Solved, Unknown, Value, Values

UNDECLARED = "name"  # the remedy for a name that the file does not declare, until its use is known


@dataclass(slots=True)
class Motion:
    """A statement that moves the robot; ``problems`` are the reasons why it, or a part of it, cannot be corrected.

    ``legs``: each time it was followed, the possible starts and ends; ``straight``: along a line in space. ``goals``: the
    ends to which it is corrected, once the whole program was followed.
    """

    name: str
    start: int
    end: int
    goals: tuple[Goal, ...] = ()
    legs: list[tuple[Values, Values]] = field(default_factory=list)
    straight: bool = False
    problems: dict[tuple[str, str], None] = field(default_factory=dict)  # reason, and the argument to resolve it


def goals_of(legs: Sequence[tuple[Values, Values]]) -> tuple[Goal, ...]:
    """Return the goals among the ends of legs, each once."""
    ends = legs[0][1] if len(legs) == 1 else dict.fromkeys(chain.from_iterable(ends for _, ends in legs))
    return tuple(one for one in ends if isinstance(one, Goal))


def goal_of(value: Value, tool: Value, frame: Value, place: tuple[int, int]) -> Goal | tuple[str, str]:
    """Return the goal, or why there is none; ``place``: of the argument that contains it."""
    if isinstance(value, Unknown):
        return (f"{value.why}; declare it there", "") if value.remedy == UNDECLARED else (value.why, value.remedy)
    if isinstance(value, Taught):
        return Goal(value, Pose(()), Pose(()), None, *place)
    near, own = None, False
    if isinstance(value, Solved):
        near, own, tool = value.near, value.tool != tool, value.tool
        value = value.pose
    if not isinstance(value, Pose):
        return "its target is neither a pose nor joint readings of plain numbers", ""
    for what in (tool, frame):
        if isinstance(what, Unknown):
            return what.why, what.remedy
    if not isinstance(tool, Pose) or not isinstance(frame, Pose):
        return "its tool or work object is not known", ""
    return Goal(value, tool, frame, near, *place, own)
