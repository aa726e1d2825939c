"""The references of a gauging: read from a file or typed, and checked before the first is measured."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from truearm.box.gauge_result import FEWEST_PLACES
from truearm.errors import InputError, TableError
from truearm.text import counted
from truearm.units import MM, suffixes

UNITS = suffixes("m", ("mm", "um", "in"))
MAX_REFERENCES = 1000
MAX_BYTES = 1 << 18
MAX_METRES = 10.0


def read_references(path: Path) -> list[float]:
    """Return the references [m] in a CSV file. Raises TableError."""
    from truearm.files.csv_cells import numbers, read_cells
    from truearm.files.disk import read_text
    from truearm.files.observation_columns import Column

    header, rows = read_cells(read_text(path, MAX_BYTES, TableError), str(path))
    columns = [
        Column(name, index, unit) for index, name in enumerate(header) for unit in UNITS if name == f"reference_{unit}"
    ]
    if len(columns) != 1:
        raise TableError("missing-column", place=path, column="reference_mm, reference_um or reference_in")
    if not 1 <= len(rows) <= MAX_REFERENCES:
        raise TableError(f"{path}: has {len(rows)} references; 1 to {MAX_REFERENCES} are possible")
    return [float(value) for value in numbers(rows, columns[0], str(path), MAX_METRES, required=True)]


def parse_reference(text: str, scale: float) -> float:
    """Return a typed reference [m]. Raises InputError."""
    try:
        value = float(text.strip().replace(",", ".")) * scale
    except ValueError:
        value = math.nan
    if not abs(value) <= MAX_METRES:
        raise InputError(f"{text.strip()[:40]!r} is not a reading")
    return value


def check_references(listed: Sequence[float], measured: Sequence[float], stroke: float, file: str) -> None:
    """Raise InputError if references [m] of a file, with those ``measured`` before, make no calibration.

    They are too few different ones, or farther apart than the sensor's ``stroke`` [m].
    """
    if (different := len({*listed, *measured})) < FEWEST_PLACES:
        raise InputError(
            f"{file}: {counted(different, 'different reference')}; a calibration needs {FEWEST_PLACES} or more, over the whole travel"
        )
    if max(listed) - min(listed) > stroke:
        raise InputError(f"{file}: {beyond(max(listed), min(listed), stroke)}")


def beyond(reference: float, other: float, stroke: float) -> str:
    """Return that two references are farther apart than the sensor's stroke."""
    distances = (
        f"{MM.text(reference, '.4f')} and {MM.text(other, '.4f')} are {MM.text(abs(reference - other), '.4f')} apart"
    )
    return f"{distances}, more than the sensor's stroke of {MM.text(stroke, '.0f')}; check reading and unit"
