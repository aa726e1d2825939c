"""A common scale of the robot's lengths: a wrong length in the rig changes all of them by one ratio.

Joint readings are angles, so every length of a robot follows from those of the rig: a bar, the distance of two sockets.
If the only one is wrong by 2 %, the residuals are those of noise and the robot is 2 % larger. Tolerances do not do
that, since those of different links are independent.

The test is an F test of regression through the origin (docs/explanation/estimation.md), over orthonormal combinations
of the lengths. No null direction changes these, and the observations determine them at least as well as a drawing. A
URDF often has lengths of which only sums are identifiable. Heat scales a robot by parts in ten thousand, so the scale
must exceed a drawing's tolerance.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import special

from truearm.estimate.frame_choice import mounting
from truearm.model.chain import Chain
from truearm.results import Estimate, RobotScale, Unusable, weights_of
from truearm.types import Floats, Indices
from truearm.units import UNITS

LEVEL = 1e-3  # probability that independent tolerances are reported as a scale
LEAST = 3.0  # standard deviations of the scale, by a drawing's tolerance of each length
LEAST_LENGTHS = 4  # fewer show too little of their spread: they are compared with DRAWN more, of which each is OFF
DRAWN, OFF = 4.0, 3e-3  # with these, tolerances of 5 mm are a scale with a probability below LEVEL
LARGE = 0.05  # a scale that no item gives a robot by being millimetres off
NO_SHARE = 1e-6  # of a length in a null direction, whose largest share is about 1


def with_scale(chain: Chain, estimate: Estimate) -> Estimate:
    """Return the estimate with its scale, and as not usable if there is one: every position errs in that ratio.

    An item that is some millimetres off also scales a robot by a few parts in a thousand. If there are systematic
    errors, only a scale beyond LARGE is therefore one. They are then dropped as with other wrong inputs: to first order
    about such a fit, items that fix the scale would seem to be off.
    """
    scale = robot_scale(chain, estimate)
    if scale is None or (estimate.faults and abs(scale.factor - 1.0) < LARGE):
        return estimate
    return replace(estimate, scale=scale, faults=(), unusable=Unusable.SCALE)


def robot_scale(chain: Chain, estimate: Estimate) -> RobotScale | None:
    """Return the ratio of the robot's lengths to the nominal ones; None if it is 1 within tolerances and chance.

    Lengths that place base or tool do not count. None also for a fit that is not usable: its lengths say nothing.
    """
    if estimate.unusable or estimate.status != "converged":
        return None
    tolerance = UNITS["m"].weak_sigma
    lengths = _lengths(chain, estimate)
    combined = _determined(estimate, lengths, tolerance)
    nominal = combined.T @ estimate.nominal[lengths]
    change = combined.T @ (estimate.value - estimate.nominal)[lengths]
    k, squares = nominal.size, float(nominal @ nominal)
    if squares == 0.0:
        return None
    scale = float(nominal @ change) / squares
    if abs(scale) * np.sqrt(squares) < LEAST * tolerance:
        return None
    remainder = change - scale * nominal
    drawn = DRAWN if k < LEAST_LENGTHS else 0.0
    freedom = k - 1.0 + drawn
    variance = max((float(remainder @ remainder) + drawn * OFF**2) / freedom, np.finfo(float).tiny)
    chance = float(special.fdtrc(1.0, freedom, scale**2 * squares / variance))
    if chance > LEVEL:
        return None
    return RobotScale(1.0 + scale, float(np.sqrt(variance / squares)), k, chance)


def _lengths(chain: Chain, estimate: Estimate) -> Indices:
    """Return the indices (m,) of the free lengths between the robot's joints."""
    p = estimate.n_robot_parameters
    lengths = np.array([parameter.unit == "m" for parameter in chain.parameters])
    return np.flatnonzero(lengths & estimate.free[:p] & ~mounting(chain, chain.params_nominal).either)


def _determined(estimate: Estimate, lengths: Indices, tolerance: float) -> Floats:
    """Return orthonormal identifiable combinations (m, k) of ``lengths`` (m,), with σ below ``tolerance`` [m]."""
    names = [estimate.parameter_names[i] for i in lengths]
    decomposition = np.linalg.svd(weights_of(estimate.null_space, names))
    identifiable = decomposition.U[:, int((decomposition.S > NO_SHARE).sum()) :]
    variance, turn = np.linalg.eigh(identifiable.T @ estimate.covariance[np.ix_(lengths, lengths)] @ identifiable)
    return np.asarray(identifiable @ turn[:, variance < tolerance**2])
