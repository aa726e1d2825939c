"""The declaration of a kind of observation. Other packages know a kind only through its ``Kind``."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from truearm.errors import PlugInError
from truearm.findings import Finding
from truearm.kinds.columns import ANYWHERE, KindColumns
from truearm.kinds.group import Group
from truearm.kinds.proposals import Proposing
from truearm.kinds.rig_references import RigUse, Scope
from truearm.kinds.table import ObservationTable
from truearm.model.chain import Chain
from truearm.schema import Entries
from truearm.types import Floats, Indices, Point, Rig
from truearm.units import UNITS


@dataclass(frozen=True)
class DwellSensor:
    """A sensor that is read while the robot rests: its reading is zero + gain · extension [m or rad].

    ``names``: of the rig's entries in its row, by column. ``sigma``: declared repeatability of a dwell, added to the noise
    of the samples. Beyond ± ``travel``/2 an extension is not valid.
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
    identifiers name what is mounted or where, and ``regions`` those whose identifiers are regions to validate separately.
    A random selection of rows takes a proportional share of each identifier in the columns ``drawn_from``.
    """

    group: type[Group]  # the type that its rows are compiled into
    use_rig: Callable[[Scope, Indices], RigUse]
    entries: tuple[Entries[Any], ...] = ()  # entry types of rig files that it uses, its own and shared ones
    channels: tuple[tuple[str, ...], ...] = ()  # of the box, from which a session reads it, for each stream
    dwell: Callable[[Rig, Mapping[str, str]], Sequence[DwellSensor | None]] | None = (
        None  # the sensor on each channel while these parts are mounted, whose mean in a dwell is a row's quantity
    )
    free_names: tuple[str, ...] = ()  # identifiers without entries in the rig: then any name is valid
    point: str = ""  # the column that names the measured point of the end; "" if there is none
    labels: tuple[str, ...] = ()  # columns whose names an operator can confuse (checks.labels)
    grouped_by: tuple[str, ...]
    regions: tuple[str, ...] = ()
    drawn_from: tuple[str, ...] = ()
    name: str  # for display: "ball-bar"
    residual: Mapping[str, str]  # for display, by SI unit: meaning of the residual
    proposals: Proposing | None = None  # further measurements of this kind
    facts: Callable[[ObservationTable], tuple[tuple[str, str], ...]] | None = (
        None  # of its rows, for a report: label, value
    )
    longitude: Callable[[Chain, Floats, Rig, ObservationTable], Floats] | None = (
        None  # (n,) [rad] at params, for a figure
    )
    check: Callable[[ObservationTable, Rig], None] | None = None  # raises TableError if rows and rig are inconsistent
    doubts: Callable[[ObservationTable, Rig, Chain], list[Finding]] | None = (
        None  # about rows that the device in the rig cannot have measured; of a plug-in, "doubtful-rows" with a reason
    )

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
        """Return the points of the robot's end that rows may name, by name; empty if the kind does not measure a point."""
        return next((rig.named(entry.field) for entry in self.entries if entry.name == self.point), {})
