"""Pictures of joint laws: each error curve with its band and the covered range, and its spectrum."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from truearm.estimate.law_curves import SampledCurve, spectrum
from truearm.report import svg
from truearm.report.law_findings import intervals_text
from truearm.report.page_text import figures, number
from truearm.report.svg import Figure
from truearm.results import Estimate
from truearm.types import Floats, rms
from truearm.units import DEG, MRAD


def law_figures(curves: tuple[SampledCurve, ...]) -> list[Figure]:
    """Return two pictures per curve: over the joint's readings and, if it is long enough, over cycles per turn."""
    pairs = ((_over_readings(curve), _over_cycles(curve)) for curve in curves)
    return [figure for pair in pairs for figure in pair if figure is not None]


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
    cycles, amplitude, resolution = spectrum(curve)
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


MOST = 60  # parameters in the picture
STRONGEST = 4  # correlations that its caption names


def correlation(estimate: Estimate) -> Figure | None:
    """Return the lower triangle of the robot's parameter correlations; None unless there are 2 to MOST."""
    seen = estimate.free & estimate.identifiable & (np.diag(estimate.covariance) > 0.0)
    seen[estimate.n_robot_parameters :] = False
    names = [name for name, is_seen in zip(estimate.parameter_names, seen, strict=True) if is_seen]
    if not 2 <= len(names) <= MOST:
        return None
    sigma = np.sqrt(np.diag(estimate.covariance)[seen])
    rho = estimate.covariance[np.ix_(seen, seen)] / np.outer(sigma, sigma)
    cell, left, top = 16.0, 118.0, 8.0
    size = cell * len(names)
    width = max(left + size, 640.0) + 8.0  # room for the key next to a small triangle
    marks = [
        _cell(rho[i, j], left + cell * j, top + cell * i, cell, names[i], names[j])
        for i, j in zip(*np.tril_indices(len(names), -1))
    ]
    for k, name in enumerate(names):
        at = cell * (k + 0.5)
        marks.append(svg.label(left - 6, top + at + 4, _short(name), "end small"))
        turned = f' transform="translate({svg.num(left + at + 4)} {svg.num(top + size + 6)}) rotate(-90)"'
        marks.append(svg.label(0, 0, _short(name), "end small", turned))
    marks.append(_colour_key(width - 212.0, top + 14.0))
    caption = "Of the parameters that were identified. Strongest: " + "; ".join(_strongest(rho, names)) + "."
    picture = svg.drawing(width, top + size + 112.0, marks, "Correlation. " + caption)
    return Figure("Correlation of the parameters", caption, picture, wide=True)


def _cell(rho: float, x: float, y: float, cell: float, a: str, b: str) -> str:
    css = "positive" if rho > 0.0 else "negative"
    extra = f' fill-opacity="{abs(rho):.2f}"'
    return svg.rect(x, y, cell - 1.0, cell - 1.0, css, f"{a}, {b}: {number(rho, 2, sign=True)}", extra)


def _short(name: str) -> str:
    return name if len(name) <= 16 else name[:15] + "…"


def _colour_key(x: float, y: float) -> str:
    cells = []
    for k in range(11):
        rho = k / 5.0 - 1.0
        cells.append(_cell(rho, x + 18.0 * k, y, 18.0, "key", "correlation"))
    marks = zip((0, 5, 10), (-1, 0, 1), strict=True)
    return "".join(cells) + "".join(svg.label(x + 18.0 * k + 9, y + 34, number(v, 0), "mid small") for k, v in marks)


def _strongest(rho: Floats, names: Sequence[str]) -> list[str]:
    i, j = np.tril_indices(len(names), -1)
    order = np.argsort(-np.abs(rho[i, j]))[:STRONGEST]
    return [f"{names[i[k]]} and {names[j[k]]} {number(rho[i[k], j[k]], 2, sign=True)}" for k in order]
