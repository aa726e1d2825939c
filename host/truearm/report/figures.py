"""The pictures of a calibration: Fig. 3 and 4 of Goswami 1993, errors before and after, drift, joint laws.

They show the rows of an estimate by kind. A residual with one component has a sign, like a ball-bar's. One with several
is their norm, like a line's. If the errors are white and Gaussian with one σ, the former follow a Gaussian
distribution. The latter follow σ times the root of χ² with one degree of freedom per component (for three: a Maxwell
distribution). ``Law`` represents this distinction; the histogram is drawn against it. Residuals in several units, such
as a pose's position and rotation, form several sets of rows. Numbers here are in display units (units.py).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.estimate.circumstances import mountings, sessions
from truearm.estimate.law_curves import SampledCurve, sine_amplitudes
from truearm.kinds.registry import kinds
from truearm.kinds.table import ObservationTable
from truearm.report import svg
from truearm.report.page import Figure, figures, number
from truearm.report.result_findings import intervals_text
from truearm.report.result_tables import COMPONENTS, kind_name
from truearm.results import Estimate
from truearm.text import counted
from truearm.types import Floats, Indices, Mask, rms
from truearm.units import DEG, MRAD, shown, symbol, title

MAX_POINTS = 2000  # drawn of a set of rows, 120 B each; of more, the largest tenth and an even selection of the others
MAX_MARKS = 100  # changes of mount or session that are marked
STRETCHES = 24  # sections of the order of measurement, each with its mean
FINEST_BIN = 1e-6  # in display units; noise-free residuals are rounding errors or exactly zero
LONGITUDE_BIN_DEG = 30.0
FEWEST_IN_BIN = 5


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


def figures_of(rows: ResidualRows) -> list[Figure]:
    """Return all pictures of the rows of one kind, except those for which data are missing."""
    of_fit = (histogram(rows), by_longitude(rows)) if rows.fitted.any() else ()
    return [figure for figure in (*of_fit, before_after(rows), by_order(rows)) if figure]


def histogram(rows: ResidualRows) -> Figure:
    """Return the residuals of the fitted rows with the fitted distribution (Goswami 1993, Fig. 4)."""
    r, law = rows.residual[rows.fitted], law_of(rows)
    edges = _bin_edges(r)
    count, _ = np.histogram(r, edges)
    width, grid = edges[1] - edges[0], np.linspace(edges[0], edges[-1], 161)
    plain = law.sigma < width / 50.0  # noise-free data: a curve would be a needle
    curve = np.zeros(grid.size) if plain else r.size * width * law.density(grid)
    top = 1.05 * max(float(count.max()), float(curve.max()))
    plot = svg.Plot(svg.linear_axis(rows.name, edges[0], edges[-1]), svg.linear_axis("observations", 0.0, top))
    tips = (
        f"{figures(a)} to {figures(b)} {rows.unit}: {n}" for a, b, n in zip(edges[:-1], edges[1:], count, strict=True)
    )
    plot.bars(edges, count, "fit", tips, "fitted rows")
    if not plain:
        plot.line(grid, curve, "law line", law.name)
    note = [f"mean {number(law.mean, 4)} {rows.unit}"] if law.width == 1 else []
    note += [f"σ {number(law.sigma, 4)} {rows.unit}", f"n {r.size}"]
    for k, text in enumerate(note):
        plot.draw(svg.label(plot.width - plot.right - 6, plot.top + 17 + 18 * k, text, "end note"))
    caption = f"{counted(r.size, 'row')} not held out, and the {law.name} fitted to them: {', '.join(note)}."
    if not rows.signed:
        caption += " Norms of 3-vectors have no sign; σ is the mean over the three coordinates."
    return plot.figure("Residuals after calibration", caption)


def _bin_edges(r: Floats) -> Floats:
    """Return edges at round multiples of a round width, the first below and the last above all values."""
    # Half of Scott's rule, rounded up to between 0.5 and 1.25 of it; 60 bins at most, in case one row is far out.
    scott = 3.49 * r.std() * r.size ** (-1 / 3)
    width = svg.round_step(max(0.5 * scott, np.ptp(r) / 60.0, 1e-3 * np.abs(r).max(), FINEST_BIN))
    first = math.floor(r.min() / width - 1e-9)
    return width * np.arange(first, math.floor(r.max() / width + 1e-9) + 2)


def by_order(rows: ResidualRows) -> Figure:
    """Return residuals in the order of measurement, with sessions and mounts, to show drift or slip."""
    x, y = rows.number.astype(float), rows.residual
    plot = svg.Plot(svg.linear_axis("row", x[0], x[-1]), svg.linear_axis(rows.name, *_reach(y)), width=820.0)
    new_session, new_mount = (x[1:][numbers[1:] != numbers[:-1]] - 0.5 for numbers in (rows.session, rows.mount))
    for css, places in (("mount", new_mount), ("session", new_session)):
        for place in places if places.size <= MAX_MARKS else ():
            plot.line([place, place], [plot.y.low, plot.y.high], css + " line", f"new {css}")
    _draw_residuals(plot, rows, x, np.isfinite(y), "row {}", np.array_split(np.flatnonzero(rows.fitted), STRETCHES))
    n_mounts, n_sessions = new_mount.size + 1, new_session.size + 1
    caption = (
        f"In the order of measurement: {counted(n_sessions, 'session')}, {counted(n_mounts, 'stretch', 'stretches')} of rows with the same items of the rig. A step or a "
        "trend in the mean indicates a slip or a drift that the parameters could not absorb."
    )
    return plot.figure("Residual in the order of measurement", caption, wide=True)


def by_longitude(rows: ResidualRows) -> Figure | None:
    """Return residuals against the longitude of the sphere about its chuck (Goswami 1993, Fig. 3)."""
    finite = np.isfinite(rows.longitude)
    if not (finite & rows.fitted).any():
        return None
    x, y = rows.longitude, rows.residual
    longitudes = svg.linear_axis("longitude [deg]", x[finite].min(), x[finite].max(), 60.0)
    plot = svg.Plot(longitudes, svg.linear_axis(rows.name, *_reach(y[finite])))
    chosen, interval = np.flatnonzero(finite & rows.fitted), np.floor(x / LONGITUDE_BIN_DEG)
    _draw_residuals(plot, rows, x, finite, "{}°", [chosen[interval[chosen] == k] for k in np.unique(interval[chosen])])
    caption = (
        "Longitude of the sphere about its chuck. Measurement errors do not depend on it: a mean that varies by more than "
        "its bars (two standard errors) indicates errors that the parameters do not model."
    )
    return plot.figure("Residual against longitude", caption)


def _draw_residuals(
    plot: svg.Plot, rows: ResidualRows, x: Floats, shown: Mask, tip: str, groups: Iterable[Indices]
) -> None:
    """Draw the ``shown`` (n,) residuals at x (n,), and the mean of each group of enough rows with 2 standard errors."""
    y = rows.residual
    for css, name, chosen in _sets(rows):
        drawn_rows = _drawn(y, shown & chosen)
        tips = (
            f"{s[:60]}: {figures(v)} {rows.unit} at {tip.format(number(a, 0))}"
            for s, v, a in zip(rows.source[drawn_rows], y[drawn_rows], x[drawn_rows], strict=True)
        )
        plot.scatter(x[drawn_rows], y[drawn_rows], css, tips, name)
    groups = [group for group in groups if group.size >= FEWEST_IN_BIN]
    centres, means = ([float(values[group].mean()) for group in groups] for values in (x, y))
    for group, centre, mean in zip(groups, centres, means, strict=True):
        error = float(y[group].std(ddof=1) / math.sqrt(group.size))
        plot.line([centre, centre], [mean - 2 * error, mean + 2 * error], "mean line")
    plot.line(centres, means, "mean line", "mean ± 2 s.e.")


def _reach(values: Floats) -> tuple[float, float]:
    """Return the range of an axis: zero in the middle for signed values, otherwise at the bottom."""
    top = 1.02 * float(np.abs(values).max())
    return (-top if values.min() < 0.0 else 0.0), top


def _sets(rows: ResidualRows) -> list[tuple[str, str, NDArray[np.bool_]]]:
    """Return class, name and mask of the fitted and the validation rows, for those that exist."""
    sets = [("fit", "fitted rows", rows.fitted), ("val", "held-out rows", ~rows.fitted)]
    return [entry for entry in sets if entry[2].any()]


def _drawn(values: Floats, chosen: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Return indices of chosen rows; of too many, the largest tenth of MAX_POINTS and an even selection of the rest."""
    index = np.flatnonzero(chosen)
    if index.size <= MAX_POINTS:
        return index
    index = index[np.argsort(-np.abs(values[index]), kind="stable")]
    keep = MAX_POINTS // 10
    stride = math.ceil((index.size - keep) / (MAX_POINTS - keep))
    return np.concatenate([index[:keep], index[keep::stride]])


