"""Correction of the joints alone (Renders 1991, IV-C), there of their encoders' zeros::

    q_i = f_n⁻¹(x_d) − Δq                                     (35)

With the joint law θ(q) the controller wants θ_n(q_n), and the reading at which the true joints are there is θ_i⁻¹(θ_n(q_n)). That
is exact where the law is all that is wrong, offsets, gains and whatever else it has; it does nothing for lengths. Where mountings are
taken out of the robot, so are the offsets that belong to them.
"""

from __future__ import annotations

from truearm.correct.model_pair import ModelPair
from truearm.model.mountings import NONE, own_law
from truearm.types import Floats


def offsets(pair: ModelPair, q_nominal: Floats) -> Floats:
    """(n, j) the readings that give the true joint angles which the nominal robot has at q_nominal (n, j); NaN for none."""
    law = pair.chain.law
    taken_out = pair.mountings is not NONE
    identified = own_law(pair.chain, pair.nominal, pair.identified) if taken_out else pair.identified
    return law.readings(identified, law.angles(pair.nominal, q_nominal))
