"""The models of a correction: the same robot with the controller's parameters and with the identified ones."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from truearm.model.chain import Chain, forward
from truearm.model.poses import inverted
from truearm.model.robot_mounting import NONE, Mountings
from truearm.types import Floats


class ModelPair(NamedTuple):
    """A chain with nominal and identified parameters (p,).

    ``mountings`` other than the identity are removed: targets are then poses of the robot's own flange in its own base
    frame. Otherwise they are poses of the calibration's end frame in its base frame.
    """

    chain: Chain
    nominal: Floats
    identified: Floats
    mountings: Mountings = NONE


def believed(pair: ModelPair, q: Floats) -> Floats:
    """Return f_n(q), (n, 4, 4): the pose of the end in the controller's model (Renders 1991, (29))."""
    return forward(pair.chain, pair.nominal, q)


def reached(pair: ModelPair, q: Floats) -> Floats:
    """Return f_i(q), (n, 4, 4): the actual pose of the end (Renders 1991, (30))."""
    pose = forward(pair.chain, pair.identified, q)
    return np.asarray(inverted(pair.mountings.base) @ pose @ inverted(pair.mountings.tool))


def in_rig(pair: ModelPair, targets: Floats) -> Floats:
    """Return targets (n, 4, 4) as poses in the identified chain's own frames."""
    return np.asarray(pair.mountings.base @ targets @ pair.mountings.tool)
