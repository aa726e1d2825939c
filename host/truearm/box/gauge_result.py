"""Turn the positions measured by ``truearm box gauge`` into the calibration, as text, as a page, and for the box."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from decimal import Decimal
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from truearm.errors import Argument, ConfigError, InputError
from truearm.schema import raising
from truearm.text import counted
from truearm.types import rms
from truearm.units import MM, UM
from truearm.version import VERSION

if TYPE_CHECKING:
    from truearm.box.gauge_places import Place
    from truearm.box.gauge_polynomial import PolyFit
    from truearm.report.certificate import Facts
    from truearm.session.box_ident import Channel, Stream
    from truearm.types import Floats

MAG = "mag"  # name of the magnetostrictive stream
HEAD = "magnetostrictive"
FEWEST_PLACES = 5
ROUNDING = 1e-9  # m, allowed difference between the stored decimals and the fit


@dataclass(frozen=True)
class GaugeCircumstances:
    """How, by whom and on which box a channel was calibrated; "" for what is not known.

    ``uncertainty`` [m] is the expanded uncertainty (k = 2) of the reference ``instrument``, None if unknown.
    """

    channel: str
    instrument: str = ""
    uncertainty: float | None = None
    operator: str = ""
    uid: str = ""
    firmware: str = ""
    serial: str = ""  # of the sensor


def calibrate(places: Sequence[Place], order: int | None, linear: bool) -> tuple[PolyFit, list[PolyFit]]:
    """Return the calibration, and all fits that were tried. Raises InputError."""
    from truearm.box.gauge_polynomial import MAX_ORDER, chosen, fits

    x, y = _readings(places), _references(places)
    if missing := too_few(places):
        raise InputError(missing)
    tried = fits(x, y, 1 if linear else MAX_ORDER)
    if order is not None and not linear and order > tried[-1].order:
        raise InputError(
            Argument("order"),
            f" {order} needs more places; {counted(len(places), 'place allows', 'places allow')} order {tried[-1].order}",
        )
    fit = tried[0] if linear else chosen(tried) if order is None else tried[order - 1]
    return replace(fit, sigma=max(fit.sigma, _of_means(places, fit))), tried


def too_few(places: Sequence[Place]) -> str:
    """Return why these places are not enough for a calibration; "" if they are."""
    from truearm.box.gauge_polynomial import distinct_places

    if (distinct := distinct_places(_readings(places))) >= FEWEST_PLACES:
        return ""
    again = (
        f" ({counted(len(places), 'reading')}; those of the same sensor value count once)"
        if len(places) > distinct
        else ""
    )
    return f"places measured: {distinct}{again}; a calibration needs {FEWEST_PLACES} or more, over the whole travel"


def _of_means(places: Sequence[Place], fit: PolyFit) -> float:
    """Return the standard deviation [m] of a position from the noise of its mean alone.

    This is a lower limit: few residuals may happen to be smaller.
    """
    slope = np.polynomial.polynomial.polyval(_readings(places), np.polynomial.polynomial.polyder(fit.poly))
    return rms(np.asarray(slope * np.sqrt([place.mean.variance for place in places]), dtype=np.float64))


def _readings(places: Sequence[Place]) -> Floats:
    return np.array([place.mean.mean for place in places])


def _references(places: Sequence[Place]) -> Floats:
    return np.array([place.reference for place in places])


def words(places: Sequence[Place], result: PolyFit, tried: Sequence[PolyFit], channel: Channel) -> list[str]:
    lines = [
        f"order {f.order}: cross-validation error {UM.text(f.press, '.2f')} RMS{' ← chosen' if f.order == result.order else ''}"
        for f in tried
    ]
    lines.append(
        f"{counted(len(places), 'place')}, sigma {UM.text(result.sigma, '.2f')}, largest residual {UM.text(_largest(result), '.2f')}"
    )
    before = _before(places, channel)
    if before is not None:
        lines.append(f"the previous calibration is off by {UM.text(before, '.2f')} RMS")
    return lines


def _largest(result: PolyFit) -> float:
    return float(np.max(np.abs(result.residual)))


def _before(places: Sequence[Place], channel: Channel) -> float | None:
    """Return the residual [m RMS] of the channel's present calibration."""
    unit = channel.length_unit
    if unit is None:
        return None
    residual = _references(places) - unit.to_si(np.polynomial.polynomial.polyval(_readings(places), channel.poly))
    return rms(residual)


def with_calibration(
    config: dict[str, Any],
    stream: Stream,
    index: int,
    places: Sequence[Place],
    result: PolyFit,
    serial: str | None,
    instrument: str = "",
    uncertainty: float | None = None,
) -> dict[str, Any]:
    """Return the configuration with the new calibration, checked. Raises InputError.

    ``instrument`` and ``uncertainty`` as in ``GaugeCircumstances``.
    """
    from truearm.box.configuration_schema import PROVENANCE, check

    channels = [dict(channel) for channel in config["channels"]]
    before = config[HEAD] if stream.name == MAG else channels[index].get("calibration", {})
    provenance = {
        "serial": before.get("serial", "") if serial is None else serial,
        "date": datetime.now(UTC).date().isoformat(),
        "sigma": _pair(f"{result.sigma:.2e}"),
        **_temperature(places),
        **({"reference": instrument} if instrument else {}),
        **({} if uncertainty is None else {"reference_sigma": _pair(f"{0.5 * uncertainty:.3e}")}),
    }
    if stream.name == MAG:
        others = {name: value for name, value in before.items() if name not in {key.called for key in PROVENANCE}}
        return check({**config, HEAD: {**others, **_head(result), **provenance}})
    poly = [_pair(text) for text in _rounded(result, places)]
    channels[index]["calibration"] = {"unit": "m", "poly": poly, **provenance}
    return check({**config, "channels": channels})


