"""The links of an arm whose robot file describes none, as capsules.

The segments run from the base's foot through the joints' origins to the end. That is where the arm is if its links are no
wider than ``Sizes.link`` and stand over their axes. A PUMA 560's do, by the chain of Goswami 1993 (the shoulder's 180 mm are
in it). A Universal Robots' upper arm stands 135 mm beside its axes' plane, so its file has capsules of its own.
"""

from __future__ import annotations

import numpy as np

from truearm.model.chain import Chain, forward, joint_frames
from truearm.model.workspace import Capsules
from truearm.types import Floats

SHORT = 0.02  # m; joints whose origins are nearer than this share a segment


def along_joints(chain: Chain, params: Floats, radius: float) -> Capsules:
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
    return Capsules(joint, np.array(ends), np.full(len(joint), radius))
