"""Turn the places of ``truearm box gauge`` into a calibration for the box, and a page that says how good it is.

Lengths are in mm and µm on the page.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from decimal import Decimal
from typing import Any

import numpy as np
from numpy.polynomial import polynomial

from truearm.box.configuration import channel_names, merged
from truearm.box.configuration_schema import check, mantissa_exponent
from truearm.box.gauge_places import Places
from truearm.box.gauge_polynomial import MAX_ORDER, PolyFit, chosen, fits, head_of
from truearm.box.requests import GaugeOptions
from truearm.errors import Argument, ConfigError, InputError
from truearm.report import svg
from truearm.report.certificate import Certificate, certificate_section
from truearm.report.page import Figure, figures, html_page, number, paragraph, pictures, section, table
from truearm.report.tables import Table
from truearm.schema import raising
from truearm.session.box_ident import Channel, Ident
from truearm.text import counted, one_line
from truearm.types import rms
from truearm.units import DEGC, MDEGC, MM, UM
from truearm.version import VERSION

HEAD = "magnetostrictive"  # name of the channel, and of its entry in the configuration
DIGITS = 12  # of a stored coefficient: over 0.1 m, their rounding is less than 1 nm at any order
RESIDUAL_CAPTION = (
    "Reference minus calibrated reading. Points scatter about zero without a pattern if the order is right; the dashed lines "
    "are two standard deviations. A difference between there and back indicates play or friction in the stage."
)
UNKNOWN_TOTAL = "not known without the reference's uncertainty"
ORDER_TEXT = (
    "Error of predicting each place from a polynomial fitted to all others. truearm chooses the lowest order that is not "
    "significantly worse than the best."
)


@dataclass(frozen=True)
class Calibration:
    """The calibration of a channel at ``places``; ``tried``: the fits of all possible orders."""

    channel: Channel
    places: Places
    fit: PolyFit
    tried: Sequence[PolyFit]

    @property
    def previous_error(self) -> float | None:
        """The RMS [m] of the channel's present calibration; None without one."""
        unit = self.channel.length_unit
        if unit is None:
            return None
        return rms(self.places.references - unit.to_si(polynomial.polyval(self.places.readings, self.channel.poly)))

    @property
    def largest_residual(self) -> str:
        return _um(float(np.max(np.abs(self.fit.residual))))

    def lines(self) -> list[str]:
        """Return what the operator is shown."""
        n_places = counted(len(self.places.places), "place")
        chosen_order, previous = self.fit.order, self.previous_error
        return [
            *(
                f"order {fit.order}: cross-validation error {_um(fit.press)} RMS{' ← chosen' * (fit.order == chosen_order)}"
                for fit in self.tried
            ),
            f"{n_places}, sigma {_um(self.fit.sigma)}, largest residual {self.largest_residual}",
            *([] if previous is None else [f"the previous calibration is off by {_um(previous)} RMS"]),
        ]


def _um(length: float | None, missing: str = "not given") -> str:
    return missing if length is None else UM.text(length, ".2f")


def calibrate(places: Places, channel: Channel, order: int | None) -> Calibration:
    """Return the calibration, of the order with the best cross-validation or of this one. Raises InputError.

    The standard deviation is at least that of the means, since few residuals may happen to be smaller.
    """
    if few := places.too_few():
        raise few
    linear = channel.name == HEAD
    tried = fits(places.readings, places.references, 1 if linear else MAX_ORDER)
    if order is not None and not linear and order > tried[-1].order:
        allow = counted(len(places.places), "place allows", "places allow")
        raise InputError(Argument("order"), f" {order} needs more places; {allow} order {tried[-1].order}")
    fit = tried[0] if linear else chosen(tried) if order is None else tried[order - 1]
    slope = polynomial.polyval(places.readings, polynomial.polyder(fit.poly))
    noise_of_means = rms(np.asarray(slope * np.sqrt([place.mean.value_var for place in places.places]), np.float64))
    return Calibration(channel, places, replace(fit, sigma=max(fit.sigma, noise_of_means)), tried)


def with_calibration(config: dict[str, Any], calibration: Calibration, options: GaugeOptions) -> dict[str, Any]:
    """Return the configuration with the new calibration, checked. Raises InputError, ConfigError."""
    temperature = calibration.places.temperature
    provenance = {
        "serial": _serial(config, calibration.channel.name) if options.serial is None else options.serial,
        "date": datetime.now(UTC).date().isoformat(),
        "sigma": _pair(f"{calibration.fit.sigma:.2e}"),
        **({} if temperature is None else {"temperature_mdegc": round(MDEGC.of(temperature))}),
        **({"reference": options.instrument} if options.instrument else {}),
        **({} if options.uncertainty is None else {"reference_sigma": _pair(f"{0.5 * options.uncertainty:.3e}")}),
    }
    if calibration.channel.name == HEAD:
        try:
            us_per_inch, delay_ns = head_of(calibration.fit)
        except ValueError as exc:
            raise InputError(f"these places do not give a calibration: {exc}") from exc
        head = {"us_per_inch": _pair(f"{us_per_inch:.9f}"), "delay_ns": round(delay_ns), **provenance}
        return check(merged(config, {HEAD: head}, {}))
    poly = [_pair(f"{coefficient:.{DIGITS - 1}e}") for coefficient in calibration.fit.poly]
    entries = {"calibration": {"unit": "m", "poly": poly, **provenance}}
    return check(merged(config, {}, {channel_names(config).index(calibration.channel.name): entries}))


