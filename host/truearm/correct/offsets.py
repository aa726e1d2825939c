"""Correction of the joints alone (Renders 1991, IV-C), in the paper by the zeros of their encoders::

    q_i = f_n⁻¹(x_d) − Δq                                     (35)

With the joint law θ(q), the controller aims at θ_n(q_n), and the reading at which the true joints are there is
θ_i⁻¹(θ_n(q_n)). This is exact if only the joint law is wrong, with offsets, gains and any other terms; it does not
correct lengths. If mountings are removed from the robot, so are the offsets that belong to them.
"""

from __future__ import annotations

from truearm.correct.model_pair import ModelPair
from truearm.model.robot_mounting import NONE, own_law
from truearm.types import Floats


def offsets(pair: ModelPair, q_nominal: Floats) -> Floats:
    """Return the readings (n, j) at which the true joint angles are those of the nominal robot at q_nominal (n, j).

    NaN where there are none.
    """
    law = pair.chain.law
    taken_out = pair.mountings is not NONE
    identified = own_law(pair.chain, pair.nominal, pair.identified) if taken_out else pair.identified
    return law.readings(identified, law.angles(pair.nominal, q_nominal))
