"""What the rows of a kind use of the rig, before the rig's numbers have their positions in a parameter vector.

A kind's ``use_rig`` collects what its rows use. Once a Layout has assigned a position to every number, ``RigUse.make``
builds the groups.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from truearm.errors import ProblemError
from truearm.kinds.group import Group
from truearm.kinds.quantities import Quantity
from truearm.kinds.table import ObservationTable
from truearm.kinds.unknowns import MOVED, Fault, Layout, RigNumber, Used, enumerate_labels, point_numbers
from truearm.model.chain import Chain, point_forward
from truearm.text import with_article
from truearm.types import Floats, Indices, Point, Rig
from truearm.units import SMALLEST

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
    make: Callable[[Layout], list[Group]]
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
    """Return the distinct names in the column ``column_name``, checked against the rig, and the index of each row's name.

    An empty name stands for the only entry there is. Raises ProblemError that names the first row with a name that the
    rig does not have.
    """
    column = scope.column(column_name, rows)
    first = np.flatnonzero(
        np.append(True, column[1:] != column[:-1])[: column.size]
    )  # rows of a name follow each other
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

    ``item``: what the rig calls the entry, if the column ``column_name`` is called otherwise. An item that rows name in two
    columns then has its numbers once.
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
