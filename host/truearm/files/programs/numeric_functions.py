"""Functions of numbers and fixed poses in both languages, computed where all their arguments are known.

What they return keeps the literals from whose numbers it was computed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from truearm.files.programs.rotations import Nine
from truearm.files.programs.syntax import Number
from truearm.files.programs.target_poses import LiteralPoses, matrices_of, matrix_of
from truearm.files.programs.values import Listed, Pose, Unknown, Value, first_unknown, fixed, literals_in, origin_of
from truearm.types import Floats

HALF = 1e-6  # a number this close to a half may be rounded up or down
OPPOSITE = 1e-3  # rad from half a turn: the sense of turning from one to the other is not certain
Function = tuple[int, Callable[..., float]]  # the number of arguments, and what it computes


def _rounded(value: float) -> float:
    whole = math.floor(value + 0.5)
    if abs(value + 0.5 - round(value + 0.5)) < HALF:
        raise ValueError("a half")
    return float(whole)


def _in_degrees(function: Callable[[float], float]) -> Function:
    return 1, lambda value: function(math.radians(value))


def _to_degrees(function: Callable[..., float], count: int = 1) -> Function:
    return count, lambda *given: math.degrees(function(*given))


OF_URSCRIPT: Mapping[str, Function] = {
    **{name: (1, getattr(math, name)) for name in ("cos", "sin", "tan", "acos", "asin", "atan", "sqrt", "floor", "ceil")},
    **{"atan2": (2, math.atan2), "pow": (2, math.pow), "r2d": (1, math.degrees)},
}  # fmt: skip
OF_RAPID: Mapping[str, Function] = {
    **{name: _in_degrees(getattr(math, name)) for name in ("cos", "sin", "tan")},
    **{name: _to_degrees(getattr(math, name)) for name in ("acos", "asin", "atan")},
    **{"atan2": _to_degrees(math.atan2, 2), "sqrt": (1, math.sqrt), "pow": (2, math.pow), "abs": (1, abs)},
    **{"max": (2, max), "min": (2, min), "trunc": (1, math.trunc), "round": (1, _rounded)},
}


def applied(name: str, function: Function, given: Sequence[Value], at: int) -> Value:
    """Return what a function gives for numbers; unknown for anything else, and where it has no result."""
    count, compute = function
    numbers = [one.value for one in given if isinstance(one, Number)]
    if len(numbers) == len(given) == count:
        try:
            found = float(compute(*numbers))
        except (ValueError, OverflowError, ZeroDivisionError):
            found = math.nan
        if math.isfinite(found):
            return Number(found, origin_of(given))
    return first_unknown(given) or Unknown(f"the result of {name} is not known", at)


def length_of(value: Value, at: int) -> Value:
    """Return the number of elements of a list."""
    if isinstance(value, Listed) and not value.pose:
        return Number(float(len(value.items)))
    return value if isinstance(value, Unknown) else Unknown("the length of a list is not known", at)


def matrix(pose: Pose) -> Floats:
    """Return the matrix (4, 4) of a pose, with the numbers that its literals have in the program."""
    literals = list({one.start: one for one in literals_in(pose)}.values())
    return matrix_of(pose, LiteralPoses({one.start: k for k, one in enumerate(literals)}, matrices_of(literals)))


def between(first: Pose, second: Pose, share: Value, at: int) -> Value:
    """Return the pose at a share of the straight way from one to the other, which turns evenly."""
    if not isinstance(share, Number):
        return first_unknown((share,)) or Unknown("the share of interpolate_pose is not known", at)
    start, end = matrix(first), matrix(second)
    turn = Rotation.from_matrix(start[:3, :3].T @ end[:3, :3]).as_rotvec()
    if not np.isfinite([*start.flat, *end.flat]).all() or np.linalg.norm(turn) > math.pi - OPPOSITE:
        return Unknown("interpolate_pose may turn either way between its poses", at)
    here = start[:3, :3] @ Rotation.from_rotvec(share.value * turn).as_matrix()
    place = start[:3, 3] + share.value * (end[:3, 3] - start[:3, 3])
    a, b, c, d, e, f, g, h, i = here.ravel().tolist()
    rows: Nine = (a, b, c, d, e, f, g, h, i)
    return fixed(place.tolist(), rows)._replace(origin=origin_of((first, second, share)))
