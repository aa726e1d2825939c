"""The columns of observation tables: those that the kinds declare, and those that rows of any kind have.

Importing this module is cheap; the kinds themselves are imported when they are first used.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any, TypeVar

from truearm.additions import instance, with_additions
from truearm.kinds import NAMES
from truearm.units import named, suffixes

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from truearm.kinds.quantities import Quantity

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
    return with_additions("kinds", bundled, instance(KindColumns)) | ADDED


@cache
def identifiers() -> tuple[str, ...]:
    """Return the identifier columns that a table may have."""
    return distinct((*(column for kind in declared().values() for column in kind.identifiers), *ANYWHERE))


def is_label(column: str) -> bool:
    """Return whether a column is one of the user's own, x_…, by which rows can be held out and which is otherwise ignored."""
    return column.startswith("x_") and column not in MEASURED_X


@cache
def quantities() -> tuple[Quantity, ...]:
    """Return the quantities that a table may have, one for each field."""
    from truearm.kinds.quantities import CIRCUMSTANCES

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
