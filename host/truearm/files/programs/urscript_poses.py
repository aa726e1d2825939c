"""Poses and lists of URScript, and the functions on them.

``pose_trans(A, B)`` is A·B; ``pose_add(A, B)`` adds positions and multiplies rotations.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from truearm.files.programs.numeric_functions import OF_URSCRIPT, applied, between, length_of
from truearm.files.programs.rotations import transposed
from truearm.files.programs.syntax import Number, Taught
from truearm.files.programs.values import (
    Fixed,
    Listed,
    Pose,
    Solved,
    Unknown,
    Value,
    Values,
    first_unknown,
    fixed_six,
    inverse,
    numbers_of,
    origin_of,
    shifted,
    times,
    turned,
    united,
)
from truearm.types import Floats
from truearm.units import DEG

SIX = 6
MOST_ITEMS = 1_000  # of a list that make_list returns


def as_pose(value: Value, at: int) -> Pose | Unknown:
    if isinstance(value, Pose | Unknown):
        return value
    if isinstance(value, Solved):
        return value.pose
    numbers = numbers_of(value)
    if numbers is not None and len(numbers) == SIX and _finite(numbers):
        return fixed_six(numbers)._replace(origin=origin_of((value,)))
    several = isinstance(value, Listed) and len(value.items) == SIX and any(len(item) > 1 for item in value.items)
    why = (
        "its numbers have several possible values; write a target of its own for each"
        if several
        else "it is not a pose of six numbers"
    )
    return unknown_in(value) or Unknown(why, at)


def unknown_in(value: Value) -> Unknown | None:
    inner = value.items if isinstance(value, Listed) else ()
    return next((one for item in inner for one in item if isinstance(one, Unknown)), None)


def items_of(of: Value) -> tuple[Values, ...] | None:
    if isinstance(of, Listed):
        return of.items
    if (
        isinstance(of, Pose)
        and len(of.factors) == 1
        and not of.factors[0].inverse
        and isinstance(of.factors[0].pose, Taught)
    ):
        of = of.factors[0].pose
    return tuple((Number(value, frozenset({of})),) for value in of.values) if isinstance(of, Taught) else None


def list_made(arguments: Sequence[Values], named: Mapping[str, Values], at: int) -> Values:
    """Return a list of equal items: length, initial value, and a capacity that does not matter."""
    given = dict(zip(("length", "initial_value", "capacity"), arguments, strict=False)) | dict(named)
    size, item = given.get("length", ()), given.get("initial_value", ())
    if len(size) != 1 or not isinstance(size[0], Number) or not item:
        return (Unknown("the length of its list is not known; give make_list a plain number", at),)
    if not 0 <= size[0].value <= MOST_ITEMS:
        return (Unknown(f"its list is too long; give make_list a length of at most {MOST_ITEMS}", at),)
    return (Listed((item,) * int(size[0].value)),)


def _poses(given: Sequence[Value], n: int, at: int) -> list[Pose] | Unknown:
    if len(given) != n:
        return Unknown(f"it has {len(given)} arguments instead of {n}", at)
    found = [as_pose(value, at) for value in given]
    unknown = first_unknown(found)
    return unknown or [pose for pose in found if isinstance(pose, Pose)]


def _trans(given: Sequence[Value], at: int) -> Value:
    poses = _poses(given, 2, at)
    return poses if isinstance(poses, Unknown) else times(*poses)


def _add(given: Sequence[Value], at: int) -> Value:
    """Return A's position plus B's, and rotation R_A·R_B: a translation, A, and a rotation."""
    poses = _poses(given, 2, at)
    return poses if isinstance(poses, Unknown) else _moved(poses[0], poses[1], 1, at)


def _sub(given: Sequence[Value], at: int) -> Value:
    poses = _poses(given, 2, at)
    return poses if isinstance(poses, Unknown) else _moved(poses[0], poses[1], -1, at)


def _moved(a: Pose, b: Pose, sense: int, at: int) -> Value:
    of = b.factors[0].pose if len(b.factors) == 1 and not b.factors[0].inverse else None
    if isinstance(of, Taught):
        if not _finite(of.values):
            return Unknown("it is not a pose of six numbers", at)
        numbers = fixed_six(of.values).factors[0].pose
        assert isinstance(numbers, Fixed)
        b, of = b._replace(origin=b.origin | {of}), numbers
    if of is None:
        return Unknown("the pose that is added is itself a product, which cannot be traced", at)
    a0, a1, a2, x, b0, b1, b2, y, c0, c1, c2, z, *_ = of.rows
    turn = (a0, a1, a2, b0, b1, b2, c0, c1, c2)
    found = times(shifted((sense * x, sense * y, sense * z)), a, turned(turn if sense > 0 else transposed(turn)))
    return found._replace(origin=united((found.origin, b.origin)))


def _finite(numbers: Sequence[float]) -> bool:
    """Return whether the numbers of a pose are finite, and the angle of its rotation vector is."""
    return math.isfinite(math.hypot(*numbers))


def _inv(given: Sequence[Value], at: int) -> Value:
    poses = _poses(given, 1, at)
    return poses if isinstance(poses, Unknown) else inverse(poses[0])


def _degrees(given: Sequence[Value], at: int) -> Value:
    return (
        Number(float(DEG.to_si(given[0].value)))
        if isinstance(given[0], Number)
        else Unknown("an angle is not known", at)
    )


def _rotvec(given: Sequence[Value], at: int) -> Value:
    """Return roll, pitch and yaw about fixed x, y, z as a rotation vector."""
    return _three(given, at, lambda rpy: Rotation.from_euler("xyz", rpy).as_rotvec())


def _rpy(given: Sequence[Value], at: int) -> Value:
    return _three(given, at, lambda turn: Rotation.from_rotvec(turn).as_euler("xyz"))


def _three(given: Sequence[Value], at: int, function: Callable[[Floats], Floats]) -> Value:
    """Return the result of a function for a list of three numbers."""
    numbers = numbers_of(given[0]) if len(given) == 1 else None
    if numbers is None or len(numbers) != 3 or not np.isfinite(numbers).all():
        return first_unknown(given) or unknown_in(given[0]) or Unknown("it is not a list of three known numbers", at)
    return Listed(tuple((Number(value),) for value in function(np.array(numbers)).tolist()))


def _between(given: Sequence[Value], at: int) -> Value:
    if len(given) != 3:
        return Unknown(f"it has {len(given)} arguments instead of 3", at)
    poses = _poses(given[:2], 2, at)
    return poses if isinstance(poses, Unknown) else between(poses[0], poses[1], given[2], at)


def _of_numbers(name: str) -> Callable[[Sequence[Value], int], Value]:
    return lambda given, at: applied(name, OF_URSCRIPT[name], given, at)


def _length(given: Sequence[Value], at: int) -> Value:
    return length_of(given[0], at) if len(given) == 1 else Unknown("the length of a list is not known", at)


PURE: Mapping[str, Callable[[Sequence[Value], int], Value]] = {
    **{name: _of_numbers(name) for name in OF_URSCRIPT},
    "interpolate_pose": _between,
    "length": _length,
    "get_list_length": _length,
    "rpy2rotvec": _rotvec,
    "rotvec2rpy": _rpy,
    "pose_trans": _trans,
    "pose_add": _add,
    "pose_sub": _sub,
    "pose_inv": _inv,
    "d2r": _degrees,
}
