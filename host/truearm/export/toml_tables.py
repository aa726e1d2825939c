"""Calibrated robots as robot files (TOML, docs/reference/robot-format.md): tables to read, and to identify from again.

Every convention has its table: ``dh`` and ``modified_dh`` rows between base and tool, ``sheth_uicker`` links of six
constants. The mountings are part of base and tool, or of the first and the last link; the comment at the top lists them
separately.

Denavit–Hartenberg rows are computed from the axes of any robot with revolute joints. Frame 0 lies on the first axis,
nearest to the robot's base. Frame i lies on axis i + 1 at the foot of the common normal from axis i, with x along it.
Frame n lies on the last axis, nearest to the flange. The direction of x makes θ smallest for the nominal robot, as
manufacturers do.

Nearly parallel axes have a distant normal, hundreds of metres for an arm as built, and such d of successive rows
cancel. Each row begins at the frame that the rows before it give in floating point, so the rows predict the arm to
1e-15 of the largest d. With ``hayati``, nearly parallel rows have Hayati's β and d = 0 instead
(``model.robot_tables``). Exactly parallel axes have d = 0.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from itertools import accumulate
from typing import NamedTuple

import numpy as np

from truearm.errors import RobotError
from truearm.export.writing import LinkFrames, RobotToWrite
from truearm.model.chain_structure import Joint
from truearm.model.transforms import elementary, inverted, six_of
from truearm.types import Floats
from truearm.units import UNITS

PARALLEL = 1e-8  # sine of the angle below which axes are parallel: d is at most 1e8 m
NEARLY = math.sin(math.radians(1.0))  # of nominal axes that have β: one millimetre would become 57 mm of d
SIX = ("x_m", "y_m", "z_m", "alpha_rad", "beta_rad", "gamma_rad")
NO_LIMIT = UNITS["rad"].largest  # for a joint without limits


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
    """Return the rows of a robot. ``hayati``: with β where the nominal axes are nearly parallel."""
    directions, parallel = _ways(nominal)
    *axes, end = _axes(robot)
    base = _frame_on(axes[0], np.eye(4))
    frame, rows = base, []
    for i in range(len(robot.joints) - 1):
        row, frame = _row(frame, axes[i + 1], directions[i], hayati and parallel[i])
        rows.append(row)
    last = _frame_on(frame, end)
    between = inverted(frame) @ last
    rows.append((math.atan2(between[1, 0], between[0, 0]), float(between[2, 3]), 0.0, 0.0, math.nan))
    theta, d, a, alpha, beta = np.array(rows).T
    return DhRows(theta, d, a, alpha, beta, base, inverted(last) @ end)


def _ways(nominal: LinkFrames) -> tuple[list[Floats], list[bool]]:
    """Return the nominal x axes of frames 1 to n − 1 with the least θ, and whether axes are nearly parallel there."""
    *axes, _ = _axes(nominal)
    frame, directions, parallel = _frame_on(axes[0], np.eye(4)), [], []
    for axis in axes[1:]:
        _, x, sine = _normal(frame, axis)
        parallel.append(sine < NEARLY)
        x = _toward(frame, axis)[1] if parallel[-1] else x
        theta = _angle_about(frame, x)
        # A quarter turn either way is equally small: then choose a positive a.
        directions.append(-x if abs(theta) > 0.5 * math.pi + 1e-6 else x)
        frame = _row(frame, axis, directions[-1], parallel[-1])[1]
    return directions, parallel


def _axes(robot: LinkFrames) -> list[Floats]:
    """Return frames (4, 4) with the joints' z axes, and the flange, in the robot's base frame, at variables 0."""
    return list(accumulate(robot.links, np.matmul))


def _frame_on(axis: Floats, neighbour: Floats) -> Floats:
    """Return the frame on an axis nearest to another frame: at its origin's foot, x along its x (or y) projected."""
    z = axis[:3, 2]
    origin = axis[:3, 3] + z * (z @ (neighbour[:3, 3] - axis[:3, 3]))
    x = neighbour[:3, 0] - z * (z @ neighbour[:3, 0])
    if np.linalg.norm(x) < 1e-3:
        x = neighbour[:3, 1] - z * (z @ neighbour[:3, 1])
    return _frame(origin, x / np.linalg.norm(x), z)


