"""The figures of ``truearm reproduce renders``."""

from __future__ import annotations

import numpy as np

from truearm.report import svg
from truearm.report.figures import Figure, drawn
from truearm.report.page_text import figures
from truearm.reproduce.renders import CrossSection
from truearm.types import Floats

SHOWN = 12  # runs in the figures; later ones do not change


def runs_figure(histories: dict[str, Floats], paper: Floats, at: Floats) -> Figure:
    histories = {key: values[: SHOWN + 1] for key, values in histories.items()}
    every = np.concatenate([*histories.values(), paper])
    last = max(len(h) for h in histories.values()) - 1
    plot = svg.Plot(svg.linear_axis("run", 0, last, 1.0 if last < 6 else 2.0), svg.log_axis("mean error [mm]", every))
    parts = [svg.line(plot, at, paper, "old line")]
    parts.append(svg.scatter(plot, at, paper, "old", [f"paper: {v} mm" for v in paper], 4))
    names = {"paper": ("val", "its recipe"), "map": ("fit", "map"), "gears": ("law", "map, gear errors")}
    for key, (css, name) in names.items():
        values = histories[key]
        parts.append(svg.line(plot, np.arange(values.size), values, css + " line"))
        parts.append(
            svg.scatter(plot, np.arange(values.size), values, css, [f"{name}: {figures(v)} mm" for v in values], 3)
        )
    entries = [("old line", "paper"), *((css + " line", name) for css, name in names.values())]
    caption = "Mean error of the fitted lines, placed by least squares; the paper's points are as printed."
    return drawn(plot, "Mean error, run by run", caption, parts, entries)


def prediction_figure(title: str, caption: str, ml: Floats, plain: Floats, best: Floats) -> Figure:
    steps = np.arange(1, ml.size + 1)
    reach = np.concatenate([ml, plain, best])
    plot = svg.Plot(svg.linear_axis("point", 0, ml.size), svg.log_axis("prediction error [mm]", reach))
    curves = (("old line", plain), ("val line", best), ("fit line", ml))
    entries = [("fit line", "ML"), ("val line", "LS, best P₀"), ("old line", "LS, large P₀")]
    return drawn(plot, title, caption, [svg.line(plot, steps, values, css) for css, values in curves], entries)


def map_figure(title: str, where: CrossSection, error: Floats, direction: Floats | None) -> Figure:
    """Return a map with one cell per pose, darker for larger errors, and strokes for ``direction`` (n, 3), side view."""
    half = 0.025
    x_axis = svg.linear_axis("x [m]", float(where.x.min()) - half, float(where.x.max()) + half, 0.1)
    z_axis = svg.linear_axis("z [m]", float(where.z.min()) - half, float(where.z.max()) + half, 0.2)
    plot = svg.Plot(x_axis, z_axis, height=480.0)
    shade = (error - error.min()) / max(float(np.ptp(error)), svg.SMALLEST)
    left, right = plot.px(where.x - half), plot.px(where.x + half)
    top, bottom = plot.py(where.z + half), plot.py(where.z - half)
    parts = []
    for i, e in enumerate(error):
        tip = f"x {where.x[i]:.2f} m, z {where.z[i]:.2f} m: {figures(float(e))} mm"
        size = right[i] - left[i], bottom[i] - top[i]
        parts.append(svg.rect(left[i], top[i], *size, "cell", tip, f' fill-opacity="{0.08 + 0.8 * shade[i]:.2f}"'))
        if direction is not None:
            ends = 0.02 * np.array([-1.0, 1.0])
            x, z = where.x[i] + ends * direction[i, 0], where.z[i] + ends * direction[i, 2]
            parts.append(svg.line(plot, x, z, "stroke"))
    caption = f"Vertical section, θ1 = θ4 = θ6 = 0, elbow up, hand down: {figures(float(error.min()))} to "
    caption += f"{figures(float(error.max()))} mm; darker is larger."
    if direction is not None:
        caption += " Strokes: the direction of the smallest error, projected; a dot is a direction perpendicular to the section."
    return drawn(plot, title, caption, parts)
