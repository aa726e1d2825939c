"""The configuration branch that a plan stays in: the robot file's, or one that is given."""

from __future__ import annotations

import numpy as np

from truearm.errors import Argument, PlanError
from truearm.model.builtin import names_with_branch
from truearm.model.robot import Robot
from truearm.model.workspace import Branch


def branch_of(robot: Robot, given: Branch | None = None) -> Branch:
    """Return the branch of a robot file, or the one that is given for it.

    Raises PlanError where there is none, and for one that has not two bounds a joint within the joint's limits.
    """
    chain = robot.chain
    if given is None:
        if robot.branch is None:
            known = ", ".join(names_with_branch())
            text = f"robot {chain.name} has no [branch] in its file ({known} have); give LOW:HIGH,… in degrees as "
            raise PlanError(text, Argument("branch"))
        return robot.branch
    limits = np.array([(joint.lower, joint.upper) for joint in chain.joints])
    if len(given.lower) != len(limits):
        raise PlanError(Argument("branch"), f": needs bounds of {len(limits)} joints, has {len(given.lower)}")
    if (given.lower < limits[:, 0]).any() or (given.upper > limits[:, 1]).any():
        raise PlanError(Argument("branch"), ": a bound lies outside the joint's limits")
    return given
