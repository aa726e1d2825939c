"""One small HTML page about the calibration of a sensor: what is left at each place, and why this order.

Made like the other pages (page.py): a single file without a script. Lengths are in mm and µm here: this is the border.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib.resources import files

import numpy as np

from truearm.report import svg
from truearm.report.calibration_page import POLICY
from truearm.report.page_tables import fact_list
from truearm.report.page_text import escape, figures, number
from truearm.types import Floats
from truearm.units import MM, UM

MARK = "<!-- truearm box gauge -->"  # by which a page of ours is known


@dataclass(frozen=True)
class GaugePage:
    """``reference`` (n,), ``residual`` (n,) and ``left_out`` (n,) [m], ``reading`` (n,) in ``unit`` with ``noise`` (n,), the
    standard deviation of each mean; ``orders`` (k,) and ``press`` (k,) [m] of the polynomials that were tried."""

    title: str
    subtitle: str
    unit: str
    reference: Floats
    reading: Floats
    noise: Floats
    residual: Floats
    left_out: Floats
    sigma: float
    orders: tuple[int, ...]
    press: Floats
    order: int
    facts: tuple[tuple[str, str], ...] = ()


def render(page: GaugePage) -> str:
    """The page as HTML text, to be written as UTF-8."""
    style = files("truearm.report").joinpath("page.css").read_text(encoding="utf-8")
    pictures = _picture("What is left at each place", _residuals(page), _RESIDUAL_CAPTION)
    if len(page.orders) > 1:
        pictures += _picture("Error at a place that was not used", _orders(page), _ORDER_CAPTION)
    return (
        f'<!DOCTYPE html>\n{MARK}\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="color-scheme" content="light dark">\n'
        f"<title>{escape(page.title)}</title>\n<style>\n{style}</style>\n</head>\n<body>\n"
        f'<header><p class="brand">truearm</p><h1>{escape(page.title)}</h1>'
        f'<p class="subtitle">{escape(page.subtitle, 400)}</p></header>\n<main>\n'
        f'<section><h2>Residuals</h2><div class="pictures">{pictures}</div></section>\n'
        f"<section><h2>The calibration</h2>{fact_list(page.facts)}</section>\n"
        f"<section><h2>The places</h2>{_table(page)}</section>\n</main>\n</body>\n</html>\n"
    )


_RESIDUAL_CAPTION = (
    "Reference less calibrated reading. Points scatter about zero without a pattern if the order is right; the dashed lines "
    "are two standard deviations. There and back that lie apart tell of play or friction in the stage."
)
_ORDER_CAPTION = (
    "Each point is predicted by a polynomial through all others; the RMS of what this misses. The lowest order that is as "
    "good as the best one, within chance, is taken."
)


def _residuals(page: GaugePage) -> str:
    x, y, two_sigma = MM.of(page.reference), UM.of(page.residual), UM.of(2.0 * page.sigma)
    reach = 1.05 * max(float(np.abs(y).max()), two_sigma, 1e-3)
    plot = svg.Plot(
        svg.linear_axis("reference [mm]", x.min(), x.max()), svg.linear_axis("residual [µm]", -reach, reach)
    )
    parts = [svg.axes(plot)]
    for at in (-two_sigma, two_sigma):
        parts.append(svg.line(plot, [plot.x.low, plot.x.high], [at, at], "old line"))
    tips = [f"{figures(a, 6)} mm: {number(b, 2, sign=True)} µm" for a, b in zip(x, y, strict=True)]
    parts += [
        svg.line(plot, [plot.x.low, plot.x.high], [0.0, 0.0], "mean line"),
        svg.scatter(plot, x, y, "fit", tips, 3.2),
    ]
    parts.append(svg.legend(plot, [("fit", "places"), ("old line", "± 2 σ")]))
    return svg.drawing(plot.width, plot.height, parts, "Residuals over the reference")


def _orders(page: GaugePage) -> str:
    error = UM.of(page.press)
    plot = svg.Plot(
        svg.linear_axis("order of the polynomial", page.orders[0], page.orders[-1], 1.0),
        svg.log_axis("RMS [µm]", error),
    )
    tips = [f"order {order}: {figures(e)} µm" for order, e in zip(page.orders, error, strict=True)]
    taken = page.orders.index(page.order)
    parts = [
        svg.axes(plot),
        svg.line(plot, page.orders, error, "fit line"),
        svg.scatter(plot, page.orders, error, "fit", tips),
    ]
    parts.append(svg.scatter(plot, [page.order], [error[taken]], "val", [tips[taken]], 4.5))
    parts.append(svg.legend(plot, [("fit line", "left-out RMS"), ("val", "taken")]))
    return svg.drawing(plot.width, plot.height, parts, "Left-out error over the order")


def _picture(title: str, drawing: str, caption: str) -> str:
    return f"<figure><h3>{title}</h3>{drawing}<figcaption>{caption}</figcaption></figure>"


def _table(page: GaugePage) -> str:
    titles = ("", "reference [mm]", f"reading [{page.unit}]", "its noise", "residual [µm]", "left out [µm]")
    head = "".join(f'<th scope="col">{escape(title)}</th>' for title in titles)
    columns = (page.reference, page.reading, page.noise, page.residual, page.left_out)
    rows = []
    for place, (y, x, noise, residual, left_out) in enumerate(zip(*columns, strict=True), 1):
        cells = (number(MM.of(y), 4), figures(x, 8), figures(noise, 2))
        errors = (number(UM.of(residual), 2, sign=True), number(UM.of(left_out), 2, sign=True))
        rows.append(f'<tr><th scope="row">{place}</th>{"".join(f"<td>{cell}</td>" for cell in (*cells, *errors))}</tr>')
    table = f'<table class="plain"><thead><tr>{head}</tr></thead><tbody>{"".join(rows)}</tbody></table>'
    return f'<div class="scroll" tabindex="0" role="region" aria-label="places">{table}</div>'
