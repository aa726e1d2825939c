"""Rows of an estimate by kind, in the border's units, and the law that their residuals would follow.

A ball-bar's residual and a touched flat's have a sign; that of a line, a position or a seat is the norm of a 3-vector. If
the errors are white and Gaussian with one σ, the first follow a Gaussian, the second a Maxwell distribution (σ times the
root of a χ² of three degrees of freedom). ``Law`` is that distinction; histogram and quantile plot are drawn against it.
A pose has two such norms, one of its position and one of its rotation, and so two sets of rows.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import special

from truearm.report.words import ANGLE, KINDS, kind_name
from truearm.types import Estimate, Floats, ObservationTable


class Rows(NamedTuple):
    """Observations of one kind, finite ones only."""

    kind: str
    residual: Floats  # (n,) mm or deg, signed or norm
    before: Floats  # (n,) likewise; NaN where it is not known
    longitude: Floats  # (n,) deg, NaN where there is none
    fitted: NDArray[np.bool_]  # (n,)
    group: NDArray[np.str_]  # (n,)
    source: NDArray[np.str_]  # (n,)
    part: str = ""  # of a pose: "position" or "rotation"

    @property
    def signed(self) -> bool:
        return self.kind in KINDS and KINDS[self.kind].signed

    @property
    def unit(self) -> str:
        return "deg" if self.part == ANGLE else "mm"

    @property
    def title(self) -> str:
        """The kind, and of a pose which part."""
        return f"{kind_name(self.kind)}, {self.part}" if self.part else kind_name(self.kind)

    @property
    def name(self) -> str:
        """What the residual is, for an axis."""
        if self.signed:
            return "residual [mm]"
        return "angle of the residual [deg]" if self.part == ANGLE else "norm of the residual [mm]"


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


class Summary(NamedTuple):
    """The residuals of one kind at one rig: how many rows, RMS and largest [m]; NaN where there are none."""

    rig: str
    kind: str
    fitted: int
    held_out: int
    before: float  # m, RMS of the fitting rows
    after: float
    largest: float  # m, of the fitting rows after
    validation: float  # m, RMS of the held-out rows after
    angle: float  # rad, RMS of the fitting rows' rotation after


def rows_by_kind(
    estimate: Estimate, table: ObservationTable, longitude: Floats, angle: Floats | None = None
) -> list[Rows]:
    """The observations of each kind in the border's units; rows without a finite residual are left out.

    ``angle`` (n,) [rad] is the rotation's residual of the rows of kind pose.
    """
    finite = np.isfinite(estimate.residual["m"]) & np.isfinite(estimate.residual_before["m"])
    group, source, found = _groups(table), np.array([row_name(s) for s in table.source], dtype=np.str_), []
    for kind in np.unique(table.kind[finite]):
        at = finite & (table.kind == kind)
        residual, before = 1e3 * estimate.residual["m"][at], 1e3 * estimate.residual_before["m"][at]
        wrapped = np.degrees(np.arctan2(np.sin(longitude[at]), np.cos(longitude[at])))
        part = "position" if kind == "pose" else ""
        rest = (estimate.fitted[at], group[at], source[at])
        found.append(Rows(str(kind), residual, before, wrapped, *rest, part))
        if angle is not None and kind == "pose" and np.isfinite(angle).any():
            at &= np.isfinite(angle)
            none = np.full(int(at.sum()), np.nan)
            rest = (estimate.fitted[at], group[at], source[at])
            found.append(Rows("pose", np.degrees(angle[at]), none, none, *rest, ANGLE))
    return found


def row_name(source: str) -> str:
    """Where a row comes from without folders, as in result.json: they say where somebody works."""
    return str(source).rpartition("/")[2]


def _groups(table: ObservationTable) -> NDArray[np.str_]:
    """What each row belongs to, by its kind; the rig in front where there are several."""
    names = []
    several = np.unique(table.rig).size > 1
    for i, kind in enumerate(table.kind.tolist()):
        match kind:
            case "ball_bar":
                name = f"{table.chuck[i]} · {table.sphere[i]}"
            case "line":
                name = str(table.line[i])
            case "plane":
                name = str(table.plane[i])
            case "position" | "pose":
                name = " · ".join(filter(None, (str(table.tracker[i]), str(table.target[i]))))
            case _:
                name = str(table.place[i])
        names.append(f"{table.rig[i]}: {name}" if several and table.rig[i] else name)
    return np.array(names, dtype=np.str_)


def summaries(estimate: Estimate, table: ObservationTable, angle: Floats | None = None) -> list[Summary]:
    """A line for each rig and kind, in the order of their names."""
    turn = np.full(len(table), np.nan) if angle is None else angle
    found = []
    for rig, kind in sorted(set(zip(table.rig.tolist(), table.kind.tolist(), strict=True))):
        mine = (table.rig == rig) & (table.kind == kind)
        fit, val = mine & estimate.fitted, mine & ~estimate.fitted
        after = estimate.residual["m"][fit & np.isfinite(estimate.residual["m"])]
        found.append(
            Summary(
                rig,
                kind,
                int(fit.sum()),
                int(val.sum()),
                _finite_rms(estimate.residual_before["m"][fit]),
                _finite_rms(after),
                float(np.abs(after).max(initial=0.0)) if after.size else math.nan,
                _finite_rms(estimate.residual["m"][val]),
                _finite_rms(turn[fit]),
            )
        )
    return found


def _finite_rms(values: Floats) -> float:
    return rms(values[np.isfinite(values)])


def law_of(rows: Rows) -> Law:
    """The law fitted to the residuals of the fitting rows."""
    r = rows.residual[rows.fitted]
    if rows.signed:
        return Law(True, float(r.mean()), float(r.std(ddof=1)) if r.size > 1 else 0.0)
    return Law(False, 0.0, float(np.sqrt(np.mean(r**2) / 3.0)))


def rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else math.nan
