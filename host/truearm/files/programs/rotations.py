"""Rotations of single poses in plain numbers: an array of NumPy costs more than the whole calculation.

A rotation is the nine numbers of its matrix, row after row.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

Nine = tuple[float, float, float, float, float, float, float, float, float]
NO_TURN: Nine = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


def of_quaternion(w: float, x: float, y: float, z: float) -> Nine:
    """Return the rotation of a quaternion of any norm but 0, scalar first."""
    s = 2.0 / (w * w + x * x + y * y + z * z)
    xs, ys, zs = x * s, y * s, z * s
    return (
        *(1.0 - (y * ys + z * zs), x * ys - w * zs, x * zs + w * ys),
        *(x * ys + w * zs, 1.0 - (x * xs + z * zs), y * zs - w * xs),
        *(x * zs - w * ys, y * zs + w * xs, 1.0 - (x * xs + y * ys)),
    )


def of_vector(x: float, y: float, z: float) -> Nine:
    """Return the rotation of a rotation vector [rad]."""
    angle = math.hypot(x, y, z)
    if angle == 0.0:
        return NO_TURN
    by = math.sin(0.5 * angle) / angle
    return of_quaternion(math.cos(0.5 * angle), x * by, y * by, z * by)


def transposed(turn: Nine) -> Nine:
    """Return the inverse rotation."""
    a, b, c, d, e, f, g, h, i = turn
    return a, d, g, b, e, h, c, f, i


def quaternion_of_angles(z: float, y: float, x: float) -> tuple[float, float, float, float]:
    """Return the quaternion, scalar first, of turns about z, then the new y, then the new x [rad]."""
    (cz, sz), (cy, sy), (cx, sx) = ((math.cos(0.5 * one), math.sin(0.5 * one)) for one in (z, y, x))
    return (
        cz * cy * cx + sz * sy * sx,
        cz * cy * sx - sz * sy * cx,
        cz * sy * cx + sz * cy * sx,
        sz * cy * cx - cz * sy * sx,
    )


def quaternion_of_tool_angles(x: float, y: float, z: float) -> tuple[float, float, float, float]:
    """Return the quaternion, scalar first, of turns about x, then the new y, then the new z [rad]."""
    w, i, j, k = quaternion_of_angles(-z, -y, -x)  # the inverse, which turns back in the other order
    return w, -i, -j, -k


def rows_of(xyz: Sequence[float], turn: Nine) -> tuple[float, ...]:
    """Return the sixteen numbers of a pose's matrix (4, 4)."""
    x, y, z = map(float, xyz)
    a, b, c, d, e, f, g, h, i = turn
    return a, b, c, x, d, e, f, y, g, h, i, z, 0.0, 0.0, 0.0, 1.0
