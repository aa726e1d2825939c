"""Pictures of joint laws: each error curve with its band and the covered range, and its spectrum."""

from __future__ import annotations

import numpy as np

from truearm.estimate.law_curves import SampledCurve, spectrum
from truearm.report import svg
from truearm.report.figures import Figure, drawn
from truearm.report.law_words import intervals_text
from truearm.report.page_text import figures
from truearm.types import rms
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
    lines = [(y - band, "old line"), (y + band, "old line"), (y, "law line")]
    parts = [svg.line(plot, x, values, css) for values, css in lines]
    parts += [svg.line(plot, x[run], y[run], "fit line") for run in _runs(curve.covered)]
    entries = [("fit line", "covered"), ("law line", "outside"), ("old line", "±2σ")]
    caption = (
        f"Deviation of the joint from offset and gain. RMS over the covered readings {figures(rms(y[curve.covered]), 2)} mrad. "
        f"Covered: {intervals_text(DEG.of(np.array(curve.intervals)).tolist())}. Elsewhere no reading was measured: "
        "the curve returns to zero and its band widens."
    )
    return drawn(plot, f"Error curve of {curve.joint}", caption, parts, entries)


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
    tips = [f"{c:.0f} cycles: {figures(a, 2)} mrad" for c, a in zip(cycles, amplitude, strict=True)]
    strongest = cycles[int(np.argmax(amplitude))]
    caption = (
        f"Amplitude of each sine alone over the covered readings; the strongest has {strongest:.0f} cycles per turn. "
        f"The covered range resolves {figures(resolution, 2)} cycles per turn; sines of fewer than {cycles[0]:.0f} cycles per turn cannot be seen."
    )
    return drawn(plot, f"Spectrum of {curve.joint}", caption, [svg.bars(plot, edges, amplitude, "fit bar", tips)])


def _runs(flags: np.ndarray) -> list[slice]:
    """Return runs of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return [slice(start, stop) for start, stop in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)]