def _frame(origin: Floats, x: Floats, z: Floats) -> Floats:
    out = np.eye(4)
    out[:3, 0], out[:3, 1], out[:3, 2], out[:3, 3] = x, np.cross(z, x), z, origin
    return out


def _normal(frame: Floats, axis: Floats) -> tuple[float, Floats, float]:
    """Return how far up the z axis the common normal leaves it, its direction to the axis, the sine between both."""
    z, z_next = frame[:3, 2], axis[:3, 2]
    across = np.cross(z, z_next)
    sine = float(np.linalg.norm(across))
    between = axis[:3, 3] - frame[:3, 3]
    if sine < PARALLEL:
        return 0.0, _toward(frame, axis)[1], sine
    direction = across / sine
    d = float(np.cross(between, z_next) @ across / sine**2)
    return d, direction if direction @ between >= -1e-9 else -direction, sine


def _toward(frame: Floats, axis: Floats) -> tuple[float, Floats]:
    """Return distance and direction to the point where a nearly parallel axis meets the plane across the z axis."""
    z, z_next = frame[:3, 2], axis[:3, 2]
    vector = axis[:3, 3] + z_next * (z @ (frame[:3, 3] - axis[:3, 3])) / (z @ z_next) - frame[:3, 3]
    distance = float(np.linalg.norm(vector))
    return distance, vector / distance if distance > 1e-6 else frame[:3, 0]


def _row(frame: Floats, axis: Floats, direction: Floats, with_beta: bool) -> tuple[tuple[float, ...], Floats]:
    """Return θ, d, a, α, β of a joint, and the frame after it, whose x axis points in the nominal direction."""
    if with_beta:
        row = _hayati_row(frame, axis, direction)
    else:
        d, x, _ = _normal(frame, axis)
        x = x if x @ direction >= 0.0 else -x
        z, z_next = frame[:3, 2], axis[:3, 2]
        alpha = math.atan2(float(x @ np.cross(z, z_next)), float(z @ z_next))
        row = _angle_about(frame, x), d, float(x @ (axis[:3, 3] - frame[:3, 3])), alpha, math.nan
    for motion, amount in zip(("rz", "tz", "tx", "rx", "ry"), row, strict=True):
        frame = frame if math.isnan(amount) else frame @ elementary(motion, amount)
    return row, frame


def _hayati_row(frame: Floats, axis: Floats, direction: Floats) -> tuple[float, ...]:
    """Return a row with d = 0: the next axis meets the plane across this one, and x points from here to that point."""
    z, z_next = frame[:3, 2], axis[:3, 2]
    distance, x = _toward(frame, axis)
    x, distance = (x, distance) if x @ direction >= 0.0 else (-x, -distance)
    y = np.cross(z, x)
    beta = math.asin(float(np.clip(x @ z_next, -1.0, 1.0)))
    alpha = math.atan2(-float(y @ z_next), float(z @ z_next))
    return _angle_about(frame, x), 0.0, distance, alpha, beta


def _angle_about(frame: Floats, x: Floats) -> float:
    """Return the angle from the frame's x axis to another direction across its z axis."""
    return math.atan2(float(frame[:3, 1] @ x), float(frame[:3, 0] @ x))


def sheth_uicker_table(source: RobotToWrite) -> str:
    """Return a robot file of links of six constants, joints about or along z, for any robot."""
    robot = source.robot
    links = [robot.first, *robot.links[1:-1], robot.last]
    lines = _head(robot, "sheth_uicker", source.comment)
    for i, link in enumerate(links):
        lines += ["", f"[link{i + 1}]", *_six(link)]
        if i < len(robot.joints):
            lines += _joint(i, robot, float(robot.offsets[i]))
    return "\n".join([*lines, ""])


