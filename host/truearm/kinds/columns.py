"""The columns of observation tables: those that the kinds declare, and those that rows of any kind have.

A quantity is in one column of numbers, or in several that are filled in together; an identifier is a column of names.
Importing this module is cheap; the kinds themselves are imported when they are first used.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any, TypeVar

from truearm.additions import instance, with_additions
from truearm.kinds import NAMES
from truearm.units import SMALLEST, UNITS, named, suffixes

if TYPE_CHECKING:
    from numpy.typing import NDArray


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
        return UNITS[self.unit].largest if math.isnan(self.largest) else self.largest

    @property
    def least(self) -> float:
        """Return the smallest plausible value, in SI."""
        return SMALLEST if self.positive else 0.0 if self.unsigned else -self.most

    def implausible(self, values: Any) -> Any:
        """Return a mask of the values, in SI, that are below ``least`` or so large that they indicate another unit."""
        return (abs(values) > self.most) | (values < self.least)

    @property
    def title(self) -> str:
        """Return the columns as a person writes them: "length_mm or length_m", "x_mm, y_mm, z_mm (or _m)"."""
        first, *further_units = sorted(suffixes(self.unit), key=lambda suffix: suffix == self.unit)
        if len(self.columns) == 1:
            return " or ".join(named(self.columns[0], suffix) for suffix in (first, *further_units))
        alternatives = " ".join(f"(or _{suffix})" for suffix in further_units)
        return f"{', '.join(named(column, first) for column in self.columns)} {alternatives}".rstrip()


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


GROUPS = ("place", "shell")  # identifiers of groups that a row of any kind may belong to
ORIGINS = ("rig", "simulated")  # identifiers of where a row comes from: its session, and whether a box was simulated
ANYWHERE = (*GROUPS, *ORIGINS)  # identifiers that a row of any kind may have
MEASURED_X = tuple(named("x", unit) for unit in suffixes("m"))  # the only x_… that are not the user's own
ADDED: dict[str, Any] = {}  # kinds of a script, by name
T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class KindColumns:
    """The table columns that rows of a kind must (``needs``) or can (``may``) fill; all others stay empty.

    A string is a column of identifiers, a Quantity one or more columns of numbers.
    """

    needs: tuple[str | Quantity, ...]
    may: tuple[str | Quantity, ...] = ()

    @property
    def identifiers(self) -> tuple[str, ...]:
        """Return the identifier columns that belong to this kind."""
        return tuple(column for column in (*self.needs, *self.may) if isinstance(column, str))

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """Return the quantities that are measured, in columns of numbers."""
        return tuple(column for column in (*self.needs, *self.may) if not isinstance(column, str))


@cache
def declared() -> Mapping[str, KindColumns]:
    """Return what every kind declares, by its name."""
    bundled = {name: import_module(f"{__package__}.{name}").KIND for name in NAMES}
    registry = with_additions("kinds", bundled, instance(KindColumns))
    registry.update(ADDED)
    return registry


@cache
def identifiers() -> tuple[str, ...]:
    """Return the identifier columns that a table may have."""
    return distinct((*(column for kind in declared().values() for column in kind.identifiers), *ANYWHERE))


def is_label(column: str) -> bool:
    """Return whether a column is one of the user's own, x_….

    Rows can be held out by such a column, which is otherwise ignored.
    """
    return column.startswith("x_") and column not in MEASURED_X


@cache
def quantities() -> tuple[Quantity, ...]:
    """Return the quantities that a table may have, one for each field."""
    declared_quantities = (quantity for kind in declared().values() for quantity in kind.quantities)
    return tuple({quantity.field: quantity for quantity in (*declared_quantities, *CIRCUMSTANCES)}.values())


@cache
def blank_row(joints: int) -> Mapping[str, NDArray[Any]]:
    """Return all columns that a table may have, and what each holds in a row without a value: "", or NaN (k,)."""
    import numpy as np

    measured = {quantity.field: len(quantity.columns) for quantity in quantities()}
    nan = {name: np.full(width if width > 1 else (), np.nan) for name, width in {**measured, "sigma": 1}.items()}
    text = dict.fromkeys((*identifiers(), "source"), np.array(""))
    q = np.full(joints, np.nan)
    return {"q": q, "kind": np.array(""), **nan, **text, "q_rate": q, "side": q}


def distinct(items: Iterable[T]) -> tuple[T, ...]:
    return tuple(dict.fromkeys(items))
