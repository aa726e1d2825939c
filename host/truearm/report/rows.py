"""Rows of an estimate by kind, in the border's units, and the law that their residuals would follow.

A ball-bar's residual has a sign; the residual of a line, a position or a seat is the norm of a 3-vector. If the errors
are white and Gaussian with one σ, the first follow a Gaussian, the second a Maxwell distribution (σ times the root of
a χ² of three degrees of freedom). ``Law`` is that distinction; histogram and quantile plot are drawn against it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import special

from truearm.types import Estimate, Floats, ObservationTable

SIGNED = ("ball_bar",)  # kinds whose residual is one number with a sign
KIND_NAMES = {"ball_bar": "ball-bar", "seat": "ball-in-socket"}


class Rows(NamedTuple):
    """Observations of one kind, finite ones only."""

    kind: str
    residual: Floats  # (n,) mm, signed or norm
    before: Floats  # (n,) mm
    longitude: Floats  # (n,) deg, NaN where there is none
    fitted: NDArray[np.bool_]  # (n,)
    group: NDArray[np.str_]  # (n,)
    source: NDArray[np.str_]  # (n,)

    @property
    def signed(self) -> bool:
        return self.kind in SIGNED

    @property
    def name(self) -> str:
        """What the residual is, for an axis."""
        return "residual [mm]" if self.signed else "norm of the residual [mm]"


class Law(NamedTuple):
    """The distribution that residuals of a kind would follow: Gaussian, or Maxwell with ``mean`` 0."""

    signed: bool
    mean: float
    sigma: float

    def density(self, x: Floats) -> Floats:
        z = (x - self.mean) / self.sigma
        gauss = np.exp(-0.5 * z**2) / (math.sqrt(2.0 * math.pi) * self.sigma)
        return gauss if self.signed else np.where(z > 0.0, 2.0 * z**2 * gauss, 0.0)

    def quantile(self, share: Floats) -> Floats:
        if self.signed:
            return np.asarray(self.mean + self.sigma * special.ndtri(share))
        return np.asarray(self.sigma * np.sqrt(2.0 * special.gammaincinv(1.5, share)))


def rows_by_kind(estimate: Estimate, table: ObservationTable, longitude: Floats) -> list[Rows]:
    """The observations of each kind in the border's units; rows without a finite residual are left out."""
    finite = np.isfinite(estimate.residual) & np.isfinite(estimate.residual_before)
    pair = np.array([f"{c} · {s}" for c, s in zip(table.chuck, table.sphere, strict=True)])
    group = np.where(table.kind == "ball_bar", pair, table.place)
    found = []
    for kind in np.unique(table.kind[finite]):
        at = finite & (table.kind == kind)
        residual, before = 1e3 * estimate.residual[at], 1e3 * estimate.residual_before[at]
        angle = np.degrees(np.arctan2(np.sin(longitude[at]), np.cos(longitude[at])))
        found.append(Rows(str(kind), residual, before, angle, estimate.fitted[at], group[at], table.source[at]))
    return found


def law_of(rows: Rows) -> Law:
    """The law fitted to the residuals of the fitting rows."""
    r = rows.residual[rows.fitted]
    if rows.signed:
        return Law(True, float(r.mean()), float(r.std(ddof=1)) if r.size > 1 else 0.0)
    return Law(False, 0.0, float(np.sqrt(np.mean(r**2) / 3.0)))


def rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else math.nan
