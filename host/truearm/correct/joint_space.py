"""Correction in joint space, where the controller takes joint readings (Renders 1991, IV-C)::

    q_i = f_n⁻¹(x_d) + J_n⁻¹·(x_d − x_n) ,    x_n = f_i(f_n⁻¹(x_d))        (34)

J_n is the nominal manipulator's Jacobian, its pseudo-inverse where the robot has other than six joints or only the
position matters. One step leaves an error of second order; it is repeated from q_i.
"""

from __future__ import annotations

import numpy as np

from truearm.correct.inverse import jacobian, scaled
from truearm.correct.model_pair import ModelPair, reached
from truearm.model.poses import apart
from truearm.types import Floats


def joint_space(pair: ModelPair, targets: Floats, q: Floats, oriented: bool = True) -> Floats:
    """One step of (34) for targets (n, 4, 4) from q (n, j), f_n⁻¹(x_d) at first."""
    error = scaled(apart(targets, reached(pair, q)), oriented)
    inverse_jac = np.linalg.pinv(jacobian(pair.chain, pair.nominal, q, oriented))
    return np.asarray(q + (inverse_jac @ error[..., None])[..., 0])
