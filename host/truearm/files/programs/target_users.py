"""The moves that go to each target: if a target cannot be corrected, none of them is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from truearm.files.programs.program import Program
from truearm.files.programs.syntax import Taught
from truearm.files.programs.targets import ProgramTargets


class TargetUsers(NamedTuple):
    """The places of the moves to each pose, in the order of the poses, and to each literal of joint readings."""

    poses: Sequence[Sequence[int]]
    joints: Sequence[Sequence[int]]


def users_of(program: Program, targets: ProgramTargets) -> TargetUsers:
    """Return the moves that go to each of a program's targets."""
    found: dict[int | Taught, list[int]] = {}
    for motion in program.motions:
        for goal in motion.goals:
            of = goal.target if isinstance(goal.target, Taught) else targets.indices.get(goal)
            if of is not None and (moves := found.setdefault(of, []))[-1:] != [motion.start]:
                moves.append(motion.start)
    poses = [found.get(i, ()) for i in range(len(targets.poses))]
    return TargetUsers(poses, [found.get(literal, ()) for literal, _ in targets.joints])
