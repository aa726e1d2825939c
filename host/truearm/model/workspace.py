"""Where an arm may move, and where its links are: what its robot file says for planning.

::

    [branch]                                 # a configuration branch: joint bounds without a singularity inside
    lower_deg = [-150.0, -170.0, …]
    upper_deg = [150.0, -10.0, …]
    clearance_mm = 220.0                     # from the base's z axis; left out: 250
    height_mm = 80.0                         # above z = 0; left out: 80

    [[capsule]]                              # all within a radius of a segment that moves with a joint
    joint = 2                                # 0: fixed to the base
    start_mm = [0.0, 0.0, 135.0]
    end_mm = [-425.0, 0.0, 135.0]
    radius_mm = 95.0

An arm reaches a pose in several ways (elbow up or down, wrist flipped or not), with singularities between them. A plan
stays in one branch: joints then go straight from any pose to any other, and the bar can stay on.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from truearm.errors import RobotError
from truearm.model.chain import Joint
from truearm.model.robot_tables import as_table, check_unknown, read_number, read_quantities, read_quantity
from truearm.types import Floats

MAX_CAPSULES = 100
CLEARANCE, HEIGHT = 0.25, 0.08  # m


@dataclass(frozen=True)
class Branch:
    """One configuration branch as joint bounds (j,) [rad].

    ``clearance`` [m]: how near the end may come to the base's z axis; ``height`` [m]: how near to the table, z = 0.
    """

    lower: Floats
    upper: Floats
    clearance: float = CLEARANCE
    height: float = HEIGHT


class Capsules(NamedTuple):
    """The links of an arm: what lies within a radius of m segments.

    ``joint``: the joint that each moves with (0: none, it is fixed). ``ends`` (m, 2, 3) [m] in that joint's frame after
    its motion (0: the base frame). ``radius`` (m,) [m].
    """

    joint: tuple[int, ...]
    ends: Floats
    radius: Floats


def read_branch(doc: Mapping[str, Any], joints: Sequence[Joint]) -> Branch | None:
    """Return the branch of a parsed robot file, None where it has none. Raises RobotError."""
    if "branch" not in doc:
        return None
    table, used = as_table(doc["branch"], "branch"), set[str]()
    if any(joint.kind != "revolute" for joint in joints):
        raise RobotError("robot file: branch: only an arm of revolute joints has one")
    lower, upper = (
        np.array(read_quantities(table, "branch", key, "rad", len(joints), used)) for key in ("lower", "upper")
    )
    near = {
        key: read_quantity(table, "branch", key, "m", used)
        for key in ("clearance", "height")
        if any(name.startswith(f"{key}_") for name in table)
    }
    check_unknown(table, "branch", used)
    limits = np.array([(joint.lower, joint.upper) for joint in joints])
    for i in np.flatnonzero((lower >= upper) | (lower < limits[:, 0]) | (upper > limits[:, 1]))[:1]:
        raise RobotError(
            f"robot file: branch: the bounds of joint {i + 1} must lie within its limits, lower below upper"
        )
    return Branch(lower, upper, **near)


def read_capsules(doc: Mapping[str, Any], n_joints: int) -> Capsules | None:
    """Return the links' capsules of a parsed robot file, None where it has none. Raises RobotError."""
    if "capsule" not in doc:
        return None
    entries = doc["capsule"]
    if not isinstance(entries, list) or not 1 <= len(entries) <= MAX_CAPSULES:
        raise RobotError(f"robot file: capsule must be 1 to {MAX_CAPSULES} tables, [[capsule]] each")
    joint, ends, radius = [], [], []
    for i, entry in enumerate(entries):
        where, used = f"capsule {i + 1}", {"joint"}
        table = as_table(entry, where)
        moved_by = read_number(table.get("joint"), f"{where}.joint", "1", 1.0)
        if moved_by != math.floor(moved_by) or not 0 <= moved_by <= n_joints:
            raise RobotError(f"robot file: {where}.joint must be a whole number from 0 (fixed) to {n_joints}")
        joint.append(int(moved_by))
        ends.append([read_quantities(table, where, key, "m", 3, used) for key in ("start", "end")])
        radius.append(read_quantity(table, where, "radius", "m", used))
        if radius[-1] <= 0.0:
            raise RobotError(f"robot file: {where}.radius must be above 0")
        check_unknown(table, where, used)
    return Capsules(tuple(joint), np.array(ends), np.array(radius))
