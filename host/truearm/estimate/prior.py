"""Priors and free sets for robots that do not define their own.

A ball-bar with the paper's free set needs no prior. A URDF measured by seats does: its constants are redundant, and the
spread of a ball about its socket does not determine scale. The prior is the accuracy of a drawing. Without one, the
solver drifts along hardly identifiable directions and reports max_iterations, while no prediction changes. Encoder
gains stay fixed, because an encoder counts complete turns.

A prior resists errors of several σ. ``wide_prior`` is for robots whose rows include hand-made mountings: 10 mm, and for
angles the 3° of Renders (1991, III-C). docs/explanation/estimation.md has the figures behind both.
"""

from __future__ import annotations

from typing import assert_never

import numpy as np

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


def prior_named(chain: Chain, prior: Prior) -> Floats:
    """Return the standard deviations (p,) of a prior, inf for none; also for one where needed, which depends on the data."""
    match prior:
        case Prior.NONE | Prior.WHERE_NEEDED:
            return np.full(len(chain.parameters), np.inf)
        case Prior.WEAK:
            return weak_prior(chain)
        case Prior.WIDE:
            return wide_prior(chain)
        case _:
            assert_never(prior)
