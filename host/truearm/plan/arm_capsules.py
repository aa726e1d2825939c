"""The links of an arm as capsules, for a robot file that describes none.

The segments run from the foot of the base through the origins of the joints to the end. This describes the arm if its
links are no wider than ``Sizes.link`` and lie on their axes. Most arms are wider, and the upper arm of a Universal
Robots arm lies 135 mm beside the plane of its axes: the files of the built-in arms have capsules of their own.
"""

from __future__ import annotations

import numpy as np

from truearm.model.chain import Chain, forward, joint_frames
from truearm.model.workspace import Capsules
from truearm.types import Floats

SHORT = 0.02  # m; joints with origins closer than this share a segment


def along_joints(chain: Chain, params: Floats, radius: float) -> Capsules:
    """Return capsules from the base's foot through the joints' origins to the end; coinciding origins count once."""
    zero = np.zeros(len(chain.joints))
    frames = [np.eye(4), *joint_frames(chain, params, zero), forward(chain, params, zero)]
    kept = [0]
    for i in range(1, len(frames)):
        if np.linalg.norm((frames[i] - frames[kept[-1]])[:3, 3]) > SHORT:
            kept.append(i)
    # The part between two kept origins moves with the last joint before the second.
    joint = tuple(i - 1 for i in kept[1:])
    ends = [[np.zeros(3), frames[i - 1][:3, :3].T @ (frames[i] - frames[i - 1])[:3, 3]] for i in kept[1:]]
    return Capsules(joint, np.array(ends), np.full(len(joint), radius))
