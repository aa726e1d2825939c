"""How far base and tool stand, after a fit, from where robot file and rig describe them.

Chucks, spheres and sockets that are all wrong by one motion leave no residual: base or tool move with them, and the tool
errs by that motion. So does a single wrong item along directions that no row sees. A base or tool beyond a drawing's
tolerance is therefore reported. On nearly every real robot nobody measured its place: then this is a note, and no fault.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from truearm.estimate.frame_choice import mounting
from truearm.model.chain import Chain, forward, joint_frames
from truearm.model.poses import inverted
from truearm.model.rotation import rotation_vector
from truearm.results import Estimate
from truearm.types import Floats
from truearm.units import UNITS

SURELY = 6.0  # standard deviations


class Displaced(NamedTuple):
    """A frame, "base" or "tool", and how far its origin [m] and its axes [rad] are from where they are described.

    The origin of the base is that of the first joint.
    """

    frame: str
    distance: float
    turn: float


def displaced_mounts(chain: Chain, estimate: Estimate) -> tuple[Displaced, ...]:
    """Return base and tool if they are farther from their described poses than a drawing tolerates, beyond doubt.

    ``chain`` is the robot of the estimate. Empty for a fit that did not converge or is not usable.
    """
    if estimate.unusable or estimate.status != "converged":
        return ()
    nominal, value = (of[: estimate.n_robot_parameters] for of in (estimate.nominal, estimate.value))
    mounted = mounting(chain, nominal)
    sure = np.abs(value - nominal) > SURELY * np.nan_to_num(estimate.sigma[: value.size], nan=np.inf)
    q = np.zeros((1, len(chain.joints)))
    before = forward(chain, nominal, q)[0]
    found = []
    for name, mine in (("base", mounted.base), ("tool", mounted.tool & ~mounted.base)):
        if not (sure & mine).any():
            continue
        params = np.where(mine, value, nominal)
        after = forward(chain, params, q)[0]
        if name == "base":  # at the first joint: a turn alone leaves it where it is
            stood, stands = (joint_frames(chain, of, q)[0, 0, :3, 3] for of in (nominal, params))
            one = Displaced(name, float(np.linalg.norm(stands - stood)), _turn(after @ inverted(before)))
        else:
            motion = inverted(before) @ after
            one = Displaced(name, float(np.linalg.norm(motion[:3, 3])), _turn(motion))
        if one.distance > UNITS["m"].weak_sigma or one.turn > UNITS["rad"].weak_sigma:
            found.append(one)
    return tuple(found)


def _turn(pose: Floats) -> float:
    return float(np.linalg.norm(rotation_vector(pose[:3, :3])))