def before_after(rows: ResidualRows) -> Figure:
    """Return the share of the rows with |residual| below a length, before and after."""
    lines = [(css, name + ", after", rows.residual[mask]) for css, name, mask in _sets(rows)]
    lines = [("old", "all rows, before", rows.nominal), *lines]
    size = np.abs(np.concatenate([rows.nominal, rows.residual]))
    # A residual that happens to be near zero would stretch the axis by decades; the lowest rows are drawn at its end.
    reach = np.percentile(size, [2.0, 100.0])
    plot = svg.Plot(
        svg.log_axis(title("|residual|", rows.si), reach), svg.linear_axis("share of rows [%]", 0.0, 100.0, 20.0)
    )
    share = np.linspace(0.0, 100.0, 201)
    for css, name, values in lines:
        plot.line(np.percentile(np.abs(values), share), share, css + " line", name.replace(" rows", ""))
    p95 = [f"{figures(float(np.percentile(np.abs(values), 95.0)))} {rows.unit} ({name})" for _, name, values in lines]
    return plot.figure("Before and after", f"95 % of the rows lie below {', '.join(p95)}.")


def law_figures(curves: Iterable[SampledCurve]) -> list[Figure]:
    """Return two pictures per curve: over the joint's readings and, if it is long enough, over cycles per turn."""
    return [figure for curve in curves for figure in (_over_readings(curve), _over_cycles(curve)) if figure]


