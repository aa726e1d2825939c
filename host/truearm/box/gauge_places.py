"""The places of a gauging, kept on the disk until the box has stored the calibration, and its references from a file.

The file of the places is written after every place, so a run that ends early (Ctrl-C, a cable, the computer) loses
nothing: the next run continues from it. It holds no calibration, and nothing else reads it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import msgspec
import numpy as np

from truearm.box.gauge_polynomial import distinct_places
from truearm.disk import read_bytes, read_text, write_atomic
from truearm.errors import InputError, TableError, WriteError
from truearm.kinds.csv_cells import read_csv
from truearm.session.sample_noise import MeanOfSamples
from truearm.text import one_line, page
from truearm.types import Floats
from truearm.units import MM, named, suffixes

UNITS = suffixes("m", ("mm", "um", "in"))
FEWEST_PLACES = 5
MAX_REFERENCES = 1000
MAX_BYTES = 1 << 20  # 1000 places of 200 bytes
MAX_METRES = 10.0
PAGE = page("Set up the sensor box")


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
