"""Priors and free sets for robots that come without them.

A ball-bar with the paper's free set needs no prior: everything free is seen. A URDF robot measured by seats does, for
two reasons. Its six constants a joint are redundant. And the spread of a ball about its socket is blind to scale: a
robot shrunk by a tenth spreads a tenth less. Held-out spreads do not warn of that either, they shrink alike (on real
data, with 10 mm on lengths and no known distance between sockets, the arm shrank by 20 % and "improved" by 10 %). So
the prior says what every maker's drawing says, that lengths are right to a millimetre and angles to some milliradians;
a known distance between two sockets says it better. Without a prior the solver creeps along what is hardly seen, and
says so (max_iterations), while the predictions stand still. Encoder gains stay fixed: an encoder counts whole turns.

A prior holds what it says against the data: an error of several σ is taken for noise in part, and the rest is bent to
fit. A robot file holds what is redundant and its rows contain the mountings of base and tool, which are off by what a
hand leaves. Goswami's PUMA strays from its design by up to 13 mm and 56 mrad, 12 σ of the weak prior, which moves
parameters from the truth by up to 1.2 σ of 200 lengths without noise. ``wide_prior`` is for these: 10 mm, and of angles
the 3° that Renders (1991, III-C) grants a hand and a lathe. Under it the same PUMA is found to 0.02 σ and the lengths to
0.1 µm, and what the data hardly see still does not wander.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import assert_never

import numpy as np
from numpy.typing import NDArray

from truearm.errors import ProblemError
from truearm.estimate.solvers import Prior
from truearm.model.chain import Chain
from truearm.model.joint_terms.gain import Gain
from truearm.types import Floats
from truearm.units import UNITS


def weak_prior(chain: Chain) -> Floats:
    """(p,) standard deviations by unit: 1 mm, 5 mrad, 1e-3 of a gain."""
    return np.array([UNITS[p.unit].weak_sigma for p in chain.parameters])


def wide_prior(chain: Chain) -> Floats:
    """(p,) standard deviations by unit: 10 mm, 52 mrad, 1e-2 of a gain."""
    return np.array([UNITS[p.unit].wide_sigma for p in chain.parameters])


def prior_named(chain: Chain, prior: Prior) -> Floats | None:
    """(p,) standard deviations of a prior, None for none and for the default one, which follows from the data."""
    match prior:
        case Prior.NONE | Prior.DEFAULT:
            return None
        case Prior.WEAK:
            return weak_prior(chain)
        case Prior.WIDE:
            return wide_prior(chain)
        case _:
            assert_never(prior)


def free_without_gains(chain: Chain) -> NDArray[np.bool_]:
    """(p,) True for all but joint gains: encoders count whole turns of the joint, their gain is 1."""
    return np.array([p.term != Gain.name for p in chain.parameters])


def robot_prior(chain: Chain, prior_sigma: Mapping[str, float] | Floats | None) -> Floats:
    """(p,) standard deviations, inf for none. Raises ProblemError for unknown names or values that are not positive."""
    n = len(chain.parameters)
    if prior_sigma is None:
        return np.full(n, np.inf)
    if isinstance(prior_sigma, Mapping):
        unknown = sorted(set(prior_sigma) - set(chain.parameter_names))
        if unknown:
            raise ProblemError(f"prior for {unknown[0]!r}, which robot {chain.name} does not have")
        out = np.array([prior_sigma.get(name, np.inf) for name in chain.parameter_names], dtype=float)
    else:
        out = np.asarray(prior_sigma, dtype=float)
    if out.shape != (n,) or not (out > 0.0).all():
        raise ProblemError(
            f"prior σ must be {n} positive numbers, inf for no prior; to hold a parameter do not free it"
        )
    return out
