"""Keep the places of a gauging on the disk until the box has stored the calibration.

The file is written after every place, so a run that ends early (Ctrl-C, a cable, the computer) loses nothing: the next
run continues from it. The file holds no calibration, and nothing else reads it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import msgspec

from truearm.errors import InputError, WriteError
from truearm.files.disk import read_bytes, write_atomic
from truearm.session.sample_noise import MeanOfSamples

MAX_BYTES = 1 << 20  # 1000 places of 200 bytes


@dataclass(frozen=True)
class Place:
    """A reference position [m]: the sensor's mean reading in the channel's unit, and the box's temperature [°C]
    meanwhile.
    """

    reference: float
    mean: MeanOfSamples
    temperature: float | None


@dataclass(frozen=True)
class KeptPlaces:
    """The places of a ``channel`` of the box with this ``uid``; one count is ``scale`` of the channel's ``unit``."""

    uid: str
    channel: str
    unit: str
    scale: float
    places: list[Place] = field(default_factory=list)


def kept_path(page: Path) -> Path:
    """Return the file of the places that belongs to the page of a calibration."""
    return page.with_suffix(".places.json")


class GaugeRun:
    """The places of a run, on the disk after every change. ``say`` shows a line to the operator."""

    def __init__(self, path: Path, kept: KeptPlaces, say: Callable[[str], None]) -> None:
        self.path, self._kept, self._say = path, kept, say
        self.places = kept.places

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
        try:
            write_atomic(self.path, msgspec.json.encode(self._kept, enc_hook=float).decode())  # some are NumPy's
        except (InputError, WriteError) as exc:
            self._say(f"  {exc}; if this run ends early, its places are lost")


def read_kept(path: Path, empty: KeptPlaces) -> KeptPlaces:
    """Return the places of an earlier run for the channel and box of ``empty``; without a file, ``empty``.

    Raises InputError for a file of something else.
    """
    if not path.exists():
        return empty
    try:
        kept = msgspec.json.decode(read_bytes(path, MAX_BYTES, InputError), type=KeptPlaces)
    except (msgspec.MsgspecError, UnicodeDecodeError) as exc:
        raise InputError(f"{path}: holds no places of a gauging: {exc}; remove it") from None
    if replace(kept, places=[]) != empty:
        raise InputError(
            f"{path}: holds places of another box, channel or gain ({kept.channel[:40]!r} of box {kept.uid[:40]!r}); "
            "move it to another folder, or remove it"
        )
    return kept
