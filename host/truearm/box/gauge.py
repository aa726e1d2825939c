"""Calibrate a sensor against reference readings and store the result in the box (``truearm box gauge``).

At each of n places, the reference gives y_i and the sensor x_i, a mean over seconds with little noise. The fit uses
Legendre polynomials over the readings' span, whose columns A = QR are nearly orthogonal.

**Choosing the order.** A higher order leaves smaller residuals e. Left out, point i is predicted with the error

    e_i / (1 − h_i) ,   h the diagonal of QQᵀ

(Allen, Technometrics 16, 1974, 125, eq. 3.2; PRESS). The mean square of these errors is uncertain by some tens of
percent. The lowest order within one standard error of the best one is chosen (Breiman and others, 1984, §3.4.3). It is
the true order in 76 to 93 % of simulated cases; the least mean square alone finds it in 61 to 76 %
(tests/host/test_gauge_polynomial.py).

The places are written to a file after each, so a run that ends early (Ctrl-C, a cable, the computer) loses nothing: the
next run continues from it. It holds no calibration, and nothing else reads it. A page says how good the result is.
"""

from __future__ import annotations

import math
import re
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
from numpy.typing import NDArray

from truearm.box.condition import usable_channel
from truearm.box.configuration import change_lines, channel_names, check, checked_config, mantissa_exponent, merged
from truearm.box.control import FEWEST, BoxControl, conversation, sample
from truearm.box.requests import GaugeOptions
from truearm.disk import check_writable, read_bytes, read_text, write_atomic
from truearm.errors import Argument, ConfigError, InputError, TableError, TruearmError, WriteError
from truearm.findings import Finding, option
from truearm.kinds.csv_cells import read_csv
from truearm.report import page, svg
from truearm.report.tables import Table
from truearm.schema import raising
from truearm.session.dwells import MeanOfSamples, mean_of, quick_noise
from truearm.session.frames import Channel, Ident, Stream
from truearm.session.samples import railed, volts
from truearm.text import counted, one_line
from truearm.text import page as docs_page
from truearm.types import Floats, rms
from truearm.units import DEGC, INCH, MDEGC, MM, NS, UM, US, named, suffixes
from truearm.version import VERSION

Say = Callable[[str], None]  # shows a line to who sets the references
Ask = Callable[[str], str | None]  # returns what is typed after a prompt, None at the end of the input

