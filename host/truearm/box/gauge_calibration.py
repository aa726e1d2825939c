"""A sensor's calibration from places of a reference: the places, the polynomial, and a page that says how good it is.

At each of n places, the reference gives y_i and the sensor x_i, a mean over seconds with little noise. The fit uses
Legendre polynomials over the readings' span, whose columns A = QR are nearly orthogonal.

**Choosing the order.** A higher order leaves smaller residuals e. Left out, point i is predicted with the error

    e_i / (1 − h_i) ,   h the diagonal of QQᵀ

(Allen, Technometrics 16, 1974, 125, eq. 3.2; PRESS). The mean square of these errors is uncertain by some tens of
percent. The lowest order within one standard error of the best one is chosen (Breiman and others, 1984, §3.4.3). It is
the true order in 76 to 93 % of simulated cases; the least mean square alone finds it in 61 to 76 %
(tests/host/test_gauge_polynomial.py).

The places are written to a file after each, so a run that ends early (Ctrl-C, a cable, the computer) loses nothing: the
next run continues from it. It holds no calibration, and nothing else reads it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from decimal import Decimal
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.polynomial import Legendre, Polynomial, polynomial
from numpy.polynomial.legendre import legvander

from truearm.box.configuration import channel_names, check, mantissa_exponent, merged
from truearm.box.requests import GaugeOptions
from truearm.disk import read_bytes, read_text, write_atomic
from truearm.errors import Argument, ConfigError, InputError, TableError, WriteError
from truearm.kinds.csv_cells import read_csv
from truearm.report import svg
from truearm.report.page import (
    Certificate,
    Figure,
    certificate_section,
    figures,
    html_page,
    number,
    paragraph,
    pictures,
    section,
    table,
)
from truearm.report.tables import Table
from truearm.schema import raising
from truearm.session.box_ident import Channel, Ident
from truearm.session.sample_noise import MeanOfSamples
from truearm.text import counted, one_line, page
from truearm.types import Floats, rms
from truearm.units import DEGC, INCH, MDEGC, MM, NS, UM, US, named, suffixes
from truearm.version import VERSION

MAX_ORDER = 7
SPARE = 2  # more points than coefficients by this many, so that σ is meaningful
TICK_S = 8e-9
UNITS = suffixes("m", ("mm", "um", "in"))
FEWEST_PLACES = 5
MAX_REFERENCES = 1000
MAX_BYTES = 1 << 20  # 1000 places of 200 bytes
MAX_METRES = 10.0
PAGE = page("Set up the sensor box")
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
class PolyFit:
    """A polynomial y = Σ poly[k] x^k through n points, in the reference's unit.

    ``residual`` (n,): reference − polynomial. ``deleted_residual`` (n,): each residual if its point had not been used.
    ``sigma``: √(Σ residual² / degrees of freedom).
    """

    order: int
    poly: Floats
    residual: Floats
    deleted_residual: Floats
    sigma: float

    @property
    def press(self) -> float:
        return rms(self.deleted_residual)


def distinct_places(x: Floats) -> int:
    """Return the number of distinct positions in readings x (n,).

    Readings closer than a thousandth of the span count as one: a position visited in both directions is not two.
    """
    span = float(np.ptp(x)) if x.size else 0.0
    return 1 + int(np.count_nonzero(np.diff(np.sort(x)) > 1e-3 * span)) if span > 0.0 else min(x.size, 1)


def possible_orders(x: Floats, highest: int = MAX_ORDER) -> range:
    """Return the orders allowed by readings x (n,): SPARE points more than coefficients, fewer powers than positions."""
    return range(1, min(highest, x.size - 1 - SPARE, distinct_places(x) - 2) + 1)


def fit(x: Floats, y: Floats, order: int) -> PolyFit:
    """Fit the least-squares polynomial of one of the ``possible_orders``."""
    series = Legendre.fit(x, y, order)
    offset, scale = series.mapparms()
    q, _ = np.linalg.qr(legvander(offset + scale * x, order))
    residual = y - q @ (q.T @ y)
    sigma = math.sqrt(float(residual @ residual) / (y.size - order - 1))
    poly = np.asarray(series.convert(kind=Polynomial).coef, np.float64)
    return PolyFit(order, poly, residual, residual / (1.0 - np.sum(q**2, axis=1)), sigma)


def fits(x: Floats, y: Floats, highest: int = MAX_ORDER) -> list[PolyFit]:
    """Return the fits of all possible orders, lowest first; [] if there are too few points."""
    return [fit(x, y, order) for order in possible_orders(x, highest)]


def chosen(candidates: Sequence[PolyFit]) -> PolyFit:
    """Return the lowest order that predicts left-out points as well as the best one does, within one standard error."""
    best = min(candidates, key=lambda candidate: candidate.press)
    squares = best.deleted_residual**2
    bound = np.mean(squares) + np.std(squares, ddof=1) / math.sqrt(squares.size)
    return next(candidate for candidate in candidates if candidate.press**2 <= bound)


def head_of(line: PolyFit) -> tuple[float, float]:
    """Return the µs per inch and the delay [ns] of a magnetostrictive head from a line y [m] over x [s].

    Position = velocity · (time of flight + half a tick − delay) (SPEC §5). Raises ValueError for the wrong slope.
    """
    offset, velocity = line.poly
    if not velocity > 0.0:
        raise ValueError("the position must rise with the time of flight; check the signs of the reference")
    return US.of(INCH.to_si(1.0) / velocity), NS.of(TICK_S / 2.0 - offset / velocity)


@dataclass(frozen=True)
class Place:
    """A reference position [m]: the sensor's mean reading in the channel's unit, and the box's temperature [°C]."""

    reference: float
    mean: MeanOfSamples
    temperature: float | None


