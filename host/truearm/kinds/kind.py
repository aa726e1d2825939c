"""What a kind of observation declares of itself. All that the other rooms know of it stands in its ``Kind``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from truearm.kinds.group import Group
from truearm.kinds.linearised import Indices
from truearm.kinds.proposals import Proposing
from truearm.kinds.quantities import Quantity
from truearm.kinds.rig_use import RigUse, Scope
from truearm.model.chain import Chain
from truearm.schema import Entries
from truearm.types import Floats, ObservationTable, Point, Rig


@dataclass(frozen=True, kw_only=True)
class Kind:
    """A kind of observation, registered by the name of its module (``registry.NAMES``).

    ``needs`` and ``may`` are the columns of a table that a row must or can fill in: a text is a column of identifiers, a
    Quantity one or more columns of numbers; all others it leaves empty. An identifier names an entry of the rig if the rig
    has such a type of entry. ``grouped_by`` are the columns whose identifiers say which rows belong together in a picture,
    ``regions`` those whose identifiers are places to judge by themselves; ``drawn_from`` those of which a random choice
    of rows takes its share each.
    """

    group: type[Group]  # what its rows become
    use_rig: Callable[[Scope, Indices], RigUse]
    needs: tuple[str | Quantity, ...]
    may: tuple[str | Quantity, ...] = ()
    entries: tuple[Entries[Any], ...] = ()  # its own and shared ones, of rig files
    free_names: tuple[str, ...] = ()  # identifiers that a rig need not list: one without such entries takes any name
    point: str = ""  # the column that names the point of the end which is measured; "" where none is
    labels: tuple[str, ...] = ()  # columns whose names an operator can confuse (estimate.label_search)
    grouped_by: tuple[str, ...]
    regions: tuple[str, ...] = ()
    drawn_from: tuple[str, ...] = ()
    name: str  # for a person: "ball-bar"
    residual: Mapping[str, str]  # for a person, by SI unit: what the residual is
    groups: str  # for a person: what ``grouped_by`` makes
    proposals: Proposing | None = None  # what more of it could be measured
    facts: Callable[[ObservationTable], tuple[tuple[str, str], ...]] | None = (
        None  # of its rows, for a report: label, value
    )
    longitude: Callable[[Chain, Floats, Rig, ObservationTable], Floats] | None = (
        None  # (n,) [rad] at params, for a picture
    )
    check: Callable[[ObservationTable, Rig], None] | None = None  # raises TableError where rows and rig do not fit

    @property
    def components(self) -> tuple[str, ...]:
        """The SI unit of each scalar residual of an observation."""
        return self.group.COMPONENTS

    @property
    def identifiers(self) -> tuple[str, ...]:
        """The columns of identifiers that are the kind's own."""
        return tuple(column for column in (*self.needs, *self.may) if isinstance(column, str))

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """What is measured, in columns of numbers."""
        return tuple(column for column in (*self.needs, *self.may) if isinstance(column, Quantity))

    def points(self, rig: Rig) -> Mapping[str, Point]:
        """The points of the robot's end that rows may name, by name; none where the kind measures no point."""
        return next((rig.named(entry.field) for entry in self.entries if entry.name == self.point), {})
