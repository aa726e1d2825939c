"""Correction in joint space, for a controller that accepts joint readings (Renders 1991, IV-C)::

    q_i = f_n⁻¹(x_d) + J_n⁻¹·(x_d − x_n) ,    x_n = f_i(f_n⁻¹(x_d))        (34)

J_n is the Jacobian of the nominal manipulator, or its pseudo-inverse if the robot does not have six joints or only the
position matters. One step leaves an error of second order; it is repeated from q_i.
"""

from __future__ import annotations

import numpy as np

from truearm.correct.inverse import jacobian, scaled
from truearm.correct.model_pair import ModelPair, reached
from truearm.model.poses import apart
from truearm.types import Floats


def joint_space(pair: ModelPair, targets: Floats, q: Floats, oriented: bool = True) -> Floats:
    """Apply one step of (34) for targets (n, 4, 4) from q (n, j), initially f_n⁻¹(x_d)."""
    error = scaled(apart(targets, reached(pair, q)), oriented)
    inverse_jac = np.linalg.pinv(jacobian(pair.chain, pair.nominal, q, oriented))
    return np.asarray(q + (inverse_jac @ error[..., None])[..., 0])
