"""Keep the places of a gauging on the disk until the box has stored the calibration.

The file is written after every place, so a run that ends early (Ctrl-C, a cable, the computer) loses nothing: the next
run continues from it. The file holds no calibration, and nothing else reads it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from truearm.box.gauge_result import Place
from truearm.errors import InputError, WriteError
from truearm.files.disk import parse_toml, read_text, write_atomic
from truearm.schema import HUGE, Entries, Key, Number, Table, Text, read
from truearm.session.sample_noise import MeanOfSamples

MAX_BYTES = 1 << 20  # 1000 places of 300 bytes
HEADING = "# places of a gauging that is not finished: not a calibration; truearm box gauge continues from here\n"


@dataclass(frozen=True)
class KeptPlaces:
    """The places of a ``channel`` of the box with this ``uid``; one count is ``scale`` of the channel's ``unit``."""

    uid: str
    channel: str
    unit: str
    scale: float
    places: tuple[Place, ...] = ()


def _place(reference: float, temperature: float | None = None, **mean: Any) -> Place:
    return Place(reference, MeanOfSamples(**mean), temperature)


def _values(place: Place) -> dict[str, Any]:
    mean = {name: float(value) for name, value in place.mean._asdict().items()}  # some are NumPy's
    return {"reference": place.reference, "temperature": place.temperature, **mean}


_ANY = Number(most=HUGE)
_PLACE = Table(
    (
        Key("reference", Number("m")),
        Key("temperature", Number("degc"), optional=True),
        *(Key(name, _ANY) for name in MeanOfSamples._fields),
    ),
    _place,
    _values,
)
_FILE = Table(
    (Key("uid", Text(), optional=True), Key("channel", Text()), Key("unit", Text(), optional=True), Key("scale", _ANY)),
    lambda uid="", unit="", **values: KeptPlaces(uid, unit=unit, **values),
    entries=(Entries("place", _PLACE, "places"),),
)


def kept_path(page: Path) -> Path:
    """Return the file of the places that belongs to the page of a calibration."""
    return page.with_suffix(".places.toml")


class GaugeRun:
    """The places of a run, on the disk after every change. ``say`` shows a line to the operator."""

    def __init__(self, path: Path, of: KeptPlaces, say: Callable[[str], None]) -> None:
        self.path, self._of, self._say = path, of, say
        self.places = list(of.places)

    def add(self, place: Place) -> None:
        self.places.append(place)
        self._write()

    def drop(self) -> None:
        """Drop the last place."""
        del self.places[-1:]
        self._write()

    def finish(self) -> None:
        """Remove the file: the box has the calibration."""
        self.path.unlink(missing_ok=True)

    def _write(self) -> None:
        """Write all places; the run goes on without the file if the disk refuses it."""
        kept = replace(self._of, places=tuple(self.places))
        try:
            write_atomic(self.path, HEADING + _FILE.format(kept))
        except (InputError, WriteError) as exc:
            self._say(f"  {exc}; if this run ends early, its places are lost")


def read_kept(path: Path, of: KeptPlaces) -> KeptPlaces:
    """Return ``of`` with the places of an earlier run for the same channel of the same box; without a file, ``of``.

    Raises InputError for a file of something else.
    """
    if not path.exists():
        return of
    text = read_text(path, MAX_BYTES, InputError)
    kept = read(_FILE, parse_toml(text, str(path), InputError), str(path), InputError)
    if replace(kept, places=()) != of:
        raise InputError(
            f"{path}: holds places of another box, channel or gain ({kept.channel[:40]!r} of box {kept.uid[:40]!r}); "
            "move it to another folder, or remove it"
        )
    return kept