def _serial(config: Mapping[str, Any], name: str) -> str:
    entries = [entry.get("calibration", {}) for entry in config["channels"] if entry["name"] == name]
    return str((entries or [config[HEAD]])[0].get("serial", ""))


def _pair(text: str) -> list[int]:
    with raising(ConfigError, "the calibration"):
        return mantissa_exponent(Decimal(text))


def gauge_page(calibration: Calibration, options: GaugeOptions, ident: Ident, config: dict[str, Any]) -> str:
    """Return the page of a calibration as HTML; ``config`` is what the box will store."""
    fit, places, name = calibration.fit, calibration.places, calibration.channel.name
    time, temperature, previous = datetime.now(UTC), places.temperature, calibration.previous_error
    n_places, ends = len(places.places), (places.references.min(), places.references.max())
    serial = _serial(config, name)
    total = None if options.uncertainty is None else math.hypot(2.0 * fit.sigma, options.uncertainty)
    subject = (
        ("sensor", f"{name}, serial {serial}" if serial else name),
        ("operator", options.operator or "not given"),
        ("date", f"{time:%Y-%m-%d %H:%M} UTC"),
        ("box", f"{places.uid or 'without a uid'}, firmware {one_line(ident.firmware[:32]) or 'not known'}"),
        ("software", f"truearm {VERSION}"),
        ("temperature of the box", "unknown" if temperature is None else DEGC.text(temperature, ".1f")),
    )
    reference = (
        ("reference instrument", options.instrument or "not given"),
        ("its uncertainty (k = 2)", _um(options.uncertainty)),
        ("places", f"{n_places}, from {' to '.join(MM.text(end, '.4f') for end in ends)}"),
    )
    uncertainty = (
        ("of one place, from the scatter about the calibration (k = 2)", _um(2.0 * fit.sigma)),
        ("of a calibrated length, including the reference (k = 2)", _um(total, UNKNOWN_TOTAL)),
        ("largest residual", calibration.largest_residual),
        ("the previous calibration", "none" if previous is None else f"off by {_um(previous)} RMS at these references"),
    )
    curve = [("order", str(fit.order)), ("coefficients", ", ".join(f"{coefficient:.6g}" for coefficient in fit.poly))]
    if name == HEAD:
        us_per_inch, delay_ns = head_of(fit)
        curve.append(("velocity", f"{us_per_inch:.6f} µs per inch, delay {round(delay_ns)} ns"))
    groups = ("What", subject), ("Reference", reference), ("Uncertainty", uncertainty), ("The curve", tuple(curve))
    orders = [
        (f"{tried.order}{' (chosen)' * (tried.order == fit.order)}", figures(UM.of(tried.press)))
        for tried in calibration.tried
    ]
    blocks = (
        section("Residuals", pictures([_residuals(calibration)])),
        section("The order", paragraph(ORDER_TEXT), table(Table(("order", "RMS [µm]"), orders))),
        section("The places", table(_place_table(calibration))),
    )
    subtitle = f"{counted(n_places, 'place')}, {time.date().isoformat()}"
    first = certificate_section(Certificate("Calibration of a sensor", groups))
    return html_page("truearm", f"Calibration of {name}", subtitle, blocks, certificate=first)


def _residuals(calibration: Calibration) -> Figure:
    x, y = MM.of(calibration.places.references), UM.of(calibration.fit.residual)
    two_sigma = UM.of(2.0 * calibration.fit.sigma)
    reach = 1.05 * max(float(np.abs(y).max()), two_sigma, 1e-3)
    plot = svg.Plot(
        svg.linear_axis("reference [mm]", x.min(), x.max()), svg.linear_axis("residual [µm]", -reach, reach)
    )
    ends = [plot.x.low, plot.x.high]
    for level, css, name in ((-two_sigma, "old line", "± 2 σ"), (two_sigma, "old line", ""), (0.0, "mean line", "")):
        plot.line(ends, [level, level], css, name)
    tips = (f"{figures(a, 6)} mm: {number(b, 2, sign=True)} µm" for a, b in zip(x, y, strict=True))
    plot.scatter(x, y, "fit", tips, "places", 3.2)
    return plot.figure("Residual at each place", RESIDUAL_CAPTION)


def _place_table(calibration: Calibration) -> Table:
    unit = f"[{calibration.channel.unit}]"
    residuals = "residual [µm]", "residual to a fit of the others [µm]"
    errors = UM.of(np.stack([calibration.fit.residual, calibration.fit.deleted_residual], axis=1))
    rows = [
        (
            str(i),
            number(MM.of(place.reference), 4),
            figures(place.mean.value, 8),
            figures(math.sqrt(place.mean.value_var), 2),
            *(number(error, 3, sign=True) for error in row),
        )
        for i, (place, row) in enumerate(zip(calibration.places.places, errors, strict=True), 1)
    ]
    return Table(("", "reference [mm]", f"reading {unit}", f"noise {unit}", *residuals), rows, "places")
