"""What is known of a robot before any measurement (prior), and the quality of an estimate: χ², covariance of the end.

**χ²** is that of the n data alone, over ν = n − tr(H) with the hat matrix H = J(JᵀJ + M)⁻¹Jᵀ, M the prior's
information. Its range holds for every prior that is true or too wide: docs/explanation/estimation.md derives it. The
total cost would depend on the prior's width more than on residuals.

**Cartesian error** (Renders 1991, II-D). A point of the end has the error J Δ, with the covariance

    J Σ Jᵀ , 3 × 3 at each pose.

Σ = diag(tolerance²) gives the paper's analysis before any measurement: where the error is largest (III-G). Σ = P, the
covariance of all free parameters together, gives the same afterwards. Single parameters may be uncertain by metres
along directions that affect no pose.
"""

from __future__ import annotations

from typing import NamedTuple, assert_never

import numpy as np
from scipy import special

from truearm.estimate.solvers import Prior
from truearm.model.chain import Chain, point_jacobians
from truearm.types import Floats
from truearm.units import UNITS

CHUNK = 2048  # poses whose Jacobians (3 × p each) are held at once
LEAST_FREEDOM = 0.5  # of a residual


class Goodness(NamedTuple):
    """The quality of a fit: χ²/ν, ν, and the range of χ²/ν if model, σ and prior are correct."""

    reduced: float
    freedom: float
    band: tuple[float, float]

    @property
    def explained(self) -> bool:
        """Return whether χ² is not above its range; without degrees of freedom, it is not."""
        return not self.reduced > self.band[1]


def prior_shares(covariance_root: Floats, prior_sigma: Floats) -> Floats:
    """Return 1 − h (r,) in each identifiable direction, 0 where the data determine it and 1 where the prior does.

    covariance_root (k, r): S with SSᵀ = (JᵀJ + M)⁻¹, prior_sigma (k,): inf for none.
    """
    return np.asarray(np.linalg.svd(covariance_root / prior_sigma[:, None], compute_uv=False) ** 2)


def goodness(chi2: float, n: int, shares: Floats, probability: float = 0.95) -> Goodness:
    """Return the quality of a fit from χ² of n whitened data.

    ``shares`` (r,) is the share of the prior in the r directions that data or prior determine. All values except the
    degrees of freedom are NaN if there are fewer than LEAST_FREEDOM of these, because any model then fits.
    """

    def total(power: int) -> float:
        return n - shares.size + float((shares**power).sum())

    freedom = max(total(1), 0.0)
    if freedom < LEAST_FREEDOM:
        return Goodness(float("nan"), freedom, (float("nan"), float("nan")))
    tail = (1.0 - probability) / 2.0
    low = _quantile(total(2), total(4), tail) / freedom
    high = _quantile(total(1), total(2), 1.0 - tail) / freedom
    return Goodness(chi2 / freedom, freedom, (low, high))


def _quantile(mean: float, squares: float, probability: float) -> float:
    """Return a quantile of Σwz², z normal, with Σw = mean and Σw² = squares (Satterthwaite)."""
    return float(squares / mean * special.chdtri(mean**2 / squares, 1.0 - probability))


def tolerance_error(chain: Chain, sigma: Floats, q: Floats, p_end_point: Floats) -> Floats:
    """Return the a priori RMS error (n,) [m] of a point of the end at q (n, j), of the nominal robot.

    ``sigma`` (p,) are the tolerances of its parameters, which are independent.
    """
    errors = [np.zeros(0)]
    for first in range(0, len(q), CHUNK):
        _, jac, _ = point_jacobians(chain, chain.params_nominal, q[first : first + CHUNK], p_end_point)
        errors.append(np.linalg.norm(jac * sigma, axis=(1, 2)))
    return np.concatenate(errors)


def covariance_root(covariance: Floats) -> Floats:
    """Return S with S Sᵀ = covariance, which may be singular; negative eigenvalues due to rounding are set to zero."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    divisor = np.where(scale > 0.0, scale, 1.0)
    values, vectors = np.linalg.eigh(covariance / divisor / divisor[:, None])
    return np.asarray(divisor[:, None] * vectors * np.sqrt(np.maximum(values, 0.0)))


def weak_prior(chain: Chain) -> Floats:
    """Return standard deviations (p,) by unit, the accuracy of a drawing: 1 mm, 5 mrad, 1e-3 of a gain.

    A URDF measured by seats needs a prior: its constants are redundant, and the spread of a ball about its socket does
    not determine scale. docs/explanation/estimation.md has the figures.
    """
    return np.array([UNITS[p.unit].weak_sigma for p in chain.parameters])


def wide_prior(chain: Chain) -> Floats:
    """Return standard deviations (p,) by unit, for hand-made mountings.

    They are 10 mm, 3° (Renders 1991, III-C), and 1e-2 of a gain.
    """
    return np.array([UNITS[p.unit].wide_sigma for p in chain.parameters])


def prior_named(chain: Chain, prior: Prior) -> Floats:
    """Return the standard deviations (p,) of a prior; inf for none, and for "where-needed", which the data choose."""
    match prior:
        case Prior.NONE | Prior.WHERE_NEEDED:
            return np.full(len(chain.parameters), np.inf)
        case Prior.WEAK:
            return weak_prior(chain)
        case Prior.WIDE:
            return wide_prior(chain)
        case _:
            assert_never(prior)
