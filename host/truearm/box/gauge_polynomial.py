r"""A sensor's calibration against a reference: the polynomial that turns its reading x into a position y.

The sensor stands at n places, the reference gives y_i, the sensor x_i (a mean over seconds, so its noise is small beside what
the polynomial leaves). With u = (x − centre) / half the span, −1 ≤ u ≤ 1, and the Legendre polynomials P_j(u) as columns
of A (n, p), A = QR, the fit is c = R⁻¹Qᵀy. In powers of x itself a cubic's columns are nearly parallel and half of the
digits are lost; the Legendre columns are nearly orthogonal. At the end c is carried over to powers of x by a triangular
matrix T, as the box stores them: poly = T c, covariance T (σ² (RᵀR)⁻¹) Tᵀ.

How many powers? A higher order always leaves less at the points it was fitted to. What counts is the error at a place that
was not used. Leaving out point i and fitting the others predicts it with the error

    e_i / (1 − h_i),    e = y − QQᵀy,    h_i = Σ_j Q_ij²        (h: the diagonal of the hat matrix QQᵀ)

without fitting again (Allen, Technometrics 16, 1974, 125, eq. 3.2; PRESS). The order with the least mean square of these is
the best guess; but on n points that mean is itself known to some tens of percent only. So the lowest order is taken whose
mean square is within one standard error of the best one's (Breiman, Friedman, Olshen and Stone, "Classification and
regression trees", 1984, §3.4.3). On polynomials of order 1 to 5 with 12 and 20 points it finds the order that was put in in 76 to 93 % of
cases (the least mean square alone: 61 to 76 %) and errs, between the points, by 4 to 21 % more than the best order in
hindsight does (tests/host/test_gauge_polynomial.py).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre, polynomial

from truearm.types import Floats, rms
from truearm.units import INCH, NS, US

MAX_ORDER = 7
SPARE = 2  # points more than coefficients, so that σ means something
TICK_S = 8e-9


@dataclass(frozen=True)
class PolyFit:
    """A polynomial through n points. ``poly`` (p,): y = Σ poly[k] x^k; ``covariance`` (p, p) of it, for n − p degrees of freedom.

    ``residual`` (n,): reference − polynomial; ``left_out`` (n,): what each residual would be had its point not been used;
    ``leverage`` (n,): h; ``sigma``: √(Σ residual² / (n − p)); ``press``: the RMS of ``left_out``. All in the reference's unit.
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
    """How many places readings x (n,) are of. Readings closer than a thousandth of the span are one: there and back are not two."""
    span = float(np.ptp(x)) if x.size else 0.0
    return 1 + int(np.count_nonzero(np.diff(np.sort(x)) > 1e-3 * span)) if span > 0.0 else min(x.size, 1)


def possible_orders(x: Floats, highest: int = MAX_ORDER) -> range:
    """The orders that points at readings x (n,) allow: with SPARE points to spare, and fewer powers than distinct places."""
    return range(1, min(highest, x.size - 1 - SPARE, distinct_places(x) - 2) + 1)


def fit(x: Floats, y: Floats, order: int) -> PolyFit:
    """The least-squares polynomial of this order. Raises ValueError unless ``possible_orders`` has it."""
    if order not in possible_orders(x, max(order, MAX_ORDER)):
        raise ValueError(f"order {order} needs {order + 1 + SPARE} points at {order + 2} places at least")
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


def _powers_of_legendre(order: int, centre: float, half: float) -> Floats:
    """T (p, p): powers of x of the Legendre polynomials of (x − centre) / half."""
    u = polynomial.Polynomial([-centre / half, 1.0 / half])
    columns = np.zeros((order + 1, order + 1))
    for j in range(order + 1):
        powers = polynomial.Polynomial(legendre.leg2poly(np.eye(order + 1)[j, : j + 1]))(u).coef
        columns[: powers.size, j] = powers
    return columns


def fits(x: Floats, y: Floats, highest: int = MAX_ORDER) -> list[PolyFit]:
    """The fits of all possible orders, lowest first; [] where there are too few points."""
    return [fit(x, y, order) for order in possible_orders(x, highest)]


def chosen(candidates: Sequence[PolyFit]) -> PolyFit:
    """The lowest order that predicts points that were left out as well as the best one does, within a standard error."""
    best = min(candidates, key=lambda f: f.press)
    squares = best.left_out**2
    enough = np.mean(squares) + np.std(squares, ddof=1) / math.sqrt(squares.size)
    return min((f for f in candidates if f.press**2 <= enough), key=lambda f: f.order)


@dataclass(frozen=True)
class Head:
    """What the box is told of a magnetostrictive head: velocity as µs an inch, delay of the electronics [ns]."""

    us_per_inch: float
    delay_ns: float


def head_of(line: PolyFit) -> Head:
    """Position = velocity · (time of flight + half a tick − delay) (SPEC §5), of a line y [m] over x [s].

    Raises ValueError where the line rises the wrong way.
    """
    offset, velocity = line.poly
    if line.order != 1 or not velocity > 0.0:
        raise ValueError("position must rise with the time of flight; are the reference's signs right?")
    return Head(us_per_inch=US.of(INCH.to_si(1.0) / velocity), delay_ns=NS.of(TICK_S / 2.0 - offset / velocity))


def rounded(poly: Floats, x: Floats, error: float) -> list[str]:
    """The coefficients as decimal text, as short as the polynomial at readings x (n,) stays within ``error`` of the exact one."""
    exact = polynomial.polyval(x, poly)
    for digits in range(4, 18):
        texts = [f"{c:.{digits - 1}e}" for c in poly]
        if np.max(np.abs(polynomial.polyval(x, [float(text) for text in texts]) - exact)) <= error:
            return texts
    return [repr(float(c)) for c in poly]
