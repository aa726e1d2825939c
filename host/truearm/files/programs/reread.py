"""Read a corrected program again: every move goes where it should, or is known not to be corrected.

This finds mistakes between the targets and the text: numbers written to a wrong place, rounded wrongly or not at all, a
literal that two moves share, a move that was lost.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from truearm.errors import ProgramError
from truearm.files.programs.motions import Motion
from truearm.files.programs.program import Program
from truearm.files.programs.syntax import Taught
from truearm.files.programs.target_poses import PoseTarget, poses_of, readings_of
from truearm.files.programs.values import Goal, Pose
from truearm.model.poses import apart
from truearm.types import Floats

CLOSE = 1e-6  # m, rad: below a controller's resolution, above the rounding of the numbers that are written


class Wanted(NamedTuple):
    """Where the moves of a corrected program go.

    ``rows``: the goals that are corrected, with their rows of ``poses`` (n, 4, 4) in their frames; ``joints``: the
    literals of joint readings that are corrected, and their readings (j,) [rad]; ``kept``: other joint readings are
    left as they are; ``refused``: the lines of moves that are not corrected.
    """

    rows: Mapping[Goal, int]
    poses: Floats
    joints: Mapping[Taught, Floats]
    kept: bool
    refused: frozenset[int]


def check_reread(before: Program, after: Program, wanted: Wanted) -> None:
    """Compare a corrected program with what is wanted. Raises ProgramError with the line of the first difference."""
    if len(before.motions) != len(after.motions):
        raise _wrong(before, before.motions[0], "the corrected program has another number of moves")
    pairs: list[tuple[Motion, Goal, Goal]] = []
    for old, new in zip(before.motions, after.motions, strict=True):
        if before.source.line(old.start) in wanted.refused:
            continue
        if not old.goals or old.problems or not all(_is_corrected(goal, wanted) for goal in old.goals):
            raise _wrong(before, old, "the move is neither corrected nor refused")
        if old.name != new.name or len(old.goals) != len(new.goals) or new.problems:
            raise _wrong(before, old, "the corrected move has other targets")
        pairs += [(old, a, b) for a, b in zip(old.goals, new.goals, strict=True)]
    poses = [pair for pair in pairs if pair[1] in wanted.rows]
    off = _distances([a for _, a, _ in poses], [b for _, _, b in poses], wanted)
    for (motion, _, _), distance in zip(poses, off, strict=True):
        if not distance <= CLOSE:
            raise _wrong(before, motion, f"the corrected move misses its target by {distance:.3g} m or rad")
    for motion, a, b in pairs:
        readings = None if isinstance(a.target, Pose) else wanted.joints.get(a.target)
        if readings is None:
            continue
        if not isinstance(b.target, Taught) or not np.abs(np.subtract(readings_of(b.target), readings)).max() <= CLOSE:
            raise _wrong(before, motion, "the corrected move has other joint readings")


def _is_corrected(goal: Goal, wanted: Wanted) -> bool:
    if isinstance(goal.target, Pose):
        return goal in wanted.rows
    return wanted.kept or goal.target in wanted.joints


def _distances(before: list[Goal], after: list[Goal], wanted: Wanted) -> Floats:
    """Return how far (n,) [m, rad] goals are from what is wanted, and their tools and frames from what they were."""
    if not before:
        return np.zeros(0)
    if not all(isinstance(goal.target, Pose) for goal in after):
        return np.full(len(before), np.inf)
    _, frame, tool = poses_of([PoseTarget(goal, None, 0) for goal in before])
    found = poses_of([PoseTarget(goal, None, 0) for goal in after])
    due = wanted.poses[[wanted.rows[goal] for goal in before]], frame, tool
    return np.asarray(
        np.max([np.abs(apart(one, other)).max(axis=1) for one, other in zip(due, found, strict=True)], axis=0)
    )


def _wrong(program: Program, motion: Motion, what: str) -> ProgramError:
    return program.source.wrong(
        motion.start, f"{what}, so nothing was written; this is a fault in truearm: report it with this program"
    )
