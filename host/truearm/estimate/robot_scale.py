"""A common scale of the robot's lengths: a wrong length in the rig changes all of them by one ratio.

Joint readings are angles, so every length of an identified robot follows from the lengths that the rig declares: a bar,
the distance of two sockets, the places of chucks. If the only one is wrong by 2 %, the residuals are those of noise and
the robot is 2 % larger than its drawing. Tolerances do not do that, since those of different links are independent.

Test: the changes ΔL of k lengths follow s·L + e, with L the nominal lengths (0 for most offsets of axes) and independent
e of one unknown variance. F = s² ΣL² (k − 1)/Σe² has 1 and k − 1 degrees of freedom if s = 0 (regression through the
origin). Heat also scales a robot, by parts in ten thousand, so the scale must exceed what a drawing tolerates.
"""

from __future__ import annotations

import numpy as np
from scipy import special

from truearm.estimate.frame_choice import mounting
from truearm.model.chain import Chain
from truearm.results import Estimate, RobotScale
from truearm.units import UNITS

LEVEL = 1e-3  # probability that independent tolerances are reported as a scale
LEAST = 3.0  # standard deviations of the scale, by a drawing's tolerance of each length
LEAST_LENGTHS = 4


def robot_scale(chain: Chain, estimate: Estimate) -> RobotScale | None:
    """Return the ratio of the robot's lengths to the nominal ones; None if it is 1 within tolerances and chance.

    Lengths that place base or tool do not count, nor those that the observations determine less well than a drawing.
    """
    p = estimate.n_robot_parameters
    tolerance = UNITS["m"].weak_sigma
    lengths = np.array([parameter.unit == "m" for parameter in chain.parameters])
    lengths &= estimate.free[:p] & (estimate.sigma[:p] < tolerance)
    lengths &= ~mounting(chain, chain.params_nominal).either
    nominal, change = estimate.nominal[:p][lengths], (estimate.value - estimate.nominal)[:p][lengths]
    k, squares = nominal.size, float(nominal @ nominal)
    if k < LEAST_LENGTHS or squares == 0.0:
        return None
    scale = float(nominal @ change) / squares
    if abs(scale) * np.sqrt(squares) < LEAST * tolerance:
        return None
    rest = change - scale * nominal
    variance = float(rest @ rest) / (k - 1)
    chance = float(special.fdtrc(1.0, k - 1.0, scale**2 * squares / max(variance, np.finfo(float).tiny)))
    if chance > LEVEL:
        return None
    return RobotScale(1.0 + scale, float(np.sqrt(variance / squares)), k, chance)
