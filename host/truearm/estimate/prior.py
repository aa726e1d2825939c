"""Priors and free sets for robots that come without them.

A ball-bar with the paper's free set needs no prior: everything free is seen. A URDF robot measured by seats does: its
six constants a joint are redundant, and the points where a ball can sit cover little of the workspace. The weak prior
says only what every maker's drawing says, that lengths are right to a millimetre and angles to some milliradians, and
lets the observations decide wherever they say more.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from truearm.model.chain import Chain
from truearm.types import Floats

WEAK_SIGMA = {"m": 1e-3, "rad": 5e-3, "1": 1e-3}


def weak_prior(chain: Chain) -> Floats:
    """(p,) standard deviations by unit: 1 mm, 5 mrad, 1e-3 of a gain."""
    return np.array([WEAK_SIGMA[p.unit] for p in chain.parameters])


def free_without_gains(chain: Chain) -> NDArray[np.bool_]:
    """(p,) True for all but joint gains: encoders count whole turns of the joint, their gain is 1."""
    return np.array([p.unit != "1" for p in chain.parameters])