MAX_ORDER = 7
SPARE = 2  # more points than coefficients by this many, so that σ is meaningful
TICK_S = 8e-9
UNITS = suffixes("m", ("mm", "um", "in"))
FEWEST_PLACES = 5
MAX_REFERENCES = 1000
MAX_BYTES = 1 << 20  # 1000 places of 200 bytes
MAX_METRES = 10.0
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
STROKE = 0.1  # m, of a displacement transducer; the ball-bar's LVDT has 75 mm
SOUND = 2850.0  # m/s, highest velocity in the rod of a magnetostrictive sensor
STILL_MOVES = 6.0  # standard deviations of the mean of one piece
PIECES = 8  # of the samples at a position


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
    """Return the orders allowed by readings x (n,): SPARE more points than coefficients, fewer powers than places."""
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

    Position = velocity · (time of flight + half a tick − delay) (SPEC §5). Raises InputError for the wrong slope.
    """
    offset, velocity = line.poly
    if not velocity > 0.0:
        reason = "the position must rise with the time of flight; check the signs of the reference"
        raise InputError(f"these places do not give a calibration: {reason}")
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

    def write(self, path: Path, say: Say) -> None:
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
    text, advice = read_text(path, MAX_BYTES, TableError), docs_page("Set up the sensor box")
    table = read_csv(text, str(path), titles, advice, r"(?!reference_).*")
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
        us_per_inch, delay_ns = head_of(calibration.fit)
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
        (f"{tried.order}{' (chosen)' * (tried.order == fit.order)}", page.figures(UM.of(tried.press)))
        for tried in calibration.tried
    ]
    blocks = (
        page.section("Residuals", page.pictures([_residuals(calibration)])),
        page.section("The order", page.paragraph(ORDER_TEXT), page.table(Table(("order", "RMS [µm]"), orders))),
        page.section("The places", page.table(_place_table(calibration))),
    )
    subtitle = f"{counted(n_places, 'place')}, {time.date().isoformat()}"
    first = page.certificate_section(page.Certificate("Calibration of a sensor", groups))
    return page.html_page("truearm", f"Calibration of {name}", subtitle, blocks, certificate=first)


def _residuals(calibration: Calibration) -> page.Figure:
    x, y = MM.of(calibration.places.references), UM.of(calibration.fit.residual)
    two_sigma = UM.of(2.0 * calibration.fit.sigma)
    reach = 1.05 * max(float(np.abs(y).max()), two_sigma, 1e-3)
    plot = svg.Plot(
        svg.linear_axis("reference [mm]", x.min(), x.max()), svg.linear_axis("residual [µm]", -reach, reach)
    )
    ends = [plot.x.low, plot.x.high]
    for level, css, name in ((-two_sigma, "old line", "± 2 σ"), (two_sigma, "old line", ""), (0.0, "mean line", "")):
        plot.line(ends, [level, level], css, name)
    tips = (f"{page.figures(a, 6)} mm: {page.number(b, 2, sign=True)} µm" for a, b in zip(x, y, strict=True))
    plot.scatter(x, y, "fit", tips, "places", 3.2)
    return plot.figure("Residual at each place", RESIDUAL_CAPTION)


def _place_table(calibration: Calibration) -> Table:
    unit = f"[{calibration.channel.unit}]"
    residuals = "residual [µm]", "residual to a fit of the others [µm]"
    errors = UM.of(np.stack([calibration.fit.residual, calibration.fit.deleted_residual], axis=1))
    rows = [
        (
            str(i),
            page.number(MM.of(place.reference), 4),
            page.figures(place.mean.value, 8),
            page.figures(math.sqrt(place.mean.value_var), 2),
            *(page.number(error, 3, sign=True) for error in row),
        )
        for i, (place, row) in enumerate(zip(calibration.places.places, errors, strict=True), 1)
    ]
    return Table(("", "reference [mm]", f"reading {unit}", f"noise {unit}", *residuals), rows, "places")


def gauge_channel(device: str, options: GaugeOptions, say: Say, ask: Ask) -> None:
    """Sample a channel at references, fit its calibration and write the page.

    The calibration is stored in the box if the operator agrees.

    Raises InputError, TableError, LinkError.
    """
    listed = None if options.references is None else read_references(options.references)
    name = re.sub(r"[^\w-]", "_", options.channel[:40])
    out = options.out or Path(f"gauge-{name}.html")
    places_file = out.with_suffix(".places.json")
    # a page beside such a file belongs to the same run: it was interrupted at the last question
    inputs = [] if options.references is None else [options.references]
    check_writable(out, options.force or places_file.exists(), inputs=inputs, kind="page")
    with conversation(device, stop=options.stop) as box:
        ident, config = box.ident, checked_config(box)
        stream, index = usable_channel(ident, options.channel, device)
        channel = stream.channels[index]
        places = _continued(places_file, ident, channel, say, ask)
        run = GaugeRun(box, stream, channel, options, say, ask, places_file, places)
        try:
            run.measure(listed)
            calibration = calibrate(places, channel, options.order)
            for line in calibration.lines():
                say(line)
            new = with_calibration(config, calibration, options)
            write_atomic(out, gauge_page(calibration, options, ident, new))
            changes = change_lines(config, new)
            for line in (f"{out}: residuals and orders", *changes):
                say(line)
            if not changes:
                say("the box has this calibration already")
            elif options.yes or (ask("store it in the box? [y/N] ") or "").lower() in ("y", "yes"):
                box.put_config(new)
                say(f"{device}: stored; the box uses it from now on")
            else:
                say(f"{device}: unchanged; {places_file} keeps the places")
                return
            places_file.unlink(missing_ok=True)
        except (KeyboardInterrupt, TruearmError):
            if places.places:
                say(f"\n{places_file} keeps the places; the same command continues from them")
            raise


def _continued(places_file: Path, ident: Ident, channel: Channel, say: Say, ask: Ask) -> Places:
    """Return the places of a run that ended early, if the operator wants them. Raises InputError."""
    uid = one_line(str(ident.document.get("uid", ""))[:32])
    empty = Places(uid, channel.name, channel.unit, channel.scale)
    earlier = empty.earlier(places_file)
    if earlier.places:
        n_places = counted(len(earlier.places), "place")
        say(f"{places_file}: {n_places} from a run whose calibration was not stored")
        question = "continue from there? Only if sensor and reference stayed mounted as they were [Y/n] "
        if (ask(question) or "y").lower() not in ("y", "yes"):
            return empty
        for number in range(1, len(earlier.places) + 1):
            say(earlier.line(number))
    return earlier


@dataclass(frozen=True)
class GaugeRun:
    """The measurement of places, which are kept in ``places_file``."""

    box: BoxControl
    stream: Stream
    channel: Channel
    options: GaugeOptions
    say: Say
    ask: Ask
    places_file: Path
    places: Places

    @property
    def stroke(self) -> float:
        """The greatest distance [m] of two references: the pulse of a rod returns in one period."""
        usual = SOUND * NS.to_si(self.stream.period_ns) if self.channel.name == HEAD else STROKE
        return usual if self.options.stroke is None else self.options.stroke

    def measure(self, listed: Sequence[float] | None) -> None:
        """Sample at references, listed [m] or typed, until the operator ends. Raises InputError, LinkError."""
        if listed is None:
            prompt = f"reference [{self.options.unit}] (empty line: done; undo: drop the last place): "
            while len(self.places.places) < MAX_REFERENCES and (line := self._answer(prompt, "")) is not None:
                self._typed(line)
            return
        measured = self.places.references.tolist()
        check_references(listed, measured, self.stroke, f"{self.options.references}")
        for number, reference in enumerate(listed, 1):
            if reference in measured:
                measured.remove(reference)
                continue
            prompt = f"{number} of {len(listed)}: set {MM.text(reference, '.4f')}, then Enter (s: skip, q: enough): "
            while (line := self._answer(prompt, "q")) not in (None, "s") and not self._add(reference):
                continue
            if line is None:
                return

    def _answer(self, prompt: str, end: str) -> str | None:
        """Return what the operator types. ``end`` returns None, but if the places are too few only when typed twice."""
        line = self.ask(prompt)
        if line == end and self.places.places and (few := self.places.too_few()):
            again = f"{end or 'an empty line'} once more ends without a calibration"
            self.say(f"  {few.text(option)}; {again}")
            line = self.ask(prompt)
        return None if line == end else line

    def _typed(self, line: str) -> None:
        """Drop the last place, or measure at the reference that was typed."""
        say, unit, places = self.say, self.options.unit, self.places
        if line == "undo":
            say(f"  dropped place {len(places.places)}" if places.places else "  there is none")
            del places.places[-1:]
            places.write(self.places_file, say)
            return
        reference = parse_reference(line, UNITS[unit])
        if reference is None:
            wrong = {"place": "reference", "value": line[:40], "form": f"a reading in {unit}, such as 12.5"}
            say(f"  {Finding('wrong-value', wrong).text(option)}")
        elif error := beyond(reference, places.references.tolist(), self.stroke):
            say(f"  {error.text(option)}; undo drops the last place")
        else:
            self._add(reference)

    def _add(self, reference: float) -> bool:
        """Sample at a reference [m] and add the place, unless the samples give no reading."""
        channel, say = self.channel, self.say
        counts = sample(self.box, self.stream, self.options.sample)[:, self.stream.channels.index(channel)]
        readings = volts(counts[counts != 0] if channel.name == HEAD else counts, channel)
        if problem := trouble(counts, channel, readings):
            say(f"  {problem.text(option)}")
            return False
        temperature = self.box.heartbeat.get("temperature_mdegc")
        degc = None if temperature is None else temperature / 1000
        self.places.places.append(Place(reference, mean_of(readings), degc))
        self.places.write(self.places_file, say)
        say(self.places.line(len(self.places.places)))
        return True


def trouble(counts: NDArray[np.int32], channel: Channel, readings: Floats) -> Finding | None:
    """Return why these counts (n,) and their readings are not those of a place; None if they are."""
    if channel.name == HEAD:
        missing = int(np.count_nonzero(counts == 0))
        if 2 * missing > counts.size or counts.size - missing < FEWEST:
            return Finding("place-rejected", {"missing": missing, "n": counts.size})
    elif railed(counts).any():
        return Finding("place-rejected", {"at_end": True})
    moved = motion(readings)
    return Finding("place-rejected", {"moved": f"{moved:+.2g} {channel.unit}"}) if moved else None


def motion(samples: Floats) -> float:
    """Return how far a sensor moved while its samples (n,) were taken; 0.0 if it did not move.

    It moved if the means of eighths differ by more than one sample's noise, estimated from second differences that
    motion does not affect, and by more than six standard deviations of such a mean. A creep below that is harmless.
    """
    pieces = np.array_split(samples, max(2, min(PIECES, samples.size // PIECES)))
    means = np.array([piece.mean() for piece in pieces])
    steps = np.abs(np.diff(samples))
    if not steps.any():
        return 0.0
    noise = max(quick_noise(samples), float(steps[steps > 0.0].min()))
    first, last = sorted((int(means.argmin()), int(means.argmax())))
    moved = float(means[last] - means[first])
    return moved if abs(moved) > noise * max(1.0, STILL_MOVES / math.sqrt(pieces[-1].size)) else 0.0
