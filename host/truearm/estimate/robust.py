"""Robust losses: rows that disagree with all others lose their weight instead of bending the result.

An observation of w whitened residuals r has the length s = ‖r‖, which is χ_w if it is clean. The cost is Σρ(s) with

    linear ρ = s² ,   Huber ρ = s² up to c, 2cs − c² beyond ,   Cauchy ρ = c² ln(1 + s²/c²) .

The gradient of ρ is 2·w(s)·r with w = ρ'/2s, so weighting the rows by √w in the square-root information makes every step
of lm or map one of iteratively reweighted least squares; ρ is concave in s², so the weighted problem lies above the cost
and touches it: what reduces one reduces the other. c is 1.345 (Huber) or 2.385 (Cauchy) for w = 1, which costs 5 % of
efficiency on clean data (Holland and Welsch 1977), and the same quantile of χ_w for wider observations.

**Covariance.** (JᵀWJ)⁻¹ is not the covariance of such an estimate, though it is often printed as such. For M-estimates of
symmetric errors (Huber 1981, 7.6), with ψ(r) = w(s)·r and the averages over observations

    b = ‖ψ‖²/w , corrected by n/(n − k) ,   a = w + w'(s)·s/w  (the mean diagonal of ∂ψ/∂r),

it is A⁻¹BA⁻¹ with A = a·JᵀJ + M, B = b·JᵀJ + M, M the information of the prior, which is no datum and keeps its weight.
With a = b = 1 this is the covariance of least squares.

The robust cost has several minima: the fit starts where least squares ended, Cauchy where Huber ended.
"""

from __future__ import annotations

from typing import NamedTuple, assert_never

import numpy as np
from scipy import special

from truearm.estimate.information import covariance, fold, spectrum
from truearm.estimate.solvers import Loss
from truearm.types import Floats

HUBER, CAUCHY = 1.345, 2.385  # c of one residual
STAGES = (Loss.LINEAR, Loss.HUBER, Loss.CAUCHY)  # of a fit; the last is the loss that was asked for


class Weighted(NamedTuple):
    """A loss at lengths s: its values, weights w(s) and slopes s·w'(s), all (n,)."""

    cost: Floats
    weight: Floats
    slope: Floats


def stages(loss: Loss) -> tuple[Loss, ...]:
    """The losses of a fit's stages, ``loss`` the last."""
    return STAGES[: STAGES.index(loss) + 1]


def weigh(loss: Loss, length: Floats, width: int) -> Weighted:
    """The loss of n observations of ``width`` whitened residuals, from their lengths s (n,)."""
    match loss:
        case Loss.LINEAR:
            return Weighted(length**2, np.ones_like(length), np.zeros_like(length))
        case Loss.HUBER:
            c = tuning(HUBER, width)
            weight = c / np.maximum(length, c)
            inside = length <= c
            cost = np.where(inside, length**2, 2.0 * c * length - c**2)
            return Weighted(cost, weight, np.where(inside, 0.0, -weight))
        case Loss.CAUCHY:
            c = tuning(CAUCHY, width)
            ratio = (length / c) ** 2
            weight = 1.0 / (1.0 + ratio)
            return Weighted(c**2 * np.log1p(ratio), weight, -2.0 * ratio * weight**2)
        case _:
            assert_never(loss)


def tuning(of_one: float, width: int) -> float:
    """c for observations of ``width`` residuals: the quantile of χ_width that ``of_one``, HUBER or CAUCHY, is of χ_1."""
    inside = special.gammainc(0.5, of_one**2 / 2.0)
    return float(np.sqrt(2.0 * special.gammaincinv(width / 2.0, inside)))


class Moments(NamedTuple):
    """Sums over observations for the covariance: of a, of b, of the weights, and their number."""

    a: float = 0.0
    b: float = 0.0
    weight: float = 0.0
    n: int = 0

    def plus(self, seen: Weighted, length: Floats, width: int) -> Moments:
        return Moments(
            self.a + float((seen.weight + seen.slope / width).sum()),
            self.b + float(((seen.weight * length) ** 2).sum()) / width,
            self.weight + float(seen.weight.sum()),
            self.n + length.size,
        )


def sandwich(data_root: Floats, prior_sigma: Floats, moments: Moments, n_scalar: int) -> Floats:
    """(k, k) covariance A⁻¹BA⁻¹ of a robust estimate, zero along what is not seen.

    ``data_root`` (k, k) is the unweighted root of the observations, ``prior_sigma`` (k,) inf for none, ``n_scalar`` the
    number of scalar residuals.
    """
    k = prior_sigma.size
    # Where most rows lie beyond c, as with a wrong rig, the mean curvature of cauchy is negative and says nothing. With the
    # mean weight in its place the result is (JᵀJ)⁻¹ times the square of the residuals, as least squares has it.
    a = (moments.a if moments.a > 0.0 else moments.weight) / moments.n
    b = moments.b / moments.n * n_scalar / max(n_scalar - k, 1)
    prior = np.diag(np.where(np.isfinite(prior_sigma), 1.0 / prior_sigma, 0.0))
    inverse = covariance(spectrum(fold(np.sqrt(a) * data_root, prior)))
    half = fold(np.sqrt(b) * data_root, prior) @ inverse
    return np.asarray(half.T @ half)
