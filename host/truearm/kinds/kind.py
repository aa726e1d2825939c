"""What a kind of observation is made of. Other packages know a kind only through its ``Kind``.

A kind's ``use_rig`` collects what its rows use of the rig, before the rig's numbers have their positions in a parameter
vector. Once a Layout has assigned a position to every number, ``RigUse.make`` builds the groups.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from truearm.errors import PlugInError, ProblemError
from truearm.findings import Finding
from truearm.kinds.columns import ANYWHERE, KindColumns, Quantity
from truearm.kinds.group import MOVED, Fault, Group, Layout, RigNumber, Used, enumerate_labels, point_numbers
from truearm.kinds.proposals import Proposing
from truearm.kinds.table import ObservationTable
from truearm.model.chain import Chain, point_forward
from truearm.schema import Entries
from truearm.text import with_article
from truearm.types import Floats, Indices, Point, Rig
from truearm.units import SMALLEST, UNITS

Entry = TypeVar("Entry")
ORIGIN = {"": Point("", (0.0, 0.0, 0.0))}  # the target or ball of a rig without any: the end frame's origin


class Scope(NamedTuple):
    """One rig, the table with its rows, and the ``prefix`` of the names of its unknowns."""

    chain: Chain
    rig: Rig
    table: ObservationTable
    prefix: str

    def column(self, name: str, rows: Indices) -> NDArray[Any]:
        """Return a column in some rows, in their order; not a copy if these are all."""
        column = self.table[name]
        return column if rows.size == len(column) else column[rows]


class RigUse(NamedTuple):
    """What some rows use of the rig, and how to build their groups once all numbers have their positions.

    ``bodies`` are points that the rig places and that can be off together, by the name of what they are on.
    """

    used: tuple[Used, ...]
    make: Callable[[Layout], Sequence[Group]]
    bodies: Mapping[str, tuple[str, ...]] = MappingProxyType({})

    @classmethod
    def of(cls, group: Callable[..., Group], scope: Scope, rows: Indices, sensor_cov: Floats, **fields: Any) -> Self:
        """Return what one group of some rows uses, by its further ``fields``: items of the rig become their indices."""

        def make(layout: Layout) -> list[Group]:
            values = {name: layout.index(f) if isinstance(f, Used) else f for name, f in fields.items()}
            q = scope.column("q", rows)
            return [group(row=rows, sensor_cov=sensor_cov, q=q, constants=layout.constants, **values)]

        return cls(tuple(field for field in fields.values() if isinstance(field, Used)), make)


def look_up(
    scope: Scope, rows: Indices, column_name: str, entries: Mapping[str, Any]
) -> tuple[list[Hashable], Indices]:
    """Return the distinct names in a column, checked against the rig, and the index of each row's name.

    An empty name stands for the only entry there is. Raises ProblemError that names the first row with a name that the
    rig does not have.
    """
    column = scope.column(column_name, rows)
    # rows of a name follow each other
    first = np.flatnonzero(np.append(True, column[1:] != column[:-1])[: column.size])
    names, which = enumerate_labels(column[first].tolist())
    which = np.repeat(which, np.diff(first, append=column.size))
    labels: list[Hashable] = []
    for i, name in enumerate(names):
        label = next(iter(entries)) if name == "" and len(entries) == 1 else str(name)
        if label not in entries:
            source = scope.table.source[rows[int(np.argmax(which == i))]]
            raise ProblemError("not-in-rig", place=source, what=column_name, name=label, names=sorted(entries))
        labels.append(label)
    return labels, which


def use(
    scope: Scope,
    rows: Indices,
    column_name: str,
    entries: Mapping[str, Entry],
    numbers: Callable[[str, Entry], list[RigNumber]],
    faults: tuple[Fault, ...] = MOVED,
    *,
    item: str = "",
) -> Used:
    """Look up a column's names in the rig (``look_up``); ``numbers`` maps a name and its entry to the entry's numbers.

    ``item``: what the rig calls the entry, if the column ``column_name`` is called otherwise. An item that rows name in
    two columns then has its numbers once.
    """
    labels, which = look_up(scope, rows, column_name, entries)
    numbers_of_items = [
        numbers(f"{scope.prefix}{item or column_name}.{label}", entries[str(label)]) for label in labels
    ]
    return Used(labels, numbers_of_items, which, faults)


def use_points(scope: Scope, rows: Indices, column_name: str, entries: Mapping[str, Point], *, item: str = "") -> Used:
    """Return the points named in a column (``use``); the end frame's origin if the rig has none."""
    return use(scope, rows, column_name, entries or ORIGIN, point_numbers, item=item)


def measured(scope: Scope, rows: Indices, quantity: Quantity) -> Floats:
    """Return the measured values (n,) or (n, c) of the rows. Raises ProblemError for the first row without a value."""
    values = scope.column(quantity.field, rows)
    lacks = ~np.isfinite(values.reshape(len(rows), -1)).all(axis=1)
    words = quantity.words if len(quantity.columns) > 1 else with_article(quantity.words)
    refuse(scope, rows, lacks, f"{with_article(str(scope.table.kind[rows[0]]))} row needs {words}")
    return np.asarray(values)


def sigmas(scope: Scope, rows: Indices, default: Floats, unit: str = "m") -> Floats:
    """Return the rows' own σ (n, w), equal for all w residuals; the rig's ``default`` (n, w) where they have none.

    ``unit`` is the SI unit of both. Raises ProblemError for the first row whose σ is not a number or is too small.
    """
    row_sigma = scope.column("sigma", rows)[:, None]
    sigma = np.where(np.isnan(row_sigma), default, row_sigma)
    bad = np.flatnonzero(~((sigma >= SMALLEST) & np.isfinite(sigma)).all(axis=1))
    if bad.size:
        worst = sigma[bad[0]].min()  # NaN if any is
        raise ProblemError(
            f"{scope.table.source[rows[bad[0]]]}: sigma must be positive, at least {SMALLEST:g} {unit}, is {worst:g}"
        )
    return np.asarray(sigma)


