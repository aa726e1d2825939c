"""Calibrate a sensor against a reference: fit the polynomial that converts its reading x to a position y.

At each of n positions, the reference gives y_i and the sensor x_i, a mean over seconds with little noise. The fit uses
Legendre polynomials over the readings' span, whose columns A = QR are nearly orthogonal.

**Choosing the order.** A higher order leaves smaller residuals e. Left out, point i is predicted with the error

    e_i / (1 − h_i) ,   h the diagonal of QQᵀ

(Allen, Technometrics 16, 1974, 125, eq. 3.2; PRESS). The mean square of these errors is uncertain by some tens of
percent. The lowest order within one standard error of the best one is chosen (Breiman and others, 1984, §3.4.3). It is
the true order in 76 to 93 % of simulated cases; the least mean square alone finds it in 61 to 76 %
(tests/host/test_gauge_polynomial.py).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import Legendre, Polynomial
from numpy.polynomial.legendre import legvander

from truearm.types import Floats, rms
from truearm.units import INCH, NS, US

MAX_ORDER = 7
SPARE = 2  # more points than coefficients by this many, so that σ is meaningful
TICK_S = 8e-9


@dataclass(frozen=True)
class PolyFit:
    """A polynomial y = Σ poly[k] x^k through n points, in the reference's unit.

    ``residual`` (n,): reference − polynomial. ``deleted_residual`` (n,): each residual if its point had not been used.
    ``sigma``: √(Σ residual² / degrees of freedom).
    """

    order: int
    poly: Floats
    residual: Floats
    deleted_residual: Floats
    sigma: float

    @property
    def press(self) -> float:
        return rms(self.deleted_residual)


def distinct_places(x: Floats) -> int:
    """Return the number of distinct positions in readings x (n,).

    Readings closer than a thousandth of the span count as one: a position visited in both directions is not two.
    """
    span = float(np.ptp(x)) if x.size else 0.0
    return 1 + int(np.count_nonzero(np.diff(np.sort(x)) > 1e-3 * span)) if span > 0.0 else min(x.size, 1)


def possible_orders(x: Floats, highest: int = MAX_ORDER) -> range:
    """Return the orders allowed by readings x (n,): SPARE points more than coefficients, fewer powers than positions."""
    return range(1, min(highest, x.size - 1 - SPARE, distinct_places(x) - 2) + 1)


def fit(x: Floats, y: Floats, order: int) -> PolyFit:
    """Fit the least-squares polynomial of one of the ``possible_orders``."""
    series = Legendre.fit(x, y, order)
    offset, scale = series.mapparms()
    q, _ = np.linalg.qr(legvander(offset + scale * x, order))
    residual = y - q @ (q.T @ y)
    sigma = math.sqrt(float(residual @ residual) / (y.size - order - 1))
    poly = np.asarray(series.convert(kind=Polynomial).coef, np.float64)
    return PolyFit(order, poly, residual, residual / (1.0 - np.sum(q**2, axis=1)), sigma)


def fits(x: Floats, y: Floats, highest: int = MAX_ORDER) -> list[PolyFit]:
    """Return the fits of all possible orders, lowest first; [] if there are too few points."""
    return [fit(x, y, order) for order in possible_orders(x, highest)]


def chosen(candidates: Sequence[PolyFit]) -> PolyFit:
    """Return the lowest order that predicts left-out points as well as the best one does, within one standard error."""
    best = min(candidates, key=lambda candidate: candidate.press)
    squares = best.deleted_residual**2
    bound = np.mean(squares) + np.std(squares, ddof=1) / math.sqrt(squares.size)
    return next(candidate for candidate in candidates if candidate.press**2 <= bound)


def head_of(line: PolyFit) -> tuple[float, float]:
    """Return the µs per inch and the delay [ns] of a magnetostrictive head from a line y [m] over x [s].

    Position = velocity · (time of flight + half a tick − delay) (SPEC §5). Raises ValueError for the wrong slope.
    """
    offset, velocity = line.poly
    if not velocity > 0.0:
        raise ValueError("the position must rise with the time of flight; check the signs of the reference")
    return US.of(INCH.to_si(1.0) / velocity), NS.of(TICK_S / 2.0 - offset / velocity)
