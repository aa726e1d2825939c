"""Priors and free sets for robots that do not define their own.

A ball-bar with the paper's free set needs no prior. A URDF measured by seats does: its constants are redundant, and the
spread of a ball about its socket does not determine scale. The prior is the accuracy of a drawing. Without one, the
solver drifts along hardly identifiable directions and reports max_iterations, while no prediction changes. Encoder
gains stay fixed, because an encoder counts complete turns.

A prior resists errors of several σ. ``wide_prior`` is for robots whose rows include hand-made mountings: 10 mm, and for
angles the 3° of Renders (1991, III-C). docs/explanation/estimation.md has the figures behind both.
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
