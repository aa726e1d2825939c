"""The workspace of an arm and the volume of its links: the parts of a robot file that planning needs.

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

An arm reaches a pose in several configurations (elbow up or down, wrist flipped or not), separated by singularities. A
plan stays in one branch: the joints can then move straight from any pose to any other with the bar mounted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from truearm.model.chain_structure import Joint
from truearm.model.robot_tables import MAX_JOINTS, robot_number
from truearm.schema import Key, List, SchemaError, Table, Whole
from truearm.types import Floats
from truearm.units import DEG

MAX_CAPSULES = 100
CLEARANCE, HEIGHT = 0.25, 0.08  # m


@dataclass(frozen=True)
class Branch:
    """One configuration branch as joint bounds (j,) [rad].

    ``clearance`` [m] is the minimum distance of the end from the base's z axis, and ``height`` [m] that from the table,
    z = 0.
    """

    lower: Floats
    upper: Floats
    clearance: float = CLEARANCE
    height: float = HEIGHT


class Capsules(NamedTuple):
    """The volume of an arm's links: everything within a radius of m segments.

    ``joint`` is the joint that each segment moves with (0: none, it is fixed). ``ends`` (m, 2, 3) [m] are given in that
    joint's frame after its motion (0: the base frame). ``radius`` is (m,) [m].
    """

    joint: tuple[int, ...]
    ends: Floats
    radius: Floats


def _branch(lower: tuple[float, ...], upper: tuple[float, ...], **clearances: float) -> Branch:
    return Branch(np.array(lower), np.array(upper), **clearances)


_ANGLES, _LENGTH, _POINT = List(robot_number("rad")), robot_number("m"), List(robot_number("m"), 3)
BRANCH = Table(
    (
        Key("lower", _ANGLES),
        Key("upper", _ANGLES),
        Key("clearance", _LENGTH, optional=True),
        Key("height", _LENGTH, optional=True),
    ),
    _branch,
)
CAPSULE: Table[dict[str, Any]] = Table(
    (
        Key("joint", Whole(0, MAX_JOINTS)),
        Key("start", _POINT),
        Key("end", _POINT),
        Key("radius", replace(_LENGTH, positive=True)),
    ),
    dict,
)


def check_branch(branch: Branch, joints: Sequence[Joint]) -> None:
    """Raise SchemaError if the branch is invalid for an arm with these joints."""
    if any(joint.kind != "revolute" for joint in joints):
        raise SchemaError("only an arm with revolute joints can have one")
    for key, bounds in (("lower", branch.lower), ("upper", branch.upper)):
        if len(bounds) != len(joints):
            raise SchemaError(f"needs bounds of {len(joints)} joints, {key} has {len(bounds)}")
    for joint, lower, upper in zip(joints, branch.lower.tolist(), branch.upper.tolist(), strict=True):
        if not joint.lower <= lower < upper <= joint.upper:
            limits = f"{DEG.of(joint.lower):.6g} to {DEG.text(joint.upper, '.6g')}"
            raise SchemaError(f"the bounds of {joint.name} must lie within its limits, {limits}, lower below upper")


def capsules_of(entries: Sequence[Mapping[str, Any]], n_joints: int) -> Capsules:
    """Return the capsules of a robot file's ``[[capsule]]`` tables. Raises SchemaError."""
    joint = tuple(entry["joint"] for entry in entries)
    for i, index in enumerate(joint, start=1):
        if index > n_joints:
            raise SchemaError(
                f"capsule: item {i}: joint: must be a whole number from 0 (fixed) to {n_joints}, is {index}"
            )
    ends = np.array([(entry["start"], entry["end"]) for entry in entries])
    return Capsules(joint, ends, np.array([entry["radius"] for entry in entries]))
