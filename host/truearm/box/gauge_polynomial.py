r"""Calibrate a sensor against a reference: fit the polynomial that converts its reading x to a position y.

The sensor is placed at n positions. At each, the reference gives y_i and the sensor x_i, a mean over seconds, so its
noise is small compared with the residuals of the polynomial. With u = (x − centre) / half the span, −1 ≤ u ≤ 1, and the
Legendre polynomials P_j(u) as columns of A (n, p), A = QR, the fit is c = R⁻¹Qᵀy. In powers of x itself, the columns of
a cubic are nearly parallel and half of the digits are lost; the Legendre columns are nearly orthogonal. Finally c is
converted to powers of x by a triangular matrix T, as the box stores them: poly = T c, covariance T (σ² (RᵀR)⁻¹) Tᵀ.

**Choosing the order.** A higher order always leaves smaller residuals at the points it was fitted to. What matters is
the error at a position that was not used. Leaving out point i and fitting the others predicts it with the error

    e_i / (1 − h_i),    e = y − QQᵀy,    h_i = Σ_j Q_ij²        (h: the diagonal of the hat matrix QQᵀ)

without another fit (Allen, Technometrics 16, 1974, 125, eq. 3.2; PRESS). The order with the least mean square of these
errors is the best guess, but with n points that mean is itself uncertain by some tens of percent. The lowest order with
a mean square within one standard error of the best one's is therefore chosen (Breiman, Friedman, Olshen and Stone,
"Classification and regression trees", 1984, §3.4.3). For polynomials of order 1 to 5 with 12 and 20 points, this finds
the true order in 76 to 93 % of cases (the least mean square alone: 61 to 76 %). Its error between the points is 4 to 21
% larger than that of the best order in hindsight (tests/host/test_gauge_polynomial.py).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre, polynomial

from truearm.types import Floats, rms
from truearm.units import INCH, NS, US

MAX_ORDER = 7
SPARE = 2  # more points than coefficients by this many, so that σ is meaningful
TICK_S = 8e-9


@dataclass(frozen=True)
class PolyFit:
    """A polynomial through n points. ``poly`` (p,): y = Σ poly[k] x^k; ``covariance`` (p, p) of it, for n − p degrees
    of freedom.

    ``residual`` (n,): reference − polynomial. ``left_out`` (n,): each residual if its point had not been used.
    ``leverage`` (n,): h. ``sigma``: √(Σ residual² / (n − p)). ``press``: the RMS of ``left_out``. All in the
    reference's unit.
    """

    order: int
    poly: Floats
    covariance: Floats
    residual: Floats
    left_out: Floats
    leverage: Floats
    sigma: float

    @property
    def press(self) -> float:
        return rms(self.left_out)


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
    """Fit the least-squares polynomial of this order. Raises ValueError unless it is among ``possible_orders``."""
    if order not in possible_orders(x, max(order, MAX_ORDER)):
        raise ValueError(f"order {order} needs at least {order + 1 + SPARE} points, at {order + 2} places or more")
    centre, half = 0.5 * float(x.min() + x.max()), 0.5 * float(np.ptp(x))
    basis = legendre.legvander((x - centre) / half, order)
    q, r = np.linalg.qr(basis)
    coefficients = np.linalg.solve(r, q.T @ y)
    residual = y - q @ (q.T @ y)
    leverage = np.sum(q**2, axis=1)
    sigma = math.sqrt(float(residual @ residual) / (y.size - order - 1))
    to_powers = _powers_of_legendre(order, centre, half)
    half_covariance = sigma * to_powers @ np.linalg.inv(r)
    return PolyFit(
        order=order,
        poly=to_powers @ coefficients,
        covariance=half_covariance @ half_covariance.T,
        residual=residual,
        left_out=residual / (1.0 - leverage),
        leverage=leverage,
        sigma=sigma,
    )


@functools.lru_cache(maxsize=64)
def _powers_of_legendre(order: int, centre: float, half: float) -> Floats:
    """Return T (p, p), which converts Legendre polynomials of (x − centre) / half to powers of x. Do not write to it.

    This takes most of a fit's time.
    """
    columns = np.zeros((order + 1, order + 1))
    for j in range(order + 1):
        basis = legendre.Legendre.basis(j, domain=[centre - half, centre + half])
        columns[: j + 1, j] = basis.convert(kind=polynomial.Polynomial).coef
    columns.flags.writeable = False
    return columns


def fits(x: Floats, y: Floats, highest: int = MAX_ORDER) -> list[PolyFit]:
    """Return the fits of all possible orders, lowest first; [] if there are too few points."""
    return [fit(x, y, order) for order in possible_orders(x, highest)]


def chosen(candidates: Sequence[PolyFit]) -> PolyFit:
    """Return the lowest order that predicts left-out points as well as the best one does, within one standard error."""
    best = min(candidates, key=lambda f: f.press)
    squares = best.left_out**2
    enough = np.mean(squares) + np.std(squares, ddof=1) / math.sqrt(squares.size)
    return min((f for f in candidates if f.press**2 <= enough), key=lambda f: f.order)


@dataclass(frozen=True)
class Head:
    """Settings of a magnetostrictive head as stored in the box: velocity in µs per inch, delay of the electronics [ns]."""

    us_per_inch: float
    delay_ns: float


def head_of(line: PolyFit) -> Head:
    """Return the settings for a line y [m] over x [s]: position = velocity · (time of flight + half a tick − delay)
    (SPEC §5).

    Raises ValueError if the line has the wrong slope.
    """
    offset, velocity = line.poly
    if line.order != 1 or not velocity > 0.0:
        raise ValueError("the position must rise with the time of flight; check the signs of the reference")
    return Head(us_per_inch=US.of(INCH.to_si(1.0) / velocity), delay_ns=NS.of(TICK_S / 2.0 - offset / velocity))


def rounded(poly: Floats, x: Floats, error: float) -> list[str]:
    """Return the coefficients as decimal text, as short as possible.

    At readings x (n,) the polynomial stays within ``error`` of the exact one.
    """
    exact = polynomial.polyval(x, poly)
    for digits in range(4, 18):
        texts = [f"{c:.{digits - 1}e}" for c in poly]
        if np.max(np.abs(polynomial.polyval(x, [float(text) for text in texts]) - exact)) <= error:
            return texts
    return [repr(float(c)) for c in poly]
