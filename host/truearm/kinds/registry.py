"""The registry of kinds of observation. A kind is a module of this package with a ``KIND``, listed here by name.

Other packages add kinds by entry points of the group ``truearm.kinds``, a script by ``add_kind``.

Importing this module is cheap; the kinds themselves are imported when they are first used.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any, TypeVar

from truearm.additions import with_additions
from truearm.units import named, suffixes

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from truearm.kinds.kind import Kind
    from truearm.kinds.quantities import Quantity
    from truearm.kinds.table import ObservationTable
    from truearm.schema import Entries
    from truearm.types import Point, Rig

NAMES = (  # in the order of their unknowns in a parameter vector
    "ball_bar",
    "seat",
    "line",
    "position",
    "pose",
    "plane",
)
GROUPS = ("place", "shell")  # identifiers of groups that a row of any kind may belong to
ORIGINS = ("rig", "simulated")  # identifiers of where a row comes from: its session, and whether a box was simulated
ANYWHERE = (*GROUPS, *ORIGINS)  # identifiers that a row of any kind may have
MEASURED_X = tuple(named("x", unit) for unit in suffixes("m"))  # the only x_… that are not the user's own
ADDED: dict[str, Kind] = {}  # of other packages, by name
T = TypeVar("T")


@cache
def kinds() -> Mapping[str, Kind]:
    """Return every kind by its name, which its rows have in the column ``kind``."""
    own = {name: import_module(f"{__package__}.{name}").KIND for name in NAMES}
    return with_additions("kinds", own) | ADDED


def add_kind(name: str, kind: Kind) -> None:
    """Add a kind of another package. Its rows have this name in the column ``kind``."""
    ADDED[name] = kind
    for derived in (kinds, identifiers, quantities, blank_row, entries):
        derived.cache_clear()


@cache
def identifiers() -> tuple[str, ...]:
    """Return the identifier columns that a table may have."""
    return _distinct((*(column for kind in kinds().values() for column in kind.identifiers), *ANYWHERE))


def is_label(column: str) -> bool:
    """Return whether a column is one of the user's own, x_…, by which rows can be held out and which is otherwise ignored."""
    return column.startswith("x_") and column not in MEASURED_X


@cache
def quantities() -> tuple[Quantity, ...]:
    """Return the quantities that a table may have, one for each field."""
    from truearm.kinds.quantities import CIRCUMSTANCES

    every = (quantity for kind in kinds().values() for quantity in kind.quantities)
    return tuple({quantity.field: quantity for quantity in (*every, *CIRCUMSTANCES)}.values())


@cache
def blank_row(joints: int) -> Mapping[str, NDArray[Any]]:
    """Return all columns that a table may have, and what each holds in a row without a value: "", or NaN (k,)."""
    import numpy as np

    measured = {quantity.field: len(quantity.columns) for quantity in quantities()}
    nan = {name: np.full(width if width > 1 else (), np.nan) for name, width in {**measured, "sigma": 1}.items()}
    text = dict.fromkeys((*identifiers(), "source"), np.array(""))
    q = np.full(joints, np.nan)
    return {"q": q, "kind": np.array(""), **nan, **text, "q_rate": q, "side": q}


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
    return _distinct(kind.components[0] for kind in kinds().values())


def regions() -> tuple[str, ...]:
    """Return the identifier columns that name regions to validate separately."""
    return _distinct(("rig", *GROUPS, *(column for kind in kinds().values() for column in kind.regions)))


def drawn_from() -> tuple[str, ...]:
    """Return the identifier columns of which a random selection of rows takes a proportional share."""
    return _distinct((*GROUPS, *(column for kind in kinds().values() for column in kind.drawn_from)))


def _distinct(items: Iterable[T]) -> tuple[T, ...]:
    return tuple(dict.fromkeys(items))
