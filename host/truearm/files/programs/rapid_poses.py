"""Robtargets, tools and work objects of RAPID as poses, and the functions on them.

A robtarget is relative to the object frame of its work object: user frame · object frame · target; the tool's frame is
that of its tooldata. ``Offs`` shifts a target along the work object's axes, ``RelTool`` along the tool's.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

from scipy.spatial.transform import Rotation

from truearm.files.programs.motions import UNDECLARED
from truearm.files.programs.numeric_functions import matrix
from truearm.files.programs.rotations import of_quaternion, quaternion_of_angles, quaternion_of_tool_angles
from truearm.files.programs.syntax import Form, Number, Taught, Text, Truth
from truearm.files.programs.values import (
    Listed,
    Pose,
    Unknown,
    Value,
    Values,
    first_unknown,
    fixed_mm,
    inverse,
    numbers_of,
    origin_of,
    shifted,
    taught_pose,
    times,
    turned,
)
from truearm.units import MM

KEPT = 256  # tools and work objects whose frames are remembered: many moves use one
NONE, NO_AXIS = 9e9, 8.9e9  # 9E9 represents a missing external axis


def target_of(value: Value, at: int) -> Value:
    if isinstance(value, Unknown | Pose):
        return value
    if isinstance(value, Taught):
        return taught_pose(value) if value.form is Form.ROBTARGET else value
    if not isinstance(value, Listed):
        return Unknown("its target is neither a robtarget nor a jointtarget", at)
    pose = _frame((Listed(value.items[:2]),)) if len(value.items) == 4 else None
    if (unknown := _unknown_in(value)) is not None or pose is None:
        return unknown or Unknown("its target is not written as plain numbers in one place", at)
    kept = [numbers_of(one[0]) if len(one) == 1 else None for one in value.items[2:]]
    if any(one is None or len(one) != n for one, n in zip(kept, (4, 6), strict=True)):
        return Unknown("its configuration or its external axes are known only at run time", at)
    configuration, axes = (",".join("9E9" if x == NONE else f"{x:.10g}" for x in one or ()) for one in kept)
    return pose._replace(like=Taught(Form.ROBTARGET, f"[[0,0,0],[1,0,0,0],[{configuration}],[{axes}]]", at))


def tool_of(value: Value, at: int) -> Value:
    """Return the frame of a tooldata."""
    value = _record(value, 3, Unknown("its tool is not a tooldata", at), "tools")
    if not isinstance(value, Listed):
        return value
    if value.items[0] != (Truth(True),):
        return Unknown("its tool is not held by the robot", at)
    pose = _kept_frame(value.items[1])
    return pose or _unknown_in(value) or Unknown("its tool has no frame of plain numbers", at)


def object_of(value: Value, at: int) -> Value:
    """Return the frame of a wobjdata: user frame and object frame."""
    value = _record(value, 5, Unknown("its work object is not a wobjdata", at), "works")
    if not isinstance(value, Listed):
        return value
    in_hand, fixed_frame, unit, users, own = value.items
    if in_hand != (Truth(False),):
        return Unknown("its work object is held by the robot", at)
    if fixed_frame != (Truth(True),) or unit != (Text(""),):
        return Unknown("its work object is moved by a mechanical unit", at)
    frame = _object_frame(users, own)
    return frame or _unknown_in(value) or Unknown("its work object has no frames of plain numbers", at)


def _record(value: Value, n: int, wrong: Unknown, remedy: str) -> Value:
    """Return a record of n components, a pose or an unknown value; ``wrong`` if it is none of these."""
    if isinstance(value, Unknown):
        return value._replace(remedy=remedy) if value.remedy == UNDECLARED else value
    return value if isinstance(value, Pose) or (isinstance(value, Listed) and len(value.items) == n) else wrong


@lru_cache(KEPT)
def _object_frame(users: Values, own: Values) -> Pose | None:
    """Return the product of a user frame and an object frame."""
    first, second = _frame(users), _frame(own)
    return None if first is None or second is None else times(first, second)


def tooldata(six: Sequence[float]) -> Listed:
    """Return a tool that the robot holds, at x, y, z [m] with a rotation vector [rad]; its load is not known."""
    load = Unknown("its load is declared elsewhere", 0)
    return Listed(((Truth(True),), (_listed_frame(six),), (load,)))


def wobjdata(six: Sequence[float]) -> Listed:
    """Return a fixed work object whose user frame is at x, y, z [m] with a rotation vector [rad]."""
    own = _listed_frame((0.0,) * 6)
    return Listed(((Truth(False),), (Truth(True),), (Text(""),), (_listed_frame(six),), (own,)))


def _listed_frame(six: Sequence[float]) -> Listed:
    x, y, z, w = Rotation.from_rotvec(six[3:]).as_quat().tolist()
    parts = [[float(MM.of(value)) for value in six[:3]], [w, x, y, z]]
    return Listed(tuple((Listed(tuple((Number(value),) for value in part)),) for part in parts))


def _frame(values: Values) -> Pose | None:
    """Return a pose [[x, y, z], [q1, q2, q3, q4]] of plain numbers."""
    if len(values) != 1 or not isinstance(values[0], Listed) or len(values[0].items) != 2:
        return None
    parts = [numbers_of(item[0]) if len(item) == 1 else None for item in values[0].items]
    place, turn = parts
    found = fixed_mm(place, turn) if place and turn and (len(place), len(turn)) == (3, 4) else None
    return None if found is None else found._replace(origin=origin_of(values))


_kept_frame = lru_cache(KEPT)(_frame)


def _unknown_in(value: Value) -> Unknown | None:
    return value if isinstance(value, Unknown) else value.unknown if isinstance(value, Listed) else None


def _numbers(given: Sequence[Value]) -> list[float] | None:
    found = [one.value for one in given if isinstance(one, Number)]
    return found if len(found) == len(given) and all(map(math.isfinite, found)) else None


def _target_and_numbers(given: Sequence[Value], at: int, missing: str) -> tuple[Pose, list[float]] | Unknown:
    target, numbers = target_of(given[0], at), _numbers(given[1:])
    if isinstance(target, Unknown):
        return target
    if numbers is None or not isinstance(target, Pose):
        return first_unknown(given[1:]) or Unknown(missing, at)
    return target, numbers


def offset(given: Sequence[Value], at: int) -> Value:
    found = _target_and_numbers(given, at, "the offsets of Offs are not known")
    if isinstance(found, Unknown):
        return found
    target, numbers = found
    return times(shifted([float(MM.to_si(value)) for value in numbers]), target)


def offset_along_tool(given: Sequence[Value], at: int) -> Value:
    """Return a target offset along the tool, rotated about x first, then the new y, then the new z."""
    found = _target_and_numbers(given, at, "the arguments of RelTool are not known")
    if isinstance(found, Unknown):
        return found
    target, numbers = found
    x, y, z = map(math.radians, numbers[3:])
    turn = of_quaternion(*quaternion_of_tool_angles(x, y, z))
    return times(target, shifted([float(MM.to_si(value)) for value in numbers[:3]]), turned(turn))


def oriented(given: Sequence[Value], at: int) -> Value:
    """Return a quaternion, scalar first, of rotations about z, the new y, the new x [deg]."""
    numbers = _numbers(given)
    if numbers is None:
        return first_unknown(given) or Unknown("the angles of OrientZYX are not known", at)
    z, y, x = map(math.radians, numbers)
    return Listed(tuple((Number(value),) for value in quaternion_of_angles(z, y, x)))


def multiplied(given: Sequence[Value], at: int) -> Value:
    """Return the product of poses [[x, y, z], [q1, q2, q3, q4]], in this form."""
    poses = [_frame((one,)) for one in given]
    known = [one for one in poses if one is not None]
    if len(known) < len(poses):
        unknown = next((found for one in given if (found := _unknown_in(one)) is not None), None)
        return unknown or Unknown("a pose of PoseMult is not made of plain numbers", at)
    return _listed(times(*known))


def inverted(given: Sequence[Value], at: int) -> Value:
    """Return the inverse of a pose [[x, y, z], [q1, q2, q3, q4]], in this form."""
    pose = _frame((given[0],))
    if pose is None:
        return _unknown_in(given[0]) or Unknown("the pose of PoseInv is not made of plain numbers", at)
    return _listed(inverse(pose))


def _listed(pose: Pose) -> Listed:
    """Return a fixed pose as [[x, y, z], [q1, q2, q3, q4]]."""
    here = matrix(pose)
    x, y, z, w = Rotation.from_matrix(here[:3, :3]).as_quat().tolist()
    parts = [MM.of(here[:3, 3]).tolist(), [w, x, y, z]]
    return Listed(tuple((Listed(tuple((Number(value, pose.origin),) for value in part)),) for part in parts))


def items_of(of: Value) -> tuple[Values, ...] | None:
    """Return the items of a list or of a literal, as lists again."""
    if isinstance(of, Listed):
        return of.items
    if not isinstance(of, Taught):
        return None
    ends = (3, 7, 11, 17) if of.form is Form.ROBTARGET else (6, 12)
    values = of.values
    parts, origin = [values[start:end] for start, end in zip((0, *ends), ends, strict=False)], frozenset({of})
    return tuple((Listed(tuple((Number(value, origin),) for value in part)),) for part in parts)
