"""What a covariance of the parameters means: for χ², for single rows, and for where the robot's end really is.

**Cartesian error** (Renders 1991, II-D). To first order a point of the end errs by J Δ, so with the parameters'
covariance Σ the error has covariance J Σ Jᵀ, 3 × 3 at each pose. Σ = diag(tolerance²) gives the a priori analysis of the
paper: how large the error will be before anything was measured, where it is largest (points worth measuring: III-G), and
in which direction of motion it is smallest. Σ = P gives the same a posteriori. P must be that of all free parameters
together: the parameters alone may be uncertain by metres along directions that no pose shows.

**Leverage.** The residual of a row that took part in the fit is smaller than its error, e = (I − H)·ν, because the fit
followed it. Standardised residuals divide that out, so that each is χ of its width if the model is right.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import special

from truearm.errors import ProblemError
from truearm.model.chain import Chain, point_jacobians
from truearm.types import Floats

CHUNK = 2048  # poses whose Jacobians (3 × p each) are held at once


class CartesianError(NamedTuple):
    """The error of a point of the end over n poses; the standard deviations are along the principal axes."""

    covariance: Floats  # (n, 3, 3) m², base frame
    rms: Floats  # (n,) m, expected norm in the root mean square: sqrt(trace)
    sigma_smallest: Floats  # (n,) m
    direction_smallest: Floats  # (n, 3) unit vectors of the base frame, in which the error is smallest
    sigma_largest: Floats  # (n,) m
    direction_largest: Floats  # (n, 3)

    @property
    def worst(self) -> int:
        """Index of the pose with the largest expected error."""
        return int(np.argmax(self.rms))


def chi2_band(freedom: int, probability: float = 0.95) -> tuple[float, float]:
    """Where χ²/freedom lies with ``probability`` if model and σ are right; NaN without freedom."""
    if freedom < 1:
        return float("nan"), float("nan")
    tail = (1.0 - probability) / 2.0
    low, high = special.chdtri(freedom, [1.0 - tail, tail]) / freedom
    return float(low), float(high)


def predicted_error(chain: Chain, params: Floats, covariance: Floats, q: Floats, p_end_point: Floats) -> CartesianError:
    """Error of a point of the end, from the covariance (p, p) of the robot's parameters, at params (p,) and q (n, j).

    Raises ProblemError for a covariance of another shape or with entries that are not finite, and for no poses.
    """
    p = len(chain.parameters)
    covariance, q = np.asarray(covariance, dtype=float), np.atleast_2d(np.asarray(q, dtype=float))
    if covariance.shape != (p, p) or not np.isfinite(covariance).all():
        raise ProblemError(f"the covariance must be {p} × {p} finite numbers, is of shape {covariance.shape}")
    if len(q) == 0:
        raise ProblemError("no poses to predict the error at; give at least one row of joint readings")
    root = _root(covariance)
    parts = []
    for at in range(0, len(q), CHUNK):
        _, jac, _ = point_jacobians(chain, params, q[at : at + CHUNK], p_end_point)
        half = jac @ root
        parts.append(half @ half.swapaxes(1, 2))
    matrix = np.concatenate(parts)
    variance, axes = np.linalg.eigh(matrix)
    sigma = np.sqrt(np.maximum(variance, 0.0))
    return CartesianError(
        matrix,
        np.sqrt(np.trace(matrix, axis1=1, axis2=2)),
        sigma[:, 0],
        axes[:, :, 0],
        sigma[:, 2],
        axes[:, :, 2],
    )


def tolerance_error(chain: Chain, sigma: Floats, q: Floats, p_end_point: Floats) -> CartesianError:
    """A priori: the error that tolerances σ (p,) of independent parameters make at the nominal robot.

    Raises ProblemError for σ of another shape, negative or not finite.
    """
    sigma = np.asarray(sigma, dtype=float)
    if sigma.shape != (len(chain.parameters),) or not (np.isfinite(sigma).all() and (sigma >= 0.0).all()):
        raise ProblemError(f"tolerances must be {len(chain.parameters)} finite numbers ≥ 0, in m, rad and 1")
    return predicted_error(chain, chain.params_nominal, np.diag(sigma**2), q, p_end_point)


def _root(covariance: Floats) -> Floats:
    """S with S Sᵀ = covariance, which may be singular; rounding below zero is cut."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    divisor = np.where(scale > 0.0, scale, 1.0)
    values, vectors = np.linalg.eigh(covariance / divisor / divisor[:, None])
    return np.asarray(divisor[:, None] * vectors * np.sqrt(np.maximum(values, 0.0)))
