"""Small SVG plots: axes with round ticks, points, lines, bars, and error maps of coloured squares.

The page's style sheet assigns colours by class. No plotting library is used. A figure is thus about ten times smaller,
follows the page's light and dark colours, and every mark can have a tooltip (``<title>``) without a script. Arguments
named ``css`` are class names of page.css. Labels and tooltips are plain text and are escaped here.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from truearm.report.page import MINUS, SUPERSCRIPT, Figure, escape
from truearm.types import Floats

SMALLEST = 1e-15  # smallest value on a log axis; noise-free residuals are rounding errors or exactly zero
LETTER = 8.8  # width of a letter in a label, with the large letters of a phone
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
BOLD_LETTER = 8.5  # width of a bold letter
MOST_SQUARES = 3000  # about 450 kB


@dataclass(frozen=True)
class Axis:
    """An axis: its label with the unit, ``low`` to ``high`` of the data, its tick positions and tick labels."""

    label: str
    low: float
    high: float
    ticks: tuple[float, ...]
    tick_labels: tuple[str, ...]
    log: bool = False

    def fraction(self, values: ArrayLike) -> Floats:
        """Return values as fractions of the axis; values outside are moved to its ends."""
        v = np.clip(np.asarray(values, dtype=float), self.low, self.high)
        low, high = self.low, self.high
        if self.log:
            v, low, high = np.log(v), math.log(low), math.log(high)
        return np.asarray((v - low) / (high - low))


def linear_axis(label: str, low: float, high: float, step: float = 0.0, intervals: float = 6.0) -> Axis:
    """Return an axis over [low, high], widened to about ``intervals`` + 1 round ticks at most, or to every ``step``."""
    if not high > low:
        low, high = low - 0.5 * (abs(low) or 1.0), high + 0.5 * (abs(high) or 1.0)
    step = step or round_step((high - low) / intervals)
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    decimals = max(0, -math.floor(math.log10(step) + 1e-9))
    ticks = tuple(k * step + 0.0 for k in range(first, last + 1))
    plain = decimals <= 6 and max(map(abs, ticks)) < 1e6
    labels = tuple((f"{t:.{decimals}f}" if plain else f"{t:.3g}").replace("-", MINUS) for t in ticks)
    return Axis(label, first * step, last * step, ticks, labels)


def round_step(rough: float) -> float:
    """Return the smallest of 1, 2, 5 times a power of ten that is not below ``rough``."""
    power = 10.0 ** math.floor(math.log10(rough))
    return next(m * power for m in (1.0, 2.0, 5.0, 10.0) if m * power >= rough * (1.0 - 1e-9))


def log_axis(label: str, values: ArrayLike) -> Axis:
    """Return a logarithmic axis over whole decades around the non-zero values."""
    v = np.asarray(values, dtype=float)
    v = v[v > SMALLEST]
    first = math.floor(math.log10(v.min(initial=1.0 if v.size == 0 else np.inf)) + 1e-9)
    last = max(math.ceil(math.log10(v.max(initial=SMALLEST)) - 1e-9), first + 1)
    stride = math.ceil((last - first) / 6)
    mantissas = (1.0, 2.0, 5.0) if last - first <= 2 else (1.0,)
    marks = [(m, k) for k in range(first, last, stride) for m in mantissas] + [(1.0, last)] * (
        (last - first) % stride == 0
    )
    ticks, labels = tuple(m * 10.0**k for m, k in marks), tuple(_power_label(m, k) for m, k in marks)
    return Axis(label, 10.0**first, 10.0**last, ticks, labels, log=True)


def _power_label(mantissa: float, exponent: int) -> str:
    if -3 <= exponent <= 4:
        return f"{mantissa * 10.0**exponent:g}"
    return ("" if mantissa == 1.0 else f"{mantissa:g}·") + "10" + str(exponent).translate(SUPERSCRIPT)


@dataclass(eq=False)
class Plot:
    """Two axes, their space in drawing units (about a pixel), and what is drawn there; y points up.

    Its methods draw. Marks with a ``name`` get an entry in the legend, which has their class.
    """

    x: Axis
    y: Axis
    height: float = 300.0
    width: float = 480.0
    least_left: float = 62.0
    right: float = 20.0  # half of the last tick's label
    top: float = 30.0
    bottom: float = 46.0
    marks: list[str] = field(default_factory=list)
    entries: dict[str, str] = field(default_factory=dict)  # names of the legend by class

    @property
    def left(self) -> float:
        """Return room for the tick labels of y, and of its own label beside them."""
        return max(self.least_left, 36.0 + LETTER * max(map(len, self.y.tick_labels)) if self.y.label else 0.0)

    def px(self, values: ArrayLike) -> Floats:
        return self.left + self.x.fraction(values) * (self.width - self.left - self.right)

    def py(self, values: ArrayLike) -> Floats:
        return self.height - self.bottom - self.y.fraction(values) * (self.height - self.top - self.bottom)

    def draw(self, mark: str, css: str = "", name: str = "") -> None:
        """Add a mark, and an entry of the legend if it has a name."""
        self.marks.append(mark)
        if name:
            self.entries[css] = name

    def line(self, x: ArrayLike, y: ArrayLike, css: str, name: str = "") -> None:
        points = " ".join(f"{num(a)},{num(b)}" for a, b in zip(self.px(x), self.py(y), strict=True))
        self.draw(f'<polyline class="{css}" points="{points}"/>', css, name)

    def scatter(
        self, x: ArrayLike, y: ArrayLike, css: str, tips: Iterable[str], name: str = "", radius: float = 2.2
    ) -> None:
        """Draw a circle with a tooltip for every point."""
        circles = (
            f'<circle cx="{num(a)}" cy="{num(b)}" r="{radius}"><title>{escape(tip)}</title></circle>'
            for a, b, tip in zip(self.px(x), self.py(y), tips, strict=True)
        )
        self.draw(f'<g class="{css}">{"".join(circles)}</g>', css, name)

    def bars(self, edges: ArrayLike, heights: ArrayLike, css: str, tips: Iterable[str], name: str = "") -> None:
        """Draw bars between neighbouring edges, from the bottom of the plot."""
        x, y, floor = self.px(edges), self.py(heights), self.height - self.bottom
        spans = zip(x[:-1], x[1:], y, tips, strict=True)
        self.draw("".join(rect(a, top, b - a, floor - top, f"{css} bar", tip) for a, b, top, tip in spans), css, name)

    def figure(self, title: str, caption: str, wide: bool = False) -> Figure:
        """Return all that was drawn, with axes and legend. Screen readers read title and caption instead."""
        drawn = [axes(self), *self.marks, legend(self)]
        return Figure(title, caption, drawing(self.width, self.height, drawn, f"{title}. {caption}"), wide)


def num(value: float) -> str:
    """Return a coordinate to a tenth of a unit, as short as possible."""
    text = f"{value:.1f}"
    return text[:-2] if text.endswith(".0") else text


def label(x: float, y: float, text: str, css: str = "", extra: str = "") -> str:
    return f'<text x="{num(x)}" y="{num(y)}" class="{css}"{extra}>{escape(text, 80)}</text>'


def axes(plot: Plot) -> str:
    """Return grid lines, tick labels and axis labels."""
    x_right, floor = plot.width - plot.right, plot.height - plot.bottom
    middle = (plot.top + floor) / 2
    marks = []
    for place, text in zip(plot.px(plot.x.ticks), plot.x.tick_labels, strict=True):
        marks.append(f'<path class="grid" d="M{num(place)} {num(plot.top)}V{num(floor)}"/>')
        marks.append(label(place, floor + 17, text, "mid"))
    for place, text in zip(plot.py(plot.y.ticks), plot.y.tick_labels, strict=True):
        marks.append(f'<path class="grid" d="M{num(plot.left)} {num(place)}H{num(x_right)}"/>')
        marks.append(label(plot.left - 7, place + 4, text, "end"))
    marks.append(f'<path class="axis" d="M{num(plot.left)} {num(plot.top)}V{num(floor)}H{num(x_right)}"/>')
    marks.append(label((plot.left + x_right) / 2, plot.height - 8, plot.x.label, "mid name"))
    marks.append(label(0, 0, plot.y.label, "mid name", f' transform="translate(14 {num(middle)}) rotate(-90)"'))
    return "".join(marks)


def rect(x: float, y: float, width: float, height: float, css: str, tip: str, extra: str = "") -> str:
    place = f'x="{num(x)}" y="{num(y)}" width="{num(width)}" height="{num(height)}"'
    return f'<rect class="{css}" {place}{extra}><title>{escape(tip)}</title></rect>'


def legend(plot: Plot) -> str:
    """Return the entries of the legend in a row above the plot."""
    marks, x = [], plot.left
    for css in sorted(plot.entries, key=lambda css: (css.endswith("line"), css == "val")):  # points first
        text = plot.entries[css]
        # A line with round ends that is as long as it is thick is a dot, for data drawn as points.
        length = 14.0 if css.endswith("line") else 0.0
        marks.append(f'<path class="{css} key" d="M{num(x + 5)} 14h{num(length)}"/>' + label(x + length + 13, 18, text))
        x += length + 27 + 7.2 * len(text)
    return "".join(marks)


def drawing(width: float, height: float, marks: Iterable[str], description: str) -> str:
    """Return the SVG element; screen readers read ``description`` instead of the picture."""
    box = f'viewBox="0 0 {num(width)} {num(height)}"'
    return f'<svg {box} role="img" aria-label="{escape(description, 400)}">{"".join(marks)}</svg>'


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

    ``styled``: a file of its own, otherwise a part of a page. Of more than MOST_SQUARES cells, every second or third …
    of both directions is drawn.
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
    right_margin = max(SCALE, BOLD_LETTER * len(title) - across)
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
