"""A small HTML page about the calibration of a sensor: the residual at each point, and the reason for the order.

Lengths are in mm and µm here, for display.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from truearm.report import svg
from truearm.report.certificate import Certificate, Facts, certificate_section
from truearm.report.figures import Figure, drawn
from truearm.report.page_parts import html_page, picture, pictures, section, table_of
from truearm.report.page_text import escape, figures, number
from truearm.types import Floats
from truearm.units import MM, UM


@dataclass(frozen=True)
class GaugePage:
    """The content of the page.

    ``reference`` (n,), ``residual`` (n,) and ``left_out`` (n,) [m]; ``reading`` (n,) in ``unit`` with ``noise`` (n,),
    the standard deviation of each mean; ``orders`` (k,) and ``press`` (k,) [m] of the polynomials that were tried.
    """

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
    decision: str = ""  # the uncertainty in a sentence
    certificate: tuple[tuple[str, Facts], ...] = ()  # for page one


def render(page: GaugePage) -> str:
    """Return the page as HTML text, to be written as UTF-8."""
    shown = [_residuals(page), *([_orders(page)] if len(page.orders) > 1 else [])]
    sections = (
        certificate_section(Certificate("Calibration of a sensor", page.decision, page.certificate)),
        section("Residuals", pictures(map(picture, shown))),
        section("The places", _table(page)),
    )
    return html_page("truearm", page.title, page.subtitle, sections)


_RESIDUAL_CAPTION = (
    "Reference minus calibrated reading. Points scatter about zero without a pattern if the order is right; the dashed lines "
    "are two standard deviations. A difference between there and back indicates play or friction in the stage."
)
_ORDER_CAPTION = (
    "RMS error of predicting each point from a polynomial fitted to all others. truearm chooses the lowest order that is not "
    "significantly worse than the best."
)


def _residuals(page: GaugePage) -> Figure:
    x, y, two_sigma = MM.of(page.reference), UM.of(page.residual), UM.of(2.0 * page.sigma)
    reach = 1.05 * max(float(np.abs(y).max()), two_sigma, 1e-3)
    plot = svg.Plot(
        svg.linear_axis("reference [mm]", x.min(), x.max()), svg.linear_axis("residual [µm]", -reach, reach)
    )
    ends = [plot.x.low, plot.x.high]
    tips = [f"{figures(a, 6)} mm: {number(b, 2, sign=True)} µm" for a, b in zip(x, y, strict=True)]
    levels = ((-two_sigma, "old line"), (two_sigma, "old line"), (0.0, "mean line"))
    parts = [svg.line(plot, ends, [level, level], css) for level, css in levels]
    parts.append(svg.scatter(plot, x, y, "fit", tips, 3.2))
    entries = [("fit", "places"), ("old line", "± 2 σ")]
    return drawn(plot, "Residual at each place", _RESIDUAL_CAPTION, parts, entries)


def _orders(page: GaugePage) -> Figure:
    error = UM.of(page.press)
    plot = svg.Plot(
        svg.linear_axis("order of the polynomial", page.orders[0], page.orders[-1], 1.0),
        svg.log_axis("RMS [µm]", error),
    )
    tips = [f"order {order}: {figures(e)} µm" for order, e in zip(page.orders, error, strict=True)]
    taken = page.orders.index(page.order)
    parts = [
        svg.line(plot, page.orders, error, "fit line"),
        svg.scatter(plot, page.orders, error, "fit", tips),
        svg.scatter(plot, [page.order], [error[taken]], "val", [tips[taken]], 4.5),
    ]
    entries = [("fit line", "cross-validation RMS"), ("val", "chosen")]
    return drawn(plot, "Cross-validation error", _ORDER_CAPTION, parts, entries)


def _table(page: GaugePage) -> str:
    unit = f"[{page.unit}]"
    titles = (
        "",
        "reference [mm]",
        f"reading {unit}",
        f"noise {unit}",
        "residual [µm]",
        "residual to a fit of the others [µm]",
    )
    columns = (page.reference, page.reading, page.noise, page.residual, page.left_out)
    rows = []
    for place, (y, x, noise, residual, left_out) in enumerate(zip(*columns, strict=True), 1):
        cells = (number(MM.of(y), 4), figures(x, 8), figures(noise, 2))
        errors = (number(UM.of(residual), 3, sign=True), number(UM.of(left_out), 3, sign=True))
        rows.append((str(place), *cells, *errors))
    return table_of([escape(title) for title in titles], rows, "places")
