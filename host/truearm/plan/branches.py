"""The configuration branch that a plan stays in: the robot file's, or the bounds of ``--branch``."""

from __future__ import annotations

import numpy as np

from truearm.errors import PlanError
from truearm.model.builtin import names_with_branch
from truearm.model.robot import Robot
from truearm.model.workspace import Branch
from truearm.units import DEG


def branch_of(robot: Robot, bounds_deg: str | None = None) -> Branch:
    """Return the branch of a robot file, or that of a text "-150:150,-170:-10,…" with bounds of every joint in degrees.

    Raises PlanError for a robot that has none and for a text that does not give one pair a joint within its limits.
    """
    chain = robot.chain
    if bounds_deg is None:
        if robot.branch is None:
            known = ", ".join(names_with_branch())
            raise PlanError(
                f"robot {chain.name} has no [branch] in its file ({known} have); give --branch LOW:HIGH,… in degrees"
            )
        return robot.branch
    pairs = [part.split(":") for part in bounds_deg.split(",")]
    if len(pairs) != len(chain.joints) or any(len(pair) != 2 for pair in pairs):
        raise PlanError(f"--branch needs LOW:HIGH in degrees for each of {len(chain.joints)} joints, between commas")
    try:
        lower, upper = DEG.to_si(np.array([[float(text) for text in pair] for pair in pairs])).T
    except ValueError as exc:
        raise PlanError(f"--branch: {exc}; it needs numbers in degrees") from exc
    if not (np.isfinite(lower) & np.isfinite(upper) & (lower < upper)).all():
        raise PlanError("--branch: every LOW must be below its HIGH")
    limits = np.array([(joint.lower, joint.upper) for joint in chain.joints])
    if (lower < limits[:, 0]).any() or (upper > limits[:, 1]).any():
        raise PlanError("--branch: a bound lies outside the joint's limits")
    return Branch(lower, upper)
