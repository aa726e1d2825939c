"""Quantities in tables of observations, each in one column of numbers or in several that are filled in together."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from truearm import units


@dataclass(frozen=True)
class Quantity:
    """A measured quantity.

    ``field`` is its place in an ObservationTable: one of the table's own fields, otherwise a key of ``more``. In a file
    header, each of ``columns`` has a unit suffix (``length_mm``).
    """

    field: str
    columns: tuple[str, ...]
    unit: str  # SI
    largest: float = math.nan  # SI; larger values indicate another unit. NaN: the unit's own limit
    positive: bool = False
    unsigned: bool = False  # 0 or more

    @property
    def words(self) -> str:
        """Return its name for display: "length", "x, y and z"."""
        *earlier, last = self.columns
        return f"{', '.join(earlier)} and {last}" if earlier else last

    @property
    def most(self) -> float:
        """Return the largest plausible magnitude, in SI."""
        return units.UNITS[self.unit].largest if math.isnan(self.largest) else self.largest

    @property
    def least(self) -> float:
        """Return the smallest plausible value, in SI."""
        return units.SMALLEST if self.positive else 0.0 if self.unsigned else -self.most

    def implausible(self, values: Any) -> Any:
        """Return a mask of the values, in SI, that are below ``least`` or so large that they indicate another unit."""
        return (abs(values) > self.most) | (values < self.least)

    @property
    def title(self) -> str:
        """Return the columns as a person writes them: "length_mm or length_m", "x_mm, y_mm, z_mm (or _m)"."""
        first, *further_units = sorted(units.suffixes(self.unit), key=lambda suffix: suffix == self.unit)
        if len(self.columns) == 1:
            return " or ".join(units.named(self.columns[0], suffix) for suffix in (first, *further_units))
        alternatives = " ".join(f"(or _{suffix})" for suffix in further_units)
        return f"{', '.join(units.named(column, first) for column in self.columns)} {alternatives}".rstrip()


LARGEST_NOISE = 0.1  # m: a decimetre of noise indicates another unit
LARGEST_TURN_NOISE = 0.1  # rad
LENGTH = Quantity("value", ("length",), "m", positive=True)
DISTANCE = Quantity("value", ("length",), "m")  # signed
POINT = Quantity("xyz", ("x", "y", "z"), "m")
BAR_TEMPERATURE = Quantity("bar_temperature", ("bar_temperature",), "degc")
SENSOR_TEMPERATURE = Quantity("sensor_temperature", ("sensor_temperature",), "degc")
SPREAD = Quantity("xyz_sigma", ("sx", "sy", "sz"), "m", LARGEST_NOISE, positive=True)
TIME = Quantity("time", ("time",), "s", 1e11)  # on any clock, from any epoch; 3000 years
TEMPERATURE = Quantity("temperature", ("temperature",), "degc")
GRAVITY = Quantity("gravity", ("gravity_x", "gravity_y", "gravity_z"), "m/s2")  # along the base frame's axes
PAYLOAD = Quantity("payload", ("payload",), "kg", unsigned=True)
PAYLOAD_CENTRE = Quantity("payload_centre", ("payload_x", "payload_y", "payload_z"), "m")  # in the end frame
CIRCUMSTANCES = (TIME, TEMPERATURE, GRAVITY, PAYLOAD, PAYLOAD_CENTRE)  # for a row of any kind
TURN = Quantity("rotation", ("rx", "ry", "rz"), "rad", 2.0 * math.pi)  # a rotation vector's length need not exceed π
