"""An error map as a picture: one coloured square per cell, a scale, and the best place for a task."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.report.svg import Plot, axes, drawing, label, linear_axis, num, rect
from truearm.types import Floats

# Dark to light, each lighter than the previous one, so that the picture is readable when printed without colours.
COLOURS = np.array([[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]], dtype=float)
STYLE = (
    "text{font:12px sans-serif;fill:#222}.mid{text-anchor:middle}.end{text-anchor:end}.name{font-weight:bold}"
    ".grid{stroke:#ddd;fill:none}.axis{stroke:#222;fill:none}.pale{fill-opacity:.35}.task{fill:none;stroke:#d00;stroke-width:2}"
)
LONGEST = 640.0  # drawing units of the longer side


class Cells(NamedTuple):
    """The cells (l, k) of a map by their middles u (k,) and v (l,) [mm], with their errors and sigmas [mm].

    ``outside``: their joints are outside the fitted readings.
    """

    u: Floats
    v: Floats
    error: Floats
    sigma: Floats
    outside: NDArray[np.bool_]


def map_picture(
    cells: Cells,
    title: str,
    task_mm: tuple[float, float, float, float] | None = None,
    labels: Sequence[str] = ("u [mm]", "v [mm]"),
) -> str:
    """Return the SVG file of errors, pale outside the fitted readings; ``task_mm`` is a rectangle u0, u1, v0, v1."""
    u_mm, v_mm, error_mm, sigma_mm, outside = cells
    cell = float(u_mm[1] - u_mm[0]) if u_mm.size > 1 else 1.0
    x = linear_axis(labels[0], float(u_mm[0]) - cell, float(u_mm[-1]) + cell)
    y = linear_axis(labels[1], float(v_mm[0]) - cell, float(v_mm[-1]) + cell)
    unit = LONGEST / max(x.high - x.low, y.high - y.low)
    plot = Plot(x, y, height=unit * (y.high - y.low) + 76.0, width=unit * (x.high - x.low) + 190.0, right=128.0)
    low, high = float(np.nanmin(error_mm)), float(np.nanmax(error_mm))
    parts = [f"<style>{STYLE}</style>", axes(plot), label(plot.left, 18, title, "name")]
    for i, j in zip(*np.nonzero(~np.isnan(error_mm)), strict=True):
        left, top = plot.px(u_mm[j] - 0.5 * cell), plot.py(v_mm[i] + 0.5 * cell)
        sure = f" ± {sigma_mm[i, j]:.3f}" if np.isfinite(sigma_mm[i, j]) else ""
        tip = f"{u_mm[j]:.0f}, {v_mm[i]:.0f}: {error_mm[i, j]:.3f}{sure} mm" + ", not covered" * bool(outside[i, j])
        side = unit * cell + 0.2  # no seams between cells
        parts.append(
            rect(
                float(left),
                float(top),
                side,
                side,
                "pale" * bool(outside[i, j]),
                tip,
                _fill((error_mm[i, j] - low) / max(high - low, 1e-12)),
            )
        )
    if (outside & ~np.isnan(error_mm)).any():
        parts.append(label(plot.width - 128.0, 18, "pale: not calibrated"))
    if task_mm is not None:
        (x0, x1), (y1, y0) = plot.px(task_mm[:2]), plot.py(task_mm[2:])
        parts.append(rect(x0, y0, x1 - x0, y1 - y0, "task", "the best place for the task"))
    parts += _scale(plot, low, high)
    picture = drawing(plot.width, plot.height, parts, title)
    return picture.replace("<svg ", '<svg xmlns="http://www.w3.org/2000/svg" ', 1) + "\n"


def _scale(plot: Plot, low: float, high: float) -> list[str]:
    """Return the colours from low to high, with five numbers."""
    left, top, floor, steps = plot.width - 100.0, plot.top, plot.height - plot.bottom, 60
    side = (floor - top) / steps
    parts = [
        rect(left, floor - (k + 1) * side, 18.0, side + 0.3, "", "", _fill(k / (steps - 1.0))) for k in range(steps)
    ]
    for share in (0.0, 0.25, 0.5, 0.75, 1.0):
        parts.append(label(left + 24.0, floor - share * (floor - top) + 4.0, f"{low + share * (high - low):.2f}"))
    return [*parts, label(left + 10.0, top - 10.0, "error [mm]", "mid")]


def _fill(share: float) -> str:
    place = float(np.clip(share, 0.0, 1.0)) * (len(COLOURS) - 1)
    at = min(int(place), len(COLOURS) - 2)
    red, green, blue = COLOURS[at] + (place - at) * (COLOURS[at + 1] - COLOURS[at])
    return f' style="fill:rgb({num(round(red))},{num(round(green))},{num(round(blue))})"'
