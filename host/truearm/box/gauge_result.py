"""What ``truearm box gauge`` makes of the places it was shown: the calibration, in words, on a page, and for the box."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from decimal import Decimal
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from truearm.errors import Argument, ConfigError, InputError
from truearm.schema import raising
from truearm.types import rms
from truearm.units import UM

if TYPE_CHECKING:
    from truearm.box.gauge_polynomial import PolyFit
    from truearm.session.box_ident import Channel, Stream
    from truearm.session.samples import MeanOfSamples
    from truearm.types import Floats

MAG = "mag"  # the stream of
HEAD = "magnetostrictive"
FEWEST_PLACES = 5
ROUNDING = 1e-9  # m, that the stored decimals may differ from the fit


@dataclass(frozen=True)
class Place:
    """The sensor at one reference [m]: its mean reading in the channel's unit, the box's temperature [°C] meanwhile."""

    reference: float
    mean: MeanOfSamples
    temperature: float | None


def calibrate(places: Sequence[Place], order: int | None, linear: bool) -> tuple[PolyFit, list[PolyFit]]:
    """The calibration, and all that were tried. Raises InputError."""
    from truearm.box.gauge_polynomial import MAX_ORDER, chosen, distinct_places, fits

    x, y = _readings(places), _references(places)
    if (distinct := distinct_places(x)) < FEWEST_PLACES:
        again = f", some of them more than once ({len(places)} readings)" if len(places) > distinct else ""
        raise InputError(
            f"places taken: {distinct}{again}; a calibration needs {FEWEST_PLACES} or more, over the whole travel"
        )
    tried = fits(x, y, 1 if linear else MAX_ORDER)
    if linear:
        return tried[0], tried
    if order is None:
        return chosen(tried), tried
    if order > tried[-1].order:
        raise InputError(Argument("order"), f" {order} needs more places; {len(places)} allow {tried[-1].order}")
    return tried[order - 1], tried


def _readings(places: Sequence[Place]) -> Floats:
    return np.array([place.mean.mean for place in places])


def _references(places: Sequence[Place]) -> Floats:
    return np.array([place.reference for place in places])


def words(places: Sequence[Place], result: PolyFit, tried: Sequence[PolyFit], channel: Channel) -> list[str]:
    lines = [
        f"order {f.order}: left-out error {UM.text(f.press, '.2f')} RMS{' ← taken' if f is result else ''}"
        for f in tried
    ]
    lines.append(
        f"{len(places)} places, sigma {UM.text(result.sigma, '.2f')}, largest residual {UM.text(_largest(result), '.2f')}"
    )
    before = _before(places, channel)
    if before is not None:
        lines.append(f"the calibration before misses these references by {UM.text(before, '.2f')} RMS")
    return lines


def _largest(result: PolyFit) -> float:
    return float(np.max(np.abs(result.residual)))


def _before(places: Sequence[Place], channel: Channel) -> float | None:
    """What the channel's present calibration leaves [m RMS]."""
    unit = channel.length_unit
    if unit is None:
        return None
    left = _references(places) - unit.to_si(np.polynomial.polynomial.polyval(_readings(places), channel.poly))
    return rms(left)


def with_calibration(
    config: dict[str, Any], stream: Stream, index: int, places: Sequence[Place], result: PolyFit, serial: str | None
) -> dict[str, Any]:
    """The configuration with the new calibration in it, checked. Raises InputError."""
    from truearm.box.configuration_schema import check

    date = datetime.now(UTC).date().isoformat()
    if stream.name == MAG:
        before = config[HEAD]
        new = {
            **config,
            HEAD: {**before, **_head(result), "date": date, "serial": before["serial"] if serial is None else serial},
        }
        return check(new)
    channels = [dict(channel) for channel in config["channels"]]
    before = channels[index].get("calibration", {})
    channels[index]["calibration"] = {
        "unit": "m",
        "poly": [_pair(text) for text in _rounded(result, places)],
        "serial": before.get("serial", "") if serial is None else serial,
        "date": date,
        "sigma": _pair(f"{result.sigma:.2e}"),
        **_temperature(places),
    }
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
        raise InputError(f"the places make no calibration: {exc}") from exc
    return {"us_per_inch": _pair(f"{head.us_per_inch:.9f}"), "delay_ns": round(head.delay_ns)}


def _temperature(places: Sequence[Place]) -> dict[str, int]:
    known = [place.temperature for place in places if place.temperature is not None]
    return {"temperature_mdegc": round(1000 * sum(known) / len(known))} if known else {}


def write_page(
    path: Path,
    name: str,
    channel: Channel,
    places: Sequence[Place],
    result: PolyFit,
    tried: Sequence[PolyFit],
    new: dict[str, Any],
) -> None:
    from truearm.files.disk import write_atomic
    from truearm.report.gauge_page import GaugePage, render

    temperature = _temperature(places).get("temperature_mdegc")
    facts = [
        ("order", str(result.order)),
        ("coefficients", ", ".join(f"{c:.6g}" for c in result.poly)),
        ("standard deviations of these", ", ".join(f"{s:.2g}" for s in np.sqrt(np.diag(result.covariance)))),
        ("sigma", UM.text(result.sigma, ".2f")),
        ("largest residual", UM.text(_largest(result), ".2f")),
        ("the calibration before", "none" if (b := _before(places, channel)) is None else f"{UM.text(b, '.2f')} RMS"),
        ("temperature of the box", "unknown" if temperature is None else f"{temperature / 1000:.1f} °C"),
    ]
    if name == HEAD:
        pair = new[HEAD]["us_per_inch"]
        facts.append(("velocity", f"{pair[0] * 10.0 ** pair[1]:.6f} µs an inch, delay {new[HEAD]['delay_ns']} ns"))
    page = GaugePage(
        title=f"Calibration of {name}",
        subtitle=f"{len(places)} places, {datetime.now(UTC).date().isoformat()}",
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
        facts=tuple(facts),
    )
    write_atomic(path, render(page))
