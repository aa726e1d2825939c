"""Priors and free sets for robots that do not define their own.

A ball-bar with the paper's free set needs no prior, because everything free is identifiable. A URDF robot measured by
seats does, for two reasons. First, its six constants per joint are redundant. Second, the spread of a ball about its
socket does not determine scale: a robot shrunk by a tenth has a tenth less spread. Held-out spreads do not reveal this
either, since they shrink equally (on real data, with 10 mm on lengths and no known distance between sockets, the arm
shrank by 20 % and "improved" by 10 %). The prior therefore states the accuracy of any manufacturer's drawing: lengths
are correct to a millimetre and angles to a few milliradians. A known distance between two sockets is better. Without a
prior the solver drifts along hardly identifiable directions and reports max_iterations, while the predictions do not
change. Encoder gains stay fixed, because an encoder counts complete turns.

A prior resists the data: an error of several σ is partly taken for noise, and the other parameters are distorted to
fit. A robot file fixes what is redundant, and its rows include the mountings of base and tool, which have the
tolerances of manual mounting. Goswami's PUMA differs from its design by up to 13 mm and 56 mrad, 12 σ of the weak
prior, which moves parameters from their true values by up to 1.2 σ of 200 lengths without noise. ``wide_prior`` is for
these cases: 10 mm, and for angles the 3° that Renders (1991, III-C) allows for manual mounting and machining. Under it
the same PUMA is identified to 0.02 σ and the lengths to 0.1 µm, and hardly identifiable directions still do not drift.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import assert_never

import numpy as np

from truearm.errors import ProblemError
from truearm.estimate.solvers import Prior
from truearm.model.chain import Chain
from truearm.types import Floats
from truearm.units import UNITS


def weak_prior(chain: Chain) -> Floats:
    """Return standard deviations (p,) by unit: 1 mm, 5 mrad, 1e-3 of a gain."""
    return np.array([UNITS[p.unit].weak_sigma for p in chain.parameters])


def wide_prior(chain: Chain) -> Floats:
    """Return standard deviations (p,) by unit: 10 mm, 52 mrad, 1e-2 of a gain."""
    return np.array([UNITS[p.unit].wide_sigma for p in chain.parameters])


def prior_named(chain: Chain, prior: Prior) -> Floats | None:
    """Return the standard deviations (p,) of a prior; None for no prior and for one where needed, which depends on the data."""
    match prior:
        case Prior.NONE | Prior.WHERE_NEEDED:
            return None
        case Prior.WEAK:
            return weak_prior(chain)
        case Prior.WIDE:
            return wide_prior(chain)
        case _:
            assert_never(prior)


def robot_prior(chain: Chain, prior_sigma: Mapping[str, float] | Floats | None) -> Floats:
    """Return standard deviations (p,), inf for none. Raises ProblemError for unknown names or values that are not positive."""
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
            f"prior σ must be {n} positive numbers, inf for no prior; to hold a parameter fixed, do not free it"
        )
    return out
