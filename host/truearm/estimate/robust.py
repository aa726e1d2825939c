"""Robust losses: rows that disagree with all others lose weight instead of distorting the result.

An observation with w whitened residuals r has the norm s = ‖r‖. The cost is Σρ(s) with

    linear ρ = s² ,   Huber ρ = s² up to c, 2cs − c² beyond ,   Cauchy ρ = c² ln(1 + s²/c²) .

Weighting the rows by √(ρ'/2s) makes each step of lm or map a step of iteratively reweighted least squares. Since ρ is
concave in s², a step that reduces the weighted problem reduces the cost. c costs 5 % of efficiency on clean data
(Holland and Welsch 1977).

(JᵀWJ)⁻¹ is not the covariance of such an estimate; docs/explanation/estimation.md has that of Huber (1981, 7.6). The
cost has several minima: Huber starts at the result of least squares, Cauchy at that of Huber.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple, assert_never

import numpy as np
from scipy import special

from truearm.estimate.information import covariance, fold, spectrum
from truearm.estimate.solvers import Loss
from truearm.types import Floats

HUBER, CAUCHY = 1.345, 2.385  # c of one residual
QUANTILES = 20_000  # of a mean over χ; of the mean of s², 1e-4 is beyond the last of them
STAGES = (Loss.LINEAR, Loss.HUBER, Loss.CAUCHY)  # of a fit; the last is the requested loss


class Weighted(NamedTuple):
    """A loss at norms s: its values, weights w(s) and slopes s·w'(s), all (n,)."""

    cost: Floats
    weight: Floats
    slope: Floats


def stages(loss: Loss) -> tuple[Loss, ...]:
    """Return the losses of a fit's stages, with ``loss`` the last."""
    return STAGES[: STAGES.index(loss) + 1]


def weigh(loss: Loss, length: Floats, width: int) -> Weighted:
    """Return the loss of n observations with ``width`` whitened residuals, from their norms s (n,)."""
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
    """Return c for observations with ``width`` residuals.

    It is the quantile of χ_width that ``of_one`` (HUBER, CAUCHY) is of χ_1.
    """
    inside = special.gammainc(0.5, of_one**2 / 2.0)
    return float(np.sqrt(2.0 * special.gammaincinv(width / 2.0, inside)))


@cache
def clean_square(loss: Loss, width: int) -> float:
    """Return the mean of w(s)·s² of clean observations with ``width`` residuals, ``width`` for the linear loss.

    Divided by it, the weighted sum of squares estimates the variance of the noise without being ruled by outliers.
    """
    share = (np.arange(QUANTILES) + 0.5) / QUANTILES
    length = np.sqrt(special.chdtri(width, share))
    return float(np.mean(weigh(loss, length, width).weight * length**2))


class Moments(NamedTuple):
    """Sums over observations for the covariance: of a, the derivative's square, b and the weights, and their number."""

    a: float = 0.0
    square: float = 0.0
    b: float = 0.0
    weight: float = 0.0
    n: int = 0

    def plus(self, weighted: Weighted, length: Floats, width: int) -> Moments:
        return Moments(
            self.a + float((weighted.weight + weighted.slope / width).sum()),
            self.square
            + float((weighted.weight**2 + (2.0 * weighted.weight + weighted.slope) * weighted.slope / width).sum()),
            self.b + float(((weighted.weight * length) ** 2).sum()) / width,
            self.weight + float(weighted.weight.sum()),
            self.n + length.size,
        )


def sandwich(data_root: Floats, prior_sigma: Floats, moments: Moments, n_scalar: int) -> Floats:
    """Return the covariance A⁻¹BA⁻¹ (k, k) of a robust estimate, zero along null directions.

    ``data_root`` (k, k) is the unweighted root of the observations, ``prior_sigma`` (k,) inf for none, ``n_scalar`` the
    number of scalar residuals.
    """
    k = prior_sigma.size
    # If most rows lie beyond c, as with a wrong rig, the mean curvature of cauchy is negative and meaningless. With the
    # mean weight instead, the result is (JᵀJ)⁻¹ times the square of the residuals, as for least squares.
    a, varies = moments.weight / moments.n, 0.0
    if moments.a > 0.0:
        a = moments.a / moments.n
        varies = moments.square / moments.n / a**2 - 1.0
    b = moments.b / moments.n * n_scalar / max(n_scalar - k, 1) * (1.0 + varies * k / n_scalar) ** 2
    prior = np.diag(np.where(np.isfinite(prior_sigma), 1.0 / prior_sigma, 0.0))
    inverse = covariance(spectrum(fold(np.sqrt(a) * data_root, prior)))
    half = fold(np.sqrt(b) * data_root, prior) @ inverse
    return np.asarray(half.T @ half)
