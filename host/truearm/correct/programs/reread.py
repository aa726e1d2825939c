"""Compare a corrected program, read again, with what was wanted: every move goes where it should, or where it went.

This finds mistakes between the targets and the text: numbers in a wrong place or rounded wrongly, a literal that two
moves share, a move that was lost (docs/decisions/0031).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from truearm.correct.programs.corrected_text import Joints
from truearm.correct.programs.poses import poses_of, readings_of
from truearm.correct.programs.program import Goal, Move, Program
from truearm.model.poses import apart
from truearm.types import Floats

CLOSE = 1e-6  # m, rad: below a controller's resolution, above the rounding of the numbers that are written


def target_poses(goals: Sequence[Goal]) -> Floats:
    """Return the targets (n, 4, 4) of goals that are poses, in their frames."""
    targets = [goal.target for goal in goals]
    left, right = (
        np.array(sides).reshape(-1, 4, 4) for sides in ([t.left for t in targets], [t.right for t in targets])
    )
    return np.asarray(left @ poses_of([target.literal for target in targets]) @ right)


def difference(
    original: Program,
    corrected: Program,
    goal_poses: Mapping[Goal, Floats],
    joints: Mapping[Goal, Joints],
    joints_change: bool,
) -> str:
    """Return how the moves of a corrected program differ from what is wanted, with file and line; "" if they do not."""
    if len(original.moves) != len(corrected.moves):
        return "the corrected program has another number of moves"
    pairs: list[tuple[Move, Goal, Goal]] = []
    for old, new in zip(original.moves, corrected.moves, strict=True):
        uncertain = bool(old.reason and not old.goals)
        forms = [[goal.target.literal.form for goal in move.goals] for move in (old, new)]
        if old.name != new.name or forms[0] != forms[1] or uncertain != (new.reason is not None):
            return f"{original.where(old.place)}: the corrected move has other targets"
        pairs += [(old, first, second) for first, second in zip(old.goals, new.goals, strict=True)]
    posed = [pair for pair in pairs if not pair[1].is_joints]
    due, actual = target_poses([goal for _, goal, _ in posed]), target_poses([goal for _, _, goal in posed])
    for row, (move, goal, _) in enumerate(posed):
        if move.reason is None:
            due[row] = goal_poses[goal]
    misses = (
        dict(zip((goal for _, goal, _ in posed), np.abs(apart(actual, due)).max(axis=1), strict=True)) if posed else {}
    )
    for move, goal, again in pairs:
        if goal.is_joints:
            is_changed = joints_change and move.reason is None
            readings = joints[goal].after if is_changed else readings_of(goal.target.literal)
            misses[goal] = np.abs(readings_of(again.target.literal) - readings).max()
        is_same = np.array_equal(goal.tool, again.tool) and np.array_equal(goal.frame, again.frame)
        if not misses[goal] <= CLOSE or not is_same:
            return f"{original.where(move.place)}: the corrected move misses its target by {misses[goal]:.3g} m or rad"
    return ""
