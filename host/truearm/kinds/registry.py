"""The kinds of observation. A kind is a module of this room whose ``KIND`` declares it, and its name here.

Importing this module is cheap; the kinds themselves are imported when they are first asked for.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from truearm.kinds.kind import Kind
    from truearm.kinds.quantities import Quantity
    from truearm.schema import Entries
    from truearm.types import Point, Rig

NAMES = (  # their unknowns stand in this order in a parameter vector
    "ball_bar",
    "seat",
    "line",
    "position",
    "pose",
    "plane",
)
GROUPS = ("place", "shell")  # identifiers of groups that a row of any kind may belong to
ANYWHERE = (*GROUPS, "rig")  # identifiers that a row of any kind may have
T = TypeVar("T")


@cache
def kinds() -> Mapping[str, Kind]:
    """Every kind by its name, which its rows have in the column ``kind``."""
    return {name: import_module(f"truearm.kinds.{name}").KIND for name in NAMES}


@cache
def identifiers() -> tuple[str, ...]:
    """The columns of identifiers that a table may have."""
    return _distinct((*(column for kind in kinds().values() for column in kind.identifiers), *ANYWHERE))


@cache
def quantities() -> tuple[Quantity, ...]:
    """The quantities that a table may have, one of each field."""
    from truearm.kinds.quantities import CIRCUMSTANCES

    every = (quantity for kind in kinds().values() for quantity in kind.quantities)
    return tuple({quantity.field: quantity for quantity in (*every, *CIRCUMSTANCES)}.values())


@cache
def entries() -> tuple[Entries[Any], ...]:
    """The types of entry that a rig file may have."""
    return tuple({entry.name: entry for kind in kinds().values() for entry in kind.entries}.values())


def rig_names(rig: Rig) -> Mapping[str, Mapping[str, Any]]:
    """What a rig has, by name, for each column whose identifiers must be known to it."""
    from truearm.kinds.rig_entries import by_name

    free = {column for kind in kinds().values() for column in kind.free_names}
    named = {entry.name: rig.named(entry.field) for entry in entries() if entry.index is by_name}
    return {
        column: named[column] for column in identifiers() if column in named and (named[column] or column not in free)
    }


def points() -> Mapping[str, str]:
    """The columns that name points of the rig, and the rig's field that holds each."""
    from truearm.kinds.rig_entries import POINT

    return {entry.name: entry.field for entry in entries() if entry.table is POINT}


def end_points(rig: Rig) -> Mapping[str, Mapping[str, Point]]:
    """The points of the robot's end that a rig has, by the column that names them."""
    return {kind.point: kind.points(rig) for kind in kinds().values() if kind.point}


def units() -> tuple[str, ...]:
    """The SI units in which rows may say how uncertain they are: the first of each kind's residuals."""
    return _distinct(kind.components[0] for kind in kinds().values())


def regions() -> tuple[str, ...]:
    """The columns of identifiers that name places to judge by themselves."""
    return _distinct(("rig", *GROUPS, *(column for kind in kinds().values() for column in kind.regions)))


def drawn_from() -> tuple[str, ...]:
    """The columns of identifiers of which a random choice of rows takes its share each."""
    return _distinct((*GROUPS, *(column for kind in kinds().values() for column in kind.drawn_from)))


def _distinct(items: Iterable[T]) -> tuple[T, ...]:
    return tuple(dict.fromkeys(items))
