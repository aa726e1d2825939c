"""A small HTML page about the calibration of a sensor: the residual at each point, and the reason for the order.

Lengths are in mm and µm here, for display.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from truearm.report import svg
from truearm.report.certificate import Certificate, Facts, certificate_section
from truearm.report.page_parts import html_page, pictures, section, table
from truearm.report.page_text import figures, number
from truearm.report.svg import Figure
from truearm.report.tables import Table
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
    blocks = section("Residuals", pictures(shown)), section("The places", table(_places(page)))
    first = certificate_section(Certificate("Calibration of a sensor", page.decision, page.certificate))
    return html_page("truearm", page.title, page.subtitle, blocks, certificate=first)


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
    for level, css, name in ((-two_sigma, "old line", "± 2 σ"), (two_sigma, "old line", ""), (0.0, "mean line", "")):
        plot.line(ends, [level, level], css, name)
    tips = (f"{figures(a, 6)} mm: {number(b, 2, sign=True)} µm" for a, b in zip(x, y, strict=True))
    plot.scatter(x, y, "fit", tips, "places", 3.2)
    return plot.figure("Residual at each place", _RESIDUAL_CAPTION)


def _orders(page: GaugePage) -> Figure:
    error = UM.of(page.press)
    plot = svg.Plot(
        svg.linear_axis("order of the polynomial", page.orders[0], page.orders[-1], 1.0),
        svg.log_axis("RMS [µm]", error),
    )
    tips = [f"order {order}: {figures(e)} µm" for order, e in zip(page.orders, error, strict=True)]
    chosen = page.orders.index(page.order)
    plot.line(page.orders, error, "fit line", "cross-validation RMS")
    plot.scatter(page.orders, error, "fit", tips)
    plot.scatter([page.order], [error[chosen]], "val", [tips[chosen]], "chosen", 4.5)
    return plot.figure("Cross-validation error", _ORDER_CAPTION)


def _places(page: GaugePage) -> Table:
    unit = f"[{page.unit}]"
    of_errors = "residual [µm]", "residual to a fit of the others [µm]"
    titles = ("", "reference [mm]", f"reading {unit}", f"noise {unit}", *of_errors)
    columns = (page.reference, page.reading, page.noise, page.residual, page.left_out)
    rows = []
    for place, (y, x, noise, residual, left_out) in enumerate(zip(*columns, strict=True), 1):
        errors = (number(UM.of(error), 3, sign=True) for error in (residual, left_out))
        rows.append((place, number(MM.of(y), 4), figures(x, 8), figures(noise, 2), *errors))
    return Table(titles, rows, "places")
