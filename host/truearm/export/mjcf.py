"""A calibrated robot as MuJoCo's MJCF: bodies with a joint each, without shapes; masses and shapes are yours to add."""

from __future__ import annotations

from xml.sax.saxutils import quoteattr

import numpy as np

from truearm.export.link_frames import check_gains, joint_motion
from truearm.export.urdf import link_names
from truearm.export.writing import RobotToWrite
from truearm.model.poses import position_and_rotation
from truearm.types import Floats


def write(source: RobotToWrite) -> str:
    """Return an MJCF. Raises RobotError for gains, which it cannot hold."""
    robot = source.robot
    check_gains(robot, "an MJCF")
    names = link_names(robot)
    motions = [joint_motion(joint, float(x)) for joint, x in zip(robot.joints, robot.offsets, strict=True)]
    origins = [np.eye(4), robot.base, *map(np.matmul, robot.links, [*motions, np.eye(4)]), robot.tool]
    lines = [f"<mujoco model={quoteattr(robot.name)}>"]
    if source.comment:
        lines.append(f"  <!-- {source.comment.replace('--', '- -')} -->")
    lines += ['  <compiler angle="radian" boundmass="0.01" boundinertia="1e-5"/>', "  <worldbody>"]
    for depth, (name, origin) in enumerate(zip(names, origins, strict=True)):
        lines.append(f"{'  ' * (depth + 2)}<body name={quoteattr(name)}{_place(origin)}>")
        if 2 <= depth < 2 + len(robot.joints):
            joint = robot.joints[depth - 2]
            kind = "slide" if joint.kind == "prismatic" else "hinge"
            limited = np.isfinite([joint.lower, joint.upper]).all()
            limit = f' limited="true" range="{joint.lower!r} {joint.upper!r}"' if limited else ""
            lines.append(f'{"  " * (depth + 3)}<joint name={quoteattr(joint.name)} type="{kind}" axis="0 0 1"{limit}/>')
    lines += [f"{'  ' * (depth + 2)}</body>" for depth in reversed(range(len(names)))]
    return "\n".join([*lines, "  </worldbody>", "</mujoco>", ""])


def _place(pose: Floats) -> str:
    """Return the attributes of a body's place."""
    x, y, z, *vector = position_and_rotation(pose[None])[0].tolist()
    angle = float(np.linalg.norm(vector))
    quaternion = [np.cos(0.5 * angle), *(0.5 * np.sinc(0.5 * angle / np.pi) * np.array(vector))]
    numbers = (" ".join(repr(float(value) + 0.0) for value in values) for values in ((x, y, z), quaternion))
    return "".join(f' {key}="{text}"' for key, text in zip(("pos", "quat"), numbers, strict=True))
