"""The paper's methods of correction (Renders 1991, IV): one step of each from the joints that a controller uses.

**False targets** (IV-B), for a controller that keeps its nominal model and is given another target. It moves the joints
to q = f_n⁻¹(x_m) and thereby the end to f_i(q). Given the desired target x_d, the end arrives at x_n = f_i(f_n⁻¹(x_d)).
The target is therefore shifted by the opposite of that error:

    x_m = x_d + (x_d − x_n)                                   (32)

One step leaves an error of second order. Since x_m = f_n(q) always holds, it is repeated as x_m ← f_n(q) + (x_d −
f_i(q)). Differences of orientations are rotation vectors in base axes: rotations are composed, not added.

**Joint space** (IV-C), for a controller that accepts joint readings:

    q_i = f_n⁻¹(x_d) + J_n⁻¹·(x_d − x_n)                      (34)

J_n is the Jacobian of the nominal manipulator, or its pseudo-inverse if the robot does not have six joints or only the
position matters. One step leaves an error of second order; it is repeated from q_i.

**Offsets** (IV-C): correction of the joints alone, in the paper by the zeros of their encoders:

    q_i = f_n⁻¹(x_d) − Δq                                     (35)

With the joint law θ(q), the controller aims at θ_n(q_n), and the reading at which the true joints are there is
θ_i⁻¹(θ_n(q_n)). This is exact if only the joint law is wrong, with offsets, gains and any other terms; it does not
correct lengths. If mountings are removed from the robot, so are the offsets that belong to them.
"""

from __future__ import annotations

import numpy as np

from truearm.correct.inverse import inverse, jacobian, scaled
from truearm.correct.model_pair import ModelPair, believed, reached
from truearm.model.poses import apart, moved
from truearm.model.robot_mounting import NONE, own_law
from truearm.types import Floats


def false_target(pair: ModelPair, targets: Floats, q: Floats, oriented: bool = True) -> Floats:
    """Apply one step of (32): return the joint readings (n, j) that the controller uses for the false targets.

    targets : (n, 4, 4) x_d. q : (n, j) where the controller goes for the current targets, initially f_n⁻¹(x_d). NaN
        where the nominal robot does not reach the false target.
    """
    commanded = moved(believed(pair, q), apart(targets, reached(pair, q)))
    solution = inverse(pair.chain, pair.nominal, commanded, q, oriented)
    return np.where(solution.reached[:, None], solution.q, np.nan)


def joint_space(pair: ModelPair, targets: Floats, q: Floats, oriented: bool = True) -> Floats:
    """Apply one step of (34) for targets (n, 4, 4) from q (n, j), initially f_n⁻¹(x_d)."""
    error = scaled(apart(targets, reached(pair, q)), oriented)
    inverse_jac = np.linalg.pinv(jacobian(pair.chain, pair.nominal, q, oriented))
    return np.asarray(q + (inverse_jac @ error[..., None])[..., 0])


def offsets(pair: ModelPair, q_nominal: Floats) -> Floats:
    """Return the readings (n, j) at which the true joint angles are those of the nominal robot at q_nominal (n, j).

    NaN where there are none.
    """
    law = pair.chain.law
    taken_out = pair.mountings is not NONE
    identified = own_law(pair.chain, pair.nominal, pair.identified) if taken_out else pair.identified
    return law.readings(identified, law.angles(pair.nominal, q_nominal))