def dh_table(source: RobotToWrite, hayati: bool = False) -> str:
    """Return a robot file of distal rows, with β if ``hayati`` and needed. Raises RobotError for prismatic joints."""
    rows = _rows(source, hayati)

    def constants(i: int) -> list[str]:
        has_beta = not math.isnan(rows.beta[i])
        d = "d_m = 0.0" if has_beta else _parameter("d_m", rows.d[i])
        beta = [_parameter("beta_rad", rows.beta[i])] * has_beta
        return [d, _parameter("a_m", rows.a[i]), _parameter("alpha_rad", rows.alpha[i]), *beta]

    return _rows_table(source, rows, "dh", constants)


def dh_hayati_table(source: RobotToWrite) -> str:
    """Return a robot file of distal rows, with β where it is needed."""
    return dh_table(source, hayati=True)


def modified_dh_table(source: RobotToWrite) -> str:
    """Return a robot file of Craig's rows: a and α of a row are those of the distal form one row earlier."""
    rows = _rows(source)

    def constants(i: int) -> list[str]:
        a, alpha = (rows.a[i - 1], rows.alpha[i - 1]) if i else (0.0, 0.0)
        return [_parameter("alpha_rad", alpha), _parameter("a_m", a), _parameter("d_m", rows.d[i])]

    return _rows_table(source, rows, "modified_dh", constants)


def _rows_table(source: RobotToWrite, rows: DhRows, convention: str, constants: Callable[[int], list[str]]) -> str:
    robot = source.robot
    lines = [*_head(robot, convention, source.comment), "", "[base]", *_six(robot.base @ rows.base)]
    for i in range(len(robot.joints)):
        lines += [*_joint(i, robot, float(rows.theta[i] + robot.offsets[i])), *constants(i)]
    return "\n".join([*lines, "", "[tool]", *_six(rows.tool @ robot.tool), ""])


def _rows(source: RobotToWrite, hayati: bool = False) -> DhRows:
    for joint in source.robot.joints:
        if joint.kind != "revolute":
            raise RobotError(
                f"joint {joint.name} is prismatic; this format holds revolute joints only, use sheth-uicker"
            )
    return dh_rows(source.robot, source.described, hayati)


def _head(robot: LinkFrames, convention: str, comment: str) -> list[str]:
    return [
        *(f"# {line}" for line in comment.splitlines()),
        *([""] if comment else []),
        f"name = {_text(robot.name)}",
        f'convention = "{convention}"',
        'source = "truearm export"',
        'nominal = "calibrated"',
        f"base_frame = {_text(robot.base_frame)}",
        f"end_frame = {_text(robot.end_frame)}",
    ]


def _text(text: str) -> str:
    """Return a TOML basic string; JSON's escapes are TOML's."""
    return json.dumps(text, ensure_ascii=False)


def _six(pose: Floats) -> list[str]:
    return [_parameter(key, value) for key, value in zip(SIX, six_of(pose), strict=True)]


def _joint(i: int, robot: LinkFrames, offset: float) -> list[str]:
    joint = robot.joints[i]
    unit = "m" if joint.kind == "prismatic" else "rad"
    lower, upper = _limits(joint)
    return [
        "",
        f"[joint{i + 1}]  # {one_line(joint.name)}",
        f'kind = "{joint.kind}"',
        f"lower_{unit} = {lower!r}",
        f"upper_{unit} = {upper!r}",
        _parameter(f"offset_{unit}", offset),
        f"gain = {{ calibrated = {float(robot.gains[i])!r}, held = true }}",
        *_further_terms(i, robot),
    ]


def _further_terms(i: int, robot: LinkFrames) -> list[str]:
    """Return the terms of a joint's law other than offset and gain, unless they are neutral."""
    return [
        _parameter(f"{term.name}_{term.unit_of(robot.joints[i].kind)}".removesuffix("_1"), robot.params[index])
        for term in robot.further_terms
        for index in term.parameters[term.joints == i]
        if robot.params[index] != term.neutral
    ]


def _limits(joint: Joint) -> Sequence[float]:
    return [float(np.clip(value, -NO_LIMIT, NO_LIMIT)) for value in (joint.lower, joint.upper)]


def _parameter(key: str, value: float) -> str:
    return f"{key} = {{ calibrated = {float(value) + 0.0!r} }}"


def one_line(text: str) -> str:
    """Return a name as it may appear in a comment."""
    return "".join(c for c in text if c.isprintable())[:100]
