"""The rows of an estimate by kind, in display units, and the expected distribution of their residuals.

A residual with one component has a sign, like a ball-bar's. One with several is their norm, like a line's. If the
errors are white and Gaussian with one σ, the former follow a Gaussian distribution. The latter follow σ times the root
of χ² with one degree of freedom per component (for three: a Maxwell distribution). ``Law`` represents this distinction;
the histogram is drawn against it. Residuals in several units, such as a pose's position and rotation,
form several sets of rows.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.estimate.circumstances import mountings, sessions
from truearm.kinds.registry import kinds
from truearm.kinds.table import ObservationTable
from truearm.report.result_tables import COMPONENTS, kind_name
from truearm.results import Estimate
from truearm.types import Floats, Indices
from truearm.units import DEG, shown, symbol, title


class ResidualRows(NamedTuple):
    """Observations of one kind, only finite ones."""

    kind: str
    si: str  # unit of the residuals
    residual: Floats  # (n,) in display units, signed or norm
    nominal: Floats  # (n,) likewise
    longitude: Floats  # (n,) deg, NaN where there is none
    fitted: NDArray[np.bool_]  # (n,)
    source: NDArray[np.str_]  # (n,)
    number: Indices  # (n,) of the row in the table, from 1
    session: Indices  # (n,) of the session or file it came from, from 0
    mount: Indices  # (n,) increases when something else is mounted
    component: str = ""  # which one, if the kind has residuals in several units

    @property
    def width(self) -> int:
        """Return the number of components of the residual: 1 for a number with a sign, otherwise it is their norm."""
        return kinds()[self.kind].components.count(self.si)

    @property
    def signed(self) -> bool:
        return self.width == 1

    @property
    def unit(self) -> str:
        return symbol(self.si)

    @property
    def title(self) -> str:
        """Return the kind and, if it has several units, the component."""
        return f"{kind_name(self.kind)}, {self.component}" if self.component else kind_name(self.kind)

    @property
    def name(self) -> str:
        """Return the name of the residual, for an axis."""
        if self.signed:
            return title("residual", self.si)
        return title("angle of the residual" if self.si == "rad" else "norm of the residual", self.si)


class Law(NamedTuple):
    """The expected distribution of residuals: Gaussian for ``width`` 1, otherwise that of the norm, with ``mean`` 0."""

    width: int  # components
    mean: float
    sigma: float

    @property
    def name(self) -> str:
        """Return its name in statistics."""
        return {1: "Gaussian", 2: "Rayleigh law", 3: "Maxwell law"}.get(self.width, f"χ law of {self.width} components")

    def density(self, x: Floats) -> Floats:
        z = (x - self.mean) / self.sigma
        if self.width == 1:
            return np.asarray(np.exp(-0.5 * z**2) / (math.sqrt(2.0 * math.pi) * self.sigma))
        normalisation = 2.0 ** (self.width / 2.0 - 1.0) * math.gamma(self.width / 2.0) * self.sigma
        return np.where(z > 0.0, np.maximum(z, 0.0) ** (self.width - 1) * np.exp(-0.5 * z**2) / normalisation, 0.0)


def rows_by_kind(estimate: Estimate, table: ObservationTable, longitude: Floats) -> list[ResidualRows]:
    """Return the observations of each kind and unit for display, without rows that have no finite residual."""
    sets, wrapped = [], DEG.of(np.arctan2(np.sin(longitude), np.cos(longitude)))
    source, number = np.array([row_name(name) for name in table.source], dtype=np.str_), np.arange(1, len(table) + 1)
    of_rows = (wrapped, estimate.fitted, source, number, sessions(table), mountings(table))
    for kind in np.unique(table.kind):
        pairs = {si: (residual, estimate.residual_before[si]) for si, residual in estimate.residual.items()}
        finite = {si: (table.kind == kind) & np.isfinite(pair).all(axis=0) for si, pair in pairs.items()}
        units = [si for si, mask in finite.items() if mask.any()]
        for si in units:
            columns = (column[finite[si]] for column in (*shown(np.array(pairs[si]), si), *of_rows))
            component = COMPONENTS.get(si, si) if len(units) > 1 else ""
            sets.append(ResidualRows._make((str(kind), si, *columns, component)))
    return sets


def row_name(source: str) -> str:
    """Return the source of a row without folders, as in result.json: they reveal where someone works."""
    return str(source).rpartition("/")[2]


def law_of(rows: ResidualRows) -> Law:
    """Return the distribution fitted to the residuals of the fitted rows."""
    r = rows.residual[rows.fitted]
    if rows.signed:
        return Law(1, float(r.mean()), float(r.std(ddof=1)) if r.size > 1 else 0.0)
    return Law(rows.width, 0.0, float(np.sqrt(np.mean(r**2) / rows.width)))
