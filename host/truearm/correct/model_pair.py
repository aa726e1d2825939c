"""What a correction works with: one robot twice, as its controller believes it to be and as it was identified."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from truearm.model.chain import Chain, forward
from truearm.model.mountings import NONE, Mountings
from truearm.model.poses import inverted
from truearm.types import Floats


class ModelPair(NamedTuple):
    """A chain with nominal and identified parameters (p,).

    ``mountings`` that are not the identity are taken out: targets are then poses of the robot's own flange in its own
    base frame. Else they lie between the base and the end frame of the calibration.
    """

    chain: Chain
    nominal: Floats
    identified: Floats
    mountings: Mountings = NONE


def believed(pair: ModelPair, q: Floats) -> Floats:
    """f_n(q), (n, 4, 4): where the controller believes the end to be (Renders 1991, (29))."""
    return forward(pair.chain, pair.nominal, q)


def reached(pair: ModelPair, q: Floats) -> Floats:
    """f_i(q), (n, 4, 4): where the end is (Renders 1991, (30))."""
    there = forward(pair.chain, pair.identified, q)
    return np.asarray(inverted(pair.mountings.base) @ there @ inverted(pair.mountings.tool))


def in_rig(pair: ModelPair, targets: Floats) -> Floats:
    """Targets (n, 4, 4) as poses of the identified chain's own frames."""
    return np.asarray(pair.mountings.base @ targets @ pair.mountings.tool)
