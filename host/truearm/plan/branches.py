"""The configuration branch of a plan: that of the robot file, or a given one."""

from __future__ import annotations

from truearm.errors import Argument, PlanError
from truearm.model.builtin import names_with_branch
from truearm.model.chain import Chain
from truearm.model.robot import Robot
from truearm.model.workspace import Branch, check_branch
from truearm.schema import SchemaError

MIN_JOINTS = 6  # with fewer, an arm cannot orient the tool freely


def check_joints(chain: Chain) -> None:
    """Raise PlanError for an arm with fewer than MIN_JOINTS joints."""
    if len(chain.joints) < MIN_JOINTS:
        raise PlanError(
            f"robot {chain.name} has {len(chain.joints)} joints; a plan of bars or lines needs six or more, one of sockets "
            "four: truearm init --method sockets"
        )


def _check_kinds(chain: Chain) -> None:
    """Raise PlanError for an arm with a prismatic or mimic joint: a branch has angles, and a move's pace is that of turning."""
    unplanned = [joint for joint in chain.joints if joint.kind != "revolute" or joint.mimic]
    for joint in unplanned[:1]:
        kind = "prismatic" if joint.kind != "revolute" else "a mimic joint"
        raise PlanError(
            f"joint {joint.name} of robot {chain.name} is {kind}, and a plan is for arms with independent revolute joints "
            "only; choose the poses yourself, and identify from a table"
        )


def branch_of(robot: Robot, branch: Branch | None = None) -> Branch:
    """Return the branch of a robot file, or the given one.

    Raises PlanError if there is none, if it does not have two bounds per joint within the joint's limits, or if a joint
    is prismatic.
    """
    chain = robot.chain
    _check_kinds(chain)
    if branch is None:
        if robot.branch is None:
            check_joints(chain)  # no bounds would help
            with_branch = ", ".join(names_with_branch())
            text = (
                f"robot {chain.name} has no [branch] in its file (the built-in robots {with_branch} have one, a URDF never); give "
                f"LOW:HIGH of its {len(chain.joints)} joints in degrees, with commas between them, as "
            )
            raise PlanError(text, Argument("branch"))
        return robot.branch
    try:
        check_branch(branch, chain.joints)
    except SchemaError as exc:
        raise PlanError(Argument("branch"), f": {exc}") from None
    return branch
