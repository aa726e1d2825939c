"""Arms as capsules: what lies within a radius of a segment that moves with a joint.

For an arm without a table of its own the segments run from the base's foot through the joints' origins to the end, which is
where the arm itself is if its links are no wider than ``Sizes.link`` and stand over their axes. A PUMA 560's do, by the chain of
Goswami 1993 (the shoulder's 180 mm are in it). A Universal Robots' upper arm stands 135 mm beside its axes' plane.

The tables hold all of the makers' collision meshes but for 1 mm, radii rounded up to 5 mm:

- ur5e: UniversalRobots/Universal_Robots_ROS2_Description, meshes/ur5e/collision, placed as urdf/ur_macro.xacro does
  (shoulder_offset 138 mm, elbow_offset 7 mm);
- irb120: ros-industrial/abb_experimental, abb_irb120_support/meshes/irb120_3_58/collision, which are convex hulls.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from truearm.model.chain import Chain, forward, joint_frames
from truearm.types import Floats

SHORT = 0.02  # m; joints whose origins are nearer than this share a segment


class Body(NamedTuple):
    """Capsules (m): the joint that each moves with (0: none, it is fixed), its ends (m, 2, 3) in that joint's frame after its
    motion (0: the base frame) [m], and its radius (m,) [m]."""

    joint: tuple[int, ...]
    ends: Floats
    radius: Floats


def _body(*capsules: tuple[int, tuple[float, float, float], tuple[float, float, float], float]) -> Body:
    """Of joint, ends and radius of each, in mm."""
    joint, start, end, radius = zip(*capsules, strict=True)
    return Body(joint, 1e-3 * np.array([start, end]).swapaxes(0, 1), 1e-3 * np.array(radius))


BODIES = {
    "ur5e": _body(
        (0, (0, 0, 0), (0, 0, 80), 80),
        (1, (0, -5, 155), (0, -10, 170), 90),
        (2, (0, 0, 135), (-425, 0, 135), 95),
        (3, (0, 0, 25), (-395, 0, 10), 70),
        (4, (0, 0, 110), (0, 0, 135), 65),
        (5, (0, -10, 97), (0, 10, 97), 60),
        (6, (0, 0, 70), (0, 0, 75), 45),
    ),
    "irb120": _body(
        (0, (-100, 0, 50), (0, 0, 60), 150),
        (1, (0, 0, 190), (0, 15, 270), 125),
        (2, (-25, 0, 0), (240, 0, 0), 135),
        (3, (55, 65, 0), (45, -20, 0), 115),
        (4, (0, 0, 165), (0, 0, 300), 80),
        (5, (0, -30, 0), (0, 30, 0), 60),
        (6, (0, 0, 60), (0, 0, 72), 25),
    ),
}


def body_of(chain: Chain, params: Floats, radius: float) -> Body:
    """The capsules of an arm by its name, or along its joints with one radius [m]."""
    if chain.name in BODIES:
        return BODIES[chain.name]
    return along_joints(chain, params, radius)


def along_joints(chain: Chain, params: Floats, radius: float) -> Body:
    """From the foot of the base through the joints' origins to the end; joints whose origins coincide count once."""
    zero = np.zeros(len(chain.joints))
    frames = [np.eye(4), *joint_frames(chain, params, zero), forward(chain, params, zero)]
    kept = [0]
    for i in range(1, len(frames)):
        if np.linalg.norm((frames[i] - frames[kept[-1]])[:3, 3]) > SHORT:
            kept.append(i)
    # What lies between two kept origins moves with the last joint before the second.
    joint = tuple(i - 1 for i in kept[1:])
    ends = [[np.zeros(3), frames[i - 1][:3, :3].T @ (frames[i] - frames[i - 1])[:3, 3]] for i in kept[1:]]
    return Body(joint, np.array(ends), np.full(len(joint), radius))
