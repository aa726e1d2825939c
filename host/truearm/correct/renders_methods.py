"""The paper's methods of correction (Renders 1991, IV): one step of each from the joints that a controller uses.

**False targets** (IV-B), for a controller that keeps its nominal model. For the target x_d the end arrives at x_n =
f_i(f_n⁻¹(x_d)), so the target is shifted by the opposite:

    x_m = x_d + (x_d − x_n)                                   (32)

Repeated: x_m ← f_n(q) + (x_d − f_i(q)). Orientations are composed.

**Joint space** (IV-C), for a controller that accepts readings, with the nominal Jacobian or its pseudo-inverse:

    q_i = f_n⁻¹(x_d) + J_n⁻¹·(x_d − x_n)                      (34)

One step of either leaves an error of second order.

**Offsets** (IV-C), in the paper by the zeros of encoders:

    q_i = f_n⁻¹(x_d) − Δq                                     (35)

Here it is the reading θ_i⁻¹(θ_n(q_n)) at which the true joints are where the controller aims: exact if only the joint
law is wrong.
"""

from __future__ import annotations

import numpy as np

from truearm.correct.model_pair import ModelPair, believed, reached
from truearm.model.inverse import inverse, jacobian
from truearm.model.poses import apart, moved
from truearm.model.robot_mounting import NONE, own_law
from truearm.types import Floats


def false_target(pair: ModelPair, targets: Floats, q: Floats, oriented: bool = True) -> Floats:
    """Apply one step of (32): return the joint readings (n, j) that the controller uses for the false targets.

    targets : (n, 4, 4) x_d. q : (n, j) where the controller goes for the current targets, initially f_n⁻¹(x_d). NaN
        where the nominal robot does not reach the false target.
    """
    commanded = moved(believed(pair, q), apart(targets, reached(pair, q)))
    return inverse(pair.chain, pair.nominal, commanded, q, oriented)


def joint_space(pair: ModelPair, targets: Floats, q: Floats, oriented: bool = True) -> Floats:
    """Apply one step of (34) for targets (n, 4, 4) from q (n, j), initially f_n⁻¹(x_d)."""
    error = apart(targets, reached(pair, q))[:, : 6 if oriented else 3, None]
    return np.asarray(q + (np.linalg.pinv(jacobian(pair.chain, pair.nominal, q, oriented, lever=1.0)) @ error)[..., 0])


def offsets(pair: ModelPair, q_nominal: Floats) -> Floats:
    """Return the readings (n, j) at which the true joint angles are those of the nominal robot at q_nominal (n, j).

    NaN where there are none.
    """
    law = pair.chain.law
    taken_out = pair.mountings is not NONE
    identified = own_law(pair.chain, pair.nominal, pair.identified) if taken_out else pair.identified
    return law.readings(identified, law.angles(pair.nominal, q_nominal))
