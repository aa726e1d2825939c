"""An error map as a picture: one coloured square per cell (or per several, if there are many), a scale, and the best place for a task."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.report.svg import Axis, Plot, axes, drawing, label, linear_axis, rect
from truearm.types import Floats

# Dark to light, each lighter than the previous one, so that the picture is readable when printed without colours.
COLOURS = np.array([[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]], dtype=float)
STYLE = (
    "text{font:12px sans-serif;fill:#222}.mid{text-anchor:middle}.end{text-anchor:end}.name{font-weight:bold}"
    ".grid{stroke:#ddd;fill:none}.axis{stroke:#222;fill:none}.pale{fill-opacity:.35}.task{fill:none;stroke:#d00;stroke-width:2}"
)
LONGEST = 640.0  # drawing units of the longer side
LEFT, TOP, BOTTOM = 62.0, 54.0, 46.0  # room for the labels, the title above those of the scale
SCALE = 132.0  # room for the scale and its labels
TICK_SPACE = (50.0, 25.0)  # between ticks along x and y
LETTER = 8.5  # width of a bold letter
MOST_SQUARES = 3000  # about 450 kB


class Cells(NamedTuple):
    """The cells (l, k) of a map by their middles u (k,) and v (l,) [mm], with their errors and sigmas [mm].

    ``outside``: their joints are outside the fitted readings.
    """

    u: Floats
    v: Floats
    error: Floats
    sigma: Floats
    outside: NDArray[np.bool_]

    def thinned(self, step: int) -> Cells:
        """Return every ``step``-th cell of both directions, with the middle one of each."""
        rows, columns = (slice((values.size // 2) % step, None, step) for values in (self.v, self.u))
        area = rows, columns
        return Cells(self.u[columns], self.v[rows], self.error[area], self.sigma[area], self.outside[area])


def map_picture(
    cells: Cells,
    title: str,
    task_mm: tuple[float, float, float, float] | None = None,
    labels: Sequence[str] = ("u [mm]", "v [mm]"),
    styled: bool = True,
) -> str:
    """Return the SVG of errors, pale outside the fitted readings; ``task_mm`` is a rectangle u0, u1, v0, v1.

    ``styled``: a file of its own, otherwise a part of a page. Of more than MOST_SQUARES cells, every second or third … of
    both directions is drawn.
    """
    errors = float(np.nanmin(cells.error)), float(np.nanmax(cells.error))
    step = math.ceil(math.sqrt(np.count_nonzero(~np.isnan(cells.error)) / MOST_SQUARES))
    u_mm, v_mm, error_mm, sigma_mm, outside = cells.thinned(step)
    cell = float(u_mm[1] - u_mm[0]) if u_mm.size > 1 else 1.0
    ends = [(float(values[0]) - cell, float(values[-1]) + cell) for values in (u_mm, v_mm)]
    longest = max(high - low for low, high in ends)
    x, y = (
        linear_axis(name, low, high, intervals=min(6.0, LONGEST * (high - low) / longest / space))
        for name, (low, high), space in zip(labels, ends, TICK_SPACE, strict=True)
    )
    unit = LONGEST / max(x.high - x.low, y.high - y.low)
    across, up = unit * (x.high - x.low), unit * (y.high - y.low)
    right_margin = max(SCALE, LETTER * len(title) - across)
    plot = Plot(x, y, up + TOP + BOTTOM, LEFT + across + right_margin, LEFT, right_margin, TOP, BOTTOM)
    scale = linear_axis("error [mm]", *errors, intervals=min(6.0, up / TICK_SPACE[1]))
    marks = [f"<style>{STYLE}</style>" * styled, axes(plot), label(plot.left, 18, title, "name")]
    for i, j in zip(*np.nonzero(~np.isnan(error_mm)), strict=True):
        x_left, top = plot.px(u_mm[j] - 0.5 * cell), plot.py(v_mm[i] + 0.5 * cell)
        sure = f" ± {sigma_mm[i, j]:.3f}" if np.isfinite(sigma_mm[i, j]) else ""
        tip = f"{u_mm[j]:.0f}, {v_mm[i]:.0f}: {error_mm[i, j]:.3f}{sure} mm" + ", not covered" * bool(outside[i, j])
        side, css = unit * cell + 0.2, "pale" * bool(outside[i, j])  # no seams between cells
        marks.append(
            rect(float(x_left), float(top), side, side, css, tip, _fill(float(scale.fraction(error_mm[i, j]))))
        )
    if step > 1:
        marks.append(label(LEFT + across + 4.0, plot.height - 24, f"1 of {step}² cells shown"))
    if (outside & ~np.isnan(error_mm)).any():
        marks.append(label(LEFT + across + 4.0, plot.height - 8, "pale: not calibrated"))
    if task_mm is not None:
        (x0, x1), (y1, y0) = plot.px(task_mm[:2]), plot.py(task_mm[2:])
        marks.append(rect(x0, y0, x1 - x0, y1 - y0, "task", "the best place for the task"))
    marks += _colours(plot, scale, LEFT + across + 28.0)
    picture = drawing(plot.width, plot.height, marks, title)
    return picture.replace("<svg ", '<svg xmlns="http://www.w3.org/2000/svg" ', 1) + "\n"


def _colours(plot: Plot, scale: Axis, x_left: float) -> list[str]:
    """Return the colours of the scale, with its ticks."""
    floor, steps = plot.height - plot.bottom, 60
    side = (floor - plot.top) / steps
    marks = [
        rect(x_left, floor - (k + 1) * side, 18.0, side + 0.3, "", "", _fill(k / (steps - 1.0))) for k in range(steps)
    ]
    for share, text in zip(scale.fraction(scale.ticks), scale.tick_labels, strict=True):
        marks.append(label(x_left + 24.0, floor - share * (floor - plot.top) + 4.0, text))
    return [*marks, label(x_left, plot.top - 12.0, scale.label)]


def _fill(share: float) -> str:
    stops = np.linspace(0.0, 1.0, len(COLOURS))
    return f' style="fill:rgb({",".join(f"{np.interp(share, stops, colour):.0f}" for colour in COLOURS.T)})"'