def _over_readings(curve: SampledCurve) -> Figure:
    x, y, band = DEG.of(curve.readings), MRAD.of(curve.error), 2.0 * MRAD.of(curve.sigma)
    top = 1.05 * float((np.abs(y) + band)[curve.covered].max(initial=1e-3))
    plot = svg.Plot(
        svg.linear_axis("reading [deg]", float(x[0]), float(x[-1])), svg.linear_axis("error [mrad]", -top, top)
    )
    for values, css, name in ((y - band, "old line", ""), (y + band, "old line", "±2σ"), (y, "law line", "outside")):
        plot.line(x, values, css, name)
    for run in _runs(curve.covered):
        plot.line(x[run], y[run], "fit line", "covered")
    caption = (
        f"Deviation of the joint from offset and gain. RMS over the covered readings {figures(rms(y[curve.covered]), 2)} mrad. "
        f"Covered: {intervals_text(DEG.of(np.array(curve.intervals)).tolist())}. Elsewhere no reading was measured: "
        "the curve returns to zero and its band widens."
    )
    return plot.figure(f"Error curve of {curve.joint}", caption)


def _over_cycles(curve: SampledCurve) -> Figure | None:
    cycles, amplitude, resolution = sine_amplitudes(curve)
    if not cycles.size:
        return None
    amplitude = MRAD.of(amplitude)
    edges = np.append(cycles - 0.5, cycles[-1] + 0.5)
    plot = svg.Plot(
        svg.linear_axis("cycles per turn", 0.0, float(edges[-1])),
        svg.linear_axis("amplitude [mrad]", 0.0, 1.05 * float(amplitude.max(initial=1e-3))),
    )
    tips = (f"{c:.0f} cycles: {figures(a, 2)} mrad" for c, a in zip(cycles, amplitude, strict=True))
    plot.bars(edges, amplitude, "fit", tips)
    strongest = cycles[int(np.argmax(amplitude))]
    caption = (
        f"Amplitude of each sine alone over the covered readings; the strongest has {strongest:.0f} cycles per turn. "
        f"The covered range resolves {figures(resolution, 2)} cycles per turn; sines of fewer than {cycles[0]:.0f} cycles per turn cannot be seen."
    )
    return plot.figure(f"Spectrum of {curve.joint}", caption)


def _runs(flags: np.ndarray) -> list[slice]:
    """Return runs of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return [slice(start, stop) for start, stop in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)]