def _rounded(result: PolyFit, places: Sequence[Place]) -> list[str]:
    from truearm.box.gauge_polynomial import rounded

    readings = _readings(places)
    return rounded(result.poly, np.linspace(readings.min(), readings.max(), 101), ROUNDING)


def _pair(text: str) -> list[int]:
    from truearm.box.configuration_schema import mantissa_exponent

    with raising(ConfigError, "the calibration"):
        return mantissa_exponent(Decimal(text))


def _head(result: PolyFit) -> dict[str, Any]:
    from truearm.box.gauge_polynomial import head_of

    try:
        head = head_of(result)
    except ValueError as exc:
        raise InputError(f"these places do not give a calibration: {exc}") from exc
    return {"us_per_inch": _pair(f"{head.us_per_inch:.9f}"), "delay_ns": round(head.delay_ns)}


def _temperature(places: Sequence[Place]) -> dict[str, int]:
    temperatures = [place.temperature for place in places if place.temperature is not None]
    return {"temperature_mdegc": round(1000 * sum(temperatures) / len(temperatures))} if temperatures else {}


def write_page(
    path: Path,
    of: GaugeCircumstances,
    channel: Channel,
    places: Sequence[Place],
    result: PolyFit,
    tried: Sequence[PolyFit],
    new: dict[str, Any],
) -> None:
    """Write the page of a calibration; ``new`` is the configuration that the box will store."""
    from truearm.files.disk import write_atomic
    from truearm.report.gauge_page import GaugePage, render

    page = GaugePage(
        title=f"Calibration of {of.channel}",
        subtitle=f"{counted(len(places), 'place')}, {datetime.now(UTC).date().isoformat()}",
        unit=channel.unit,
        reference=_references(places),
        reading=_readings(places),
        noise=np.array([math.sqrt(place.mean.variance) for place in places]),
        residual=result.residual,
        left_out=result.left_out,
        sigma=result.sigma,
        orders=tuple(f.order for f in tried),
        press=np.array([f.press for f in tried]),
        order=result.order,
        certificate=_certificate(of, channel, places, result, new),
    )
    write_atomic(path, render(page))


def _certificate(
    of: GaugeCircumstances, channel: Channel, places: Sequence[Place], result: PolyFit, new: dict[str, Any]
) -> tuple[tuple[str, Facts], ...]:
    """Return page one: what was calibrated, against what, and how well."""
    degc = _temperature(places).get("temperature_mdegc")
    before, low, high = _before(places, channel), _references(places).min(), _references(places).max()
    subject = (
        ("sensor", f"{of.channel}, serial {of.serial}" if of.serial else of.channel),
        ("operator", of.operator or "not given"),
        ("date", f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC"),
        ("box", f"{of.uid or 'without a uid'}, firmware {of.firmware or 'not known'}"),
        ("software", f"truearm {VERSION}"),
        ("temperature of the box", "unknown" if degc is None else f"{degc / 1000:.1f} °C"),
    )
    reference = (
        ("reference instrument", of.instrument or "not given"),
        ("its uncertainty (k = 2)", "not given" if of.uncertainty is None else UM.text(of.uncertainty, ".2f")),
        ("places", f"{len(places)}, from {MM.text(low, '.4f')} to {MM.text(high, '.4f')}"),
    )
    spread = UM.text(2.0 * result.sigma, ".2f")
    total = "not known without the reference's uncertainty"
    if of.uncertainty is not None:
        total = UM.text(math.hypot(2.0 * result.sigma, of.uncertainty), ".2f")
    outcome = (
        ("of one place, from the scatter about the calibration (k = 2)", spread),
        ("of a calibrated length, including the reference (k = 2)", total),
        ("largest residual", UM.text(_largest(result), ".2f")),
        (
            "the previous calibration",
            "none" if before is None else f"off by {UM.text(before, '.2f')} RMS at these references",
        ),
    )
    curve = [
        ("order", str(result.order)),
        ("coefficients", ", ".join(f"{c:.6g}" for c in result.poly)),
        ("standard deviations of the coefficients", ", ".join(f"{s:.2g}" for s in np.sqrt(np.diag(result.covariance)))),
    ]
    if of.channel == HEAD:
        pair = new[HEAD]["us_per_inch"]
        curve.append(("velocity", f"{pair[0] * 10.0 ** pair[1]:.6f} µs per inch, delay {new[HEAD]['delay_ns']} ns"))
    return ("What", subject), ("Reference", reference), ("Uncertainty", outcome), ("The curve", tuple(curve))