def refuse(scope: Scope, rows: Indices, bad: Any, text: str) -> None:
    """Raise ProblemError naming the first of the bad rows (n,)."""
    if bad.any():
        raise ProblemError(f"{scope.table.source[rows[int(np.argmax(bad))]]}: {text}")


def nominal_points(scope: Scope, rows: Indices, points: Used) -> Floats:
    """Return the positions (n, 3) of points of the end in the base frame, according to the nominal robot."""
    p_end = np.array([[number.value for number in point] for point in points.numbers])[points.which]
    return point_forward(scope.chain, scope.chain.params_nominal, scope.column("q", rows), p_end)


@dataclass(frozen=True)
class DwellSensor:
    """A sensor that is read while the robot rests: its reading is zero + gain · extension [m or rad].

    ``names``: of the rig's entries in its row, by column. ``sigma``: declared repeatability of a dwell, added to the
    noise of the samples. Beyond ± ``travel``/2 an extension is not valid.
    """

    names: Mapping[str, str]
    zero: float = 0.0
    gain: float = 1.0
    sigma: float = 0.0
    travel: float = math.inf


@dataclass(frozen=True, kw_only=True)
class Kind(KindColumns):
    """A kind of observation, registered under the name of its module (``truearm.kinds.NAMES``).

    An identifier names an entry of the rig if the rig has entries of that type. ``grouped_by`` are the columns whose
    identifiers name what is mounted or where, and ``regions`` those whose identifiers are regions to validate
    separately. A random selection of rows takes a proportional share of each identifier in the columns ``drawn_from``.
    """

    group: type[Group]  # the type that its rows are compiled into
    use_rig: Callable[[Scope, Indices], RigUse]
    entries: tuple[Entries[Any], ...] = ()  # entry types of rig files that it uses, its own and shared ones
    channels: tuple[tuple[str, ...], ...] = ()  # of the box, from which a session reads it, for each stream
    # the sensor on each channel while these parts are mounted, whose mean in a dwell is a row's quantity
    dwell: Callable[[Rig, Mapping[str, str]], Sequence[DwellSensor | None]] | None = None
    free_names: tuple[str, ...] = ()  # identifiers without entries in the rig: then any name is valid
    point: str = ""  # the column that names the measured point of the end; "" if there is none
    labels: tuple[str, ...] = ()  # columns whose names an operator can confuse (checks.labels)
    grouped_by: tuple[str, ...]
    regions: tuple[str, ...] = ()
    drawn_from: tuple[str, ...] = ()
    name: str  # for display: "ball-bar"
    residual: Mapping[str, str]  # for display, by SI unit: meaning of the residual
    proposals: Proposing | None = None  # further measurements of this kind
    # of its rows, for a report: label, value
    facts: Callable[[ObservationTable], tuple[tuple[str, str], ...]] | None = None
    # (n,) [rad] at params, for a figure
    longitude: Callable[[Chain, Floats, Rig, ObservationTable], Floats] | None = None
    check: Callable[[ObservationTable, Rig], None] | None = None  # raises TableError if rows and rig are inconsistent
    # about rows that the device in the rig cannot have measured; of a plug-in, "doubtful-rows" with a reason
    doubts: Callable[[ObservationTable, Rig, Chain], list[Finding]] | None = None

    def __post_init__(self) -> None:
        """Raise TypeError or ValueError for a declaration that would fail at the first row."""
        if any(isinstance(names, str) for names in self.channels):
            raise TypeError('channels has a tuple of names for each stream, such as (("a",), ("b",))')
        for column in (*self.grouped_by, *self.regions, *self.labels, *self.drawn_from):
            if column not in (*self.identifiers, *ANYWHERE):
                raise ValueError(f"{column!r} is not a column of identifiers in needs or may")
        for unit in (*self.components, *(quantity.unit for quantity in self.quantities)):
            if unit not in UNITS:
                raise ValueError(f"{unit!r} is not a unit; use one of {', '.join(UNITS)}")
        if lacking := [unit for unit in self.components if unit not in self.residual]:
            raise ValueError(f"residual does not describe the component in {lacking[0]}")

    def dwell_sensors(self, rig: Rig, mounted: Mapping[str, str]) -> Sequence[DwellSensor | None]:
        """Return what ``dwell`` says of each stream. Raises PlugInError if it returns anything else."""
        sensors = self.dwell(rig, mounted) if self.dwell else ()
        each = sensors if isinstance(sensors, Sequence) else ()
        if len(each) != len(self.channels) or not all(isinstance(sensor, DwellSensor | None) for sensor in each):
            form = f"a sequence with a DwellSensor or None for each of its {len(self.channels)} channels"
            place = f"dwell() of the kind {self.name}"
            got = len(each) if isinstance(sensors, Sequence) else type(sensors).__name__
            raise PlugInError("wrong-plug-in", place=place, reason=f"must return {form}, not {got}")
        return sensors

    @property
    def components(self) -> tuple[str, ...]:
        """Return the SI unit of each scalar residual of an observation."""
        return self.group.COMPONENTS

    def points(self, rig: Rig) -> Mapping[str, Point]:
        """Return the points of the robot's end that rows may name, by name; empty if the kind measures no point."""
        return next((rig.named(entry.field) for entry in self.entries if entry.name == self.point), {})