@dataclass(frozen=True)
class Places:
    """The places of a ``channel`` of the box with this ``uid``; one count is ``scale`` of the channel's ``unit``."""

    uid: str
    channel: str
    unit: str
    scale: float
    places: list[Place] = field(default_factory=list)

    @property
    def readings(self) -> Floats:
        """The mean readings (n,) in the channel's unit."""
        return np.array([place.mean.value for place in self.places])

    @property
    def references(self) -> Floats:
        """The references (n,) [m]."""
        return np.array([place.reference for place in self.places])

    @property
    def temperature(self) -> float | None:
        """The mean temperature of the box [°C]; None if it was not read."""
        temperatures = [place.temperature for place in self.places if place.temperature is not None]
        return sum(temperatures) / len(temperatures) if temperatures else None

    def too_few(self) -> InputError | None:
        """Return why these places are not enough for a calibration; None if they are."""
        distinct, n = distinct_places(self.readings), len(self.places)
        again = n if n > distinct else None
        few = InputError("few-places", measured=True, distinct=distinct, n=again, least=FEWEST_PLACES)
        return few if distinct < FEWEST_PLACES else None

    def line(self, number: int) -> str:
        """Return what was measured at a place, counted from 1."""
        place = self.places[number - 1]
        noise = f"noise {place.mean.noise:.2g}, mean ± {math.sqrt(place.mean.value_var):.2g} {self.unit}"
        reading = f"{MM.text(place.reference, '.4f')} at {place.mean.value:.8g} {self.unit}"
        return f"  {one_line(f'{number}: {reading} ({noise})')}"

    def write(self, path: Path, say: Callable[[str], None]) -> None:
        """Write all places; the run goes on without the file if the disk refuses it."""
        try:
            write_atomic(path, msgspec.json.encode(self, enc_hook=float).decode())  # some are NumPy's
        except (InputError, WriteError) as exc:
            say(f"  {exc}; if this run ends early, its places are lost")

    def earlier(self, path: Path) -> Places:
        """Return the places that an earlier run for the same channel and box kept; without a file, this object.

        Raises InputError for a file of something else.
        """
        if not path.exists():
            return self
        try:
            places = msgspec.json.decode(read_bytes(path, MAX_BYTES, InputError), type=Places)
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as exc:
            raise InputError(f"{path}: holds no places of a gauging: {exc}; remove it") from None
        if replace(places, places=[]) != replace(self, places=[]):
            raise InputError(
                f"{path}: holds places of another box, channel or gain ({places.channel[:40]!r} of box {places.uid[:40]!r}); "
                "move it to another folder, or remove it"
            )
        return places


def read_references(path: Path) -> list[float]:
    """Return the references [m] in a CSV file. Raises TableError."""
    titles = {named("reference", unit): ("reference", unit) for unit in UNITS}
    table = read_csv(read_text(path, MAX_BYTES, TableError), str(path), titles, PAGE, r"(?!reference_).*")
    if len(table.rows) > MAX_REFERENCES:
        raise TableError(f"{path}: has {len(table.rows)} references; 1 to {MAX_REFERENCES} are possible")
    return list(map(float, table.numbers("reference", MAX_METRES, required=True)))


def parse_reference(text: str, scale: float) -> float | None:
    """Return a typed reference [m]; None if the text is not a reading."""
    try:
        value = float(text.replace(",", ".")) * scale
    except ValueError:
        return None
    return value if abs(value) <= MAX_METRES else None


def check_references(references: Sequence[float], measured: Sequence[float], stroke: float, file: str) -> None:
    """Raise InputError if references [m] of a file, with those ``measured`` before, make no calibration.

    They are too few different ones, or farther apart than the sensor's ``stroke`` [m].
    """
    if (different := len({*references, *measured})) < FEWEST_PLACES:
        raise InputError("few-places", place=file, distinct=different, least=FEWEST_PLACES)
    if error := beyond(max(references), [min(references)], stroke):
        raise error.within(file)


def beyond(reference: float, references: Sequence[float], stroke: float) -> InputError | None:
    """Return that a reference is farther from one of the others than the sensor's stroke; None if it is not."""
    farthest = max(references, key=lambda value: abs(value - reference), default=reference)
    if abs(farthest - reference) <= stroke:
        return None
    first, second, apart = (MM.text(value, ".4f") for value in (reference, farthest, abs(reference - farthest)))
    return InputError("place-beyond", first=first, second=second, apart=apart, stroke=MM.text(stroke, ".0f"))


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
