"""Universal Robots' kinematics file (YAML), as used by ``ur_description`` and ``ur_calibration``.

    T(q) = Π U_i · Rz(q_i) ,    U_i = Trans(x, y, z)·Rz(yaw)·Ry(pitch)·Rx(roll)

for shoulder, upper_arm, forearm, wrist_1, wrist_2, wrist_3. The frame after a joint lies on its axis where the path to
the next axis begins (for the design values: where the published file has it). The format begins at the controller's
base and ends at its flange. It cannot store mountings, so they are not written.
"""

from __future__ import annotations

import numpy as np

from truearm.errors import RobotError
from truearm.export.link_frames import LinkFrames, check_gains
from truearm.export.writing import RobotToWrite
from truearm.model.controller_kinematics import KEYS, SEGMENTS
from truearm.model.poses import inverted, six_of
from truearm.model.transforms import elementary
from truearm.types import Floats

ROLLS = (0.0, 0.5 * np.pi, 0.0, 0.0, 0.5 * np.pi, -0.5 * np.pi)  # of the published files


def write(what: RobotToWrite) -> str:
    """Return a kinematics file. Raises RobotError as ``ur_yaml`` does."""
    return ur_yaml(what.robot, what.described, what.comment)


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
    before = np.eye(4)
    for link, offset, shift in zip(robot.links, robot.offsets, shifts, strict=False):
        out.append(before @ link @ elementary("rz", float(offset)) @ shift)
        before = inverted(shift)
    return np.stack(out), before @ robot.links[-1]


def ur_yaml(robot: LinkFrames, nominal: LinkFrames, comment: str = "") -> str:
    """Return the text of a kinematics file. Raises RobotError unless nominally a Universal Robots arm."""
    described, rest = ur_segments(nominal)
    turns = np.stack([elementary("rx", roll) for roll in ROLLS])
    if np.abs(described[:, :3, :3] - turns[:, :3, :3]).max() > 1e-6 or np.abs(rest - np.eye(4)).max() > 1e-6:
        raise RobotError(
            "unsuited-robot",
            place=f"robot {robot.name}",
            reason="its axes are not arranged like those of a Universal Robots arm in its drawing; use another format, such as urdf",
        )
    segments, _ = ur_segments(robot)
    lines = [f"# {line}" for line in comment.splitlines()] + ["kinematics:"]
    for name, segment in zip(SEGMENTS, segments, strict=True):
        x, y, z, yaw, pitch, roll = six_of(segment)
        lines.append(f"  {name}:")
        lines += [f"    {key}: {value + 0.0!r}" for key, value in zip(KEYS, (x, y, z, roll, pitch, yaw), strict=True)]
    return "\n".join([*lines, "  hash: truearm", ""])
