"""Universal Robots' kinematics file (YAML), as used by ``ur_description`` and ``ur_calibration``.

    T(q) = Π U_i · Rz(q_i) ,    U_i = Trans(x, y, z)·Rz(yaw)·Ry(pitch)·Rx(roll)

for shoulder, upper_arm, forearm, wrist_1, wrist_2, wrist_3. The frame after a joint lies on its axis where the path to
the next axis begins (for the design values: where the published file has it). The format begins at the controller's
base and ends at its flange. It cannot store mountings, so they are not written.
"""

from __future__ import annotations

import numpy as np

from truearm.errors import RobotError
from truearm.export.toml_tables import dh_rows
from truearm.export.writing import LinkFrames, RobotToWrite, check_gains, link_frames
from truearm.model.controller_kinematics import KEYS, SEGMENTS
from truearm.model.transforms import elementary, inverted, six_of
from truearm.types import Floats

ROLLS = (0.0, 0.5 * np.pi, 0.0, 0.0, 0.5 * np.pi, -0.5 * np.pi)  # of the published files
AS_BUILT = 0.1  # rad, of the axes of an arm as built from those of its drawing
SMALL = 1e-6  # m, rad


def write_conf(source: RobotToWrite) -> str:
    """Return the part [mounting] of a controller's calibration.conf: differences from the drawing.

    Raises RobotError unless the robot is an arm of Universal Robots between its controller's base and flange.
    """
    ur_yaml(source)  # which checks the arrangement of the axes
    drawing = source.nominal if source.drawing is None else source.drawing
    drawn = link_frames(source.chain, drawing, drawing)
    rows, design = (dh_rows(robot, drawn) for robot in (source.robot, drawn))
    at_ends = [pose - np.eye(4) for rows_of in (rows, design) for pose in (rows_of.base, rows_of.tool)]
    straight = np.abs(np.sin(2.0 * design.alpha))
    if max(np.abs(end).max() for end in at_ends) > SMALL or straight.max() > SMALL:
        raise RobotError(
            "unsuited-robot",
            place=f"robot {source.chain.name}",
            reason="its values are not those of a drawing from the controller's base to its flange; identify with a built-in UR, or with the file of truearm robot read",
        )
    theta = rows.theta + source.robot.offsets - design.theta - drawn.offsets
    lists = {"theta": theta, "a": rows.a - design.a, "d": rows.d - design.d, "alpha": rows.alpha - design.alpha}
    lines = [f"# {line}" for line in source.comment.splitlines()] + ["[mounting]"]
    return "\n".join([*lines, *(f"delta_{name} = {values.tolist()}" for name, values in lists.items()), ""])


def ur_segments(robot: LinkFrames) -> tuple[Floats, Floats]:
    """Return U (6, 4, 4), and the remaining transform (4, 4) from the last of them to the robot's flange."""
    check_gains(robot, "a kinematics file")
    if len(robot.joints) != len(SEGMENTS) or any(joint.kind != "revolute" for joint in robot.joints):
        raise RobotError(
            "unsuited-robot",
            place=f"robot {robot.name}",
            reason="a Universal Robots kinematics file has six revolute joints; use another format",
        )
    shifts = [elementary("tz", float(link[2, 3])) for link in robot.links[1:]]
    out = []
    inverse_shift = np.eye(4)
    for link, offset, shift in zip(robot.links, robot.offsets, shifts, strict=False):
        out.append(inverse_shift @ link @ elementary("rz", float(offset)) @ shift)
        inverse_shift = inverted(shift)
    return np.stack(out), inverse_shift @ robot.links[-1]


def ur_yaml(source: RobotToWrite) -> str:
    """Return the text of a kinematics file. Raises RobotError unless nominally a Universal Robots arm."""
    robot = source.robot
    described, remainder = ur_segments(source.described)
    turns = np.stack([elementary("rx", roll) for roll in ROLLS])
    reason = "its axes are not arranged like those of a Universal Robots arm in its drawing"
    is_arranged = np.abs(described[:, :3, :3] - turns[:, :3, :3]).max() <= AS_BUILT
    if is_arranged:
        reason = "its flange is not in the frame after joint 6 (a6 or α6 is not 0), which the file cannot express"
    if not is_arranged or np.abs(remainder - np.eye(4)).max() > SMALL:
        reason += "; use another format, such as urdf"
        raise RobotError("unsuited-robot", place=f"robot {robot.name}", reason=reason)
    segments, _ = ur_segments(robot)
    lines = [f"# {line}" for line in source.comment.splitlines()] + ["kinematics:"]
    for name, segment in zip(SEGMENTS, segments, strict=True):
        x, y, z, yaw, pitch, roll = six_of(segment)
        lines.append(f"  {name}:")
        lines += [f"    {key}: {value + 0.0!r}" for key, value in zip(KEYS, (x, y, z, roll, pitch, yaw), strict=True)]
    return "\n".join([*lines, "  hash: truearm", ""])
