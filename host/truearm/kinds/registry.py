"""The registry of kinds of observation (``truearm.kinds.NAMES``), and what they say about rigs and rows.

Other packages add kinds by entry points of the group ``truearm.kinds``, a script by ``add_kind``.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import TYPE_CHECKING, Any, cast

from truearm.additions import check_loaded
from truearm.kinds.columns import ADDED, GROUPS, blank_row, declared, distinct, identifiers, quantities

if TYPE_CHECKING:
    from truearm.kinds.kind import Kind
    from truearm.kinds.table import ObservationTable
    from truearm.schema import Entries
    from truearm.types import Point, Rig


def kinds() -> Mapping[str, Kind]:
    """Return every kind by its name, which its rows have in the column ``kind``."""
    return cast("Mapping[str, Kind]", declared())


def check_kinds() -> None:
    """Raise PlugInError if a kind of another package could not be loaded, whose rows would not be read."""
    declared()
    check_loaded("kinds")


def add_kind(name: str, kind: Kind) -> None:
    """Add a kind of another package. Its rows have this name in the column ``kind``."""
    ADDED[name] = kind
    for derived in (declared, identifiers, quantities, blank_row, entries):
        derived.cache_clear()


@cache
def entries() -> tuple[Entries[Any], ...]:
    """Return the types of entry that a rig file may have."""
    return tuple({entry.name: entry for kind in kinds().values() for entry in kind.entries}.values())


def rig_names(rig: Rig) -> Mapping[str, Mapping[str, Any]]:
    """Return the names in a rig for each column whose identifiers must occur in it."""
    from truearm.kinds.rig_entries import by_name

    free = {column for kind in kinds().values() for column in kind.free_names}
    named = {entry.name: rig.named(entry.field) for entry in entries() if entry.index is by_name}
    return {
        column: named[column] for column in identifiers() if column in named and (named[column] or column not in free)
    }


def with_every_name(rig: Rig, table: ObservationTable) -> Rig:
    """Return the rig with an entry for each name of the table, where the rig has one for all names, "*"."""
    from dataclasses import replace

    import numpy as np

    from truearm.kinds.rig_entries import EVERY, by_name

    for entry in (entry for entry in entries() if entry.index is by_name and entry.name in identifiers()):
        named, names = rig.named(entry.field), [name for name in np.unique(table[entry.name]).tolist() if name]
        if EVERY in named and names:  # otherwise it is the only entry, of rows without names
            repeated = {name: replace(named[EVERY], name=name) for name in names}
            rig = rig.with_named(entry.field, repeated | {name: named[name] for name in named if name != EVERY})
    return rig


def points() -> Mapping[str, str]:
    """Return the columns that name points of the rig, and the rig's field that holds each."""
    from truearm.kinds.rig_entries import POINT, TARGET_POINT

    return {entry.name: entry.field for entry in entries() if entry.table in (POINT, TARGET_POINT)}


def end_points(rig: Rig) -> Mapping[str, Mapping[str, Point]]:
    """Return the points of the robot's end in a rig, by the column that names them."""
    return {kind.point: kind.points(rig) for kind in kinds().values() if kind.point}


def units() -> tuple[str, ...]:
    """Return the SI units in which rows may give their uncertainty: the first unit of each kind's residuals."""
    return distinct(kind.components[0] for kind in kinds().values())


def regions() -> tuple[str, ...]:
    """Return the identifier columns that name regions to validate separately."""
    return distinct(("rig", *GROUPS, *(column for kind in kinds().values() for column in kind.regions)))


def drawn_from() -> tuple[str, ...]:
    """Return the identifier columns of which a random selection of rows takes a proportional share."""
    return distinct((*GROUPS, *(column for kind in kinds().values() for column in kind.drawn_from)))
