"""Denavit–Hartenberg rows of any robot with revolute joints, computed from the poses of its axes.

Frame 0 lies on the first axis, at the point nearest to the robot's base. Frame i lies on axis i + 1 at the foot of the
common normal from axis i, with x along that normal. Frame n lies on the last axis, at the point nearest to the flange.
The remaining transforms at both ends go into base and tool. The direction of x follows the nominal robot, where it is
chosen to make θ smallest, as manufacturers do.

Nearly parallel axes have no well-defined normal: with an angle of δ between them, an error e moves its foot by e/δ.
Such a table is meaningless to a reader and loses digits. It is rejected, or written with Hayati's β and d = 0
(``model.dh``). Exactly parallel axes have d = 0.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from truearm.errors import RobotError
from truearm.export.link_frames import LinkFrames
from truearm.model.poses import inverted
from truearm.types import Floats
from truearm.units import DEG

PARALLEL = 1e-9  # sine of the angle below which axes are parallel
NEARLY = math.sin(math.radians(1.0))  # one millimetre then becomes 57 mm of d


class DhRows(NamedTuple):
    """Distal rows between base and tool; ``beta`` is NaN for a row without it."""

    theta: Floats  # (j,) at joint variable 0
    d: Floats  # (j,)
    a: Floats  # (j,)
    alpha: Floats  # (j,)
    beta: Floats  # (j,)
    base: Floats  # (4, 4) from the robot's base frame to frame 0
    tool: Floats  # (4, 4) from frame n to the robot's flange


def dh_rows(robot: LinkFrames, nominal: LinkFrames, hayati: bool = False) -> DhRows:
    """Return the rows of a robot. ``hayati``: with β where axes are nearly parallel; otherwise RobotError is raised."""
    ways = _ways(nominal)
    axes = _axes(robot)
    base = _frame_on(axes[0], np.eye(4))
    frame, rows = base, []
    for i in range(len(robot.joints) - 1):
        row, frame = _row(i, frame, axes[i + 1], ways[i], hayati)
        rows.append(row)
    end = _end(robot)
    last = _frame_on(frame, end)
    between = inverted(frame) @ last
    rows.append((math.atan2(between[1, 0], between[0, 0]), float(between[2, 3]), 0.0, 0.0, math.nan))
    theta, d, a, alpha, beta = np.array(rows).T
    return DhRows(theta, d, a, alpha, beta, base, inverted(last) @ end)


def _ways(nominal: LinkFrames) -> list[Floats]:
    """Return the nominal x axes of frames 1 to n − 1, in the direction with the smallest θ."""
    axes = _axes(nominal)
    frame, ways = _frame_on(axes[0], np.eye(4)), []
    for i in range(len(nominal.joints) - 1):
        ways.append(_normal(frame, axes[i + 1])[1])
        theta = _angle_about(frame, ways[i])
        # A quarter turn either way is equally small: then choose a positive a.
        if abs(theta) > 0.5 * math.pi + 1e-6:
            ways[i] = -ways[i]
        frame = _row(i, frame, axes[i + 1], ways[i], hayati=True)[1]
    return ways


def _axes(robot: LinkFrames) -> list[Floats]:
    """Return frames (4, 4) whose z axes are those of the joints, in the robot's base frame, at joint variables 0."""
    here, out = np.eye(4), []
    for link in robot.links[:-1]:
        here = here @ link
        out.append(here)
    return out


def _end(robot: LinkFrames) -> Floats:
    here = np.eye(4)
    for link in robot.links:
        here = here @ link
    return here


def _frame_on(axis: Floats, near: Floats) -> Floats:
    """Return the frame on an axis nearest to another frame: at its origin's foot, x along its x (or y) projected."""
    z = axis[:3, 2]
    origin = axis[:3, 3] + z * (z @ (near[:3, 3] - axis[:3, 3]))
    x = near[:3, 0] - z * (z @ near[:3, 0])
    if np.linalg.norm(x) < 1e-3:
        x = near[:3, 1] - z * (z @ near[:3, 1])
    return _frame(origin, x / np.linalg.norm(x), z)


def _frame(origin: Floats, x: Floats, z: Floats) -> Floats:
    out = np.eye(4)
    out[:3, 0], out[:3, 1], out[:3, 2], out[:3, 3] = x, np.cross(z, x), z, origin
    return out


def _normal(frame: Floats, axis: Floats) -> tuple[Floats, Floats, float]:
    """Return where the common normal leaves the frame's z axis, its direction to the axis, the sine between both."""
    z, z_next = frame[:3, 2], axis[:3, 2]
    across = np.cross(z, z_next)
    sine = float(np.linalg.norm(across))
    between = axis[:3, 3] - frame[:3, 3]
    if sine < PARALLEL:
        way = between - z * (z @ between)
        far = float(np.linalg.norm(way))
        return frame[:3, 3], way / far if far > 1e-9 else frame[:3, 0], sine
    way = across / sine
    foot = frame[:3, 3] + z * (np.cross(between, z_next) @ across / sine**2)
    return foot, way if way @ between >= -1e-9 else -way, sine


def _row(i: int, frame: Floats, axis: Floats, way: Floats, hayati: bool) -> tuple[tuple[float, ...], Floats]:
    """Return θ, d, a, α, β of joint i, and the frame after it, whose x axis points in the nominal direction."""
    foot, x, sine = _normal(frame, axis)
    z, z_next = frame[:3, 2], axis[:3, 2]
    near = PARALLEL <= sine < NEARLY
    if near and not hayati:
        d = float(z @ (foot - frame[:3, 3]))
        raise RobotError(
            f"the axes of joints {i + 1} and {i + 2} are {DEG.of(math.asin(sine)):.4f}° from parallel: the offset d between them would be "
            f"{d:.3f} m, which has no meaning; use dh-hayati or another format"
        )
    if near:
        return _hayati_row(frame, axis, way)
    x = x if x @ way >= 0.0 else -x
    d = float(z @ (foot - frame[:3, 3]))
    to_axis = axis[:3, 3] - foot
    along = 0.0 if sine < PARALLEL else _foot_along(to_axis, z, z_next)
    origin = axis[:3, 3] + (along * z_next if sine >= PARALLEL else -z_next * (z_next @ to_axis))
    a = float(x @ (origin - foot))
    alpha = math.atan2(float(x @ np.cross(z, z_next)), float(z @ z_next))
    return (_angle_about(frame, x), d, a, alpha, math.nan), _frame(origin, x, z_next)


def _foot_along(to_axis: Floats, z: Floats, z_next: Floats) -> float:
    """Return where the common normal meets the next axis, from its frame's origin; the normal begins at to_axis = 0."""
    across = np.cross(z, z_next)
    return float(np.cross(to_axis, z) @ across / (across @ across))


def _hayati_row(frame: Floats, axis: Floats, way: Floats) -> tuple[tuple[float, ...], Floats]:
    """Return a row with d = 0: the next axis meets the plane across this one, and x points from here to that point."""
    z, z_next = frame[:3, 2], axis[:3, 2]
    origin = axis[:3, 3] + z_next * (z @ (frame[:3, 3] - axis[:3, 3])) / (z @ z_next)
    x = origin - frame[:3, 3]
    far = float(np.linalg.norm(x))
    x = x / far if far > 1e-6 else frame[:3, 0]
    x, far = (x, far) if x @ way >= 0.0 else (-x, -far)
    y = np.cross(z, x)
    beta = math.asin(float(np.clip(x @ z_next, -1.0, 1.0)))
    alpha = math.atan2(-float(y @ z_next), float(z @ z_next))
    x_next = math.cos(beta) * x + math.sin(beta) * (math.sin(alpha) * y - math.cos(alpha) * z)
    return (_angle_about(frame, x), 0.0, far, alpha, beta), _frame(origin, x_next, z_next)


def _angle_about(frame: Floats, x: Floats) -> float:
    """Return the angle from the frame's x axis to another direction across its z axis."""
    return math.atan2(float(frame[:3, 1] @ x), float(frame[:3, 0] @ x))
