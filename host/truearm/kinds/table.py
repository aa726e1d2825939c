"""The table of observations: the columns that the kinds declare, and those that rows of any kind have."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from truearm.arguments import converted
from truearm.errors import Argument, InputError
from truearm.kinds.columns import blank_row, is_label, quantities
from truearm.model.chain_structure import Mimic, completed
from truearm.types import Displayed, as_column

MOTIONS = ("q_rate", "side")  # columns of all joints, in addition to q


@dataclass(frozen=True, eq=False, repr=False, init=False)
class ObservationTable(Displayed):
    """Observations of one or several kinds, one per row. Tables and sessions are both read into this type.

    ``table["chuck"]`` or ``table.chuck`` is a column; NaN or "" in every row if the table does not have it. ``columns``
    holds those that it has, by name. Every table has:

    - ``q`` (n, j) [rad, m]: joint readings.
    - ``kind`` (n,): "ball_bar", "seat", "line", "position", "pose" or "plane".
    - ``source`` (n,): where a row comes from, for messages ("poses.csv row 17"; by default "table[16]").

    Rows of any kind may have:

    - ``q_rate`` (n, j): joint velocities, NaN where the robot was at rest or they were not measured.
    - ``side`` (n, j): direction in which each joint last moved before the robot stopped, −1 or 1, NaN where unknown.
    - ``sigma`` (n,) [m or rad]: standard deviation of each residual in the (first) unit of the row's kind, NaN to use
      that of the rig.
    - ``time`` (n,) [s]: time of the measurement on any clock. ``temperature`` (n,) [°C]: temperature of the box at that
      time.
    - ``gravity`` (n, 3) [m/s²], ``payload`` (n,) [kg] and its ``payload_centre`` (n, 3) [m].
    - ``place``, ``shell`` (n,): names of groups. ``rig`` (n,): name of the rig that a row belongs to. ``simulated``
      (n,): "yes" if it was recorded with a simulated box.

    The kinds declare the others, such as:

    - ``value`` (n,) [m]: the measured length of a ball-bar row, or the distance from the plane in a ``plane`` row
      (NaN means 0, a touch).
    - ``xyz`` (n, 3) [m]: the measured point of a line, position or pose row, in the device's axes. ``xyz_sigma`` (n, 3)
      [m]: standard deviation of this point's own noise along these axes, in addition to that of the rig.
    - ``rotation`` (n, 3) [rad]: the measured rotation vector of a pose row.
    - ``bar``, ``chuck`` and the other columns of names (n,).

    ``x_day`` and other names that begin with ``x_`` are the user's own texts (n,), to hold rows out by.

    Columns are given by name, in a mapping or as keywords; a word or a number stands for all rows. Raises TypeError or
    InputError for a column of the wrong type or shape, or that no kind declares. ``replace(columns)`` returns the table
    with other columns, ``select(rows)`` the rows of a mask or of indices, ``joined(tables)`` one table of several.

    Examples
    --------
    >>> import truearm
    >>> table = truearm.read_table("poses.csv", truearm.load_robot("puma560"))
    >>> len(table.select(table.chuck == "c1"))
    30
    """

    columns: Mapping[str, NDArray[Any]]

    def __init__(self, columns: Mapping[str, Any] = MappingProxyType({}), **named: Any) -> None:
        contents = {**converted("columns", columns, Mapping[str, Any]), **named}
        q = as_column("q", contents.get("q"), text=False)
        if q.ndim != 2:
            raise InputError(Argument("q"), f" must be (n, j), is {q.shape}")
        if contents.get("source") is None:
            contents["source"] = [f"table[{i}]" for i in range(len(q))]
        blank = {**blank_row(q.shape[1]), **dict.fromkeys(filter(is_label, contents), np.array(""))}
        if undeclared := contents.keys() - blank.keys():
            raise TypeError(f"{min(undeclared)}: is not a column of observations; help(ObservationTable) lists them")
        columns = {}
        for name, row in blank.items():
            if contents.get(name) is not None or name == "kind":
                column, shape = as_column(name, contents.get(name), row.dtype.kind == "U"), (len(q), *row.shape)
                columns[name] = column if column.ndim else np.broadcast_to(column, shape)
                if columns[name].shape != shape:
                    raise InputError(Argument(name), f" must be {shape}, is {column.shape}")
        object.__setattr__(self, "columns", columns)

    def __len__(self) -> int:
        return len(self.columns["q"])

    def __getitem__(self, name: str) -> NDArray[Any]:
        if name in self.columns:
            return self.columns[name]
        row = np.array("") if is_label(name) else blank_row(self.columns["q"].shape[1])[name]
        return np.broadcast_to(row, (len(self), *row.shape))

    def __getattr__(self, name: str) -> NDArray[Any]:
        if name not in blank_row(0) and not is_label(name):
            raise AttributeError(f"{name}: is not a column of observations", name=name, obj=self)
        return self[name]

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *blank_row(0)]

    def _headline(self) -> str:
        counts = zip(*np.unique(self.kind, return_counts=True), strict=True)
        return f"{', '.join(f'{n} {kind}' for kind, n in counts) or 'no rows'}; {self.q.shape[1]} joints"

    def _columns(self) -> Mapping[str, Any]:
        """Return the columns by title; a quantity such as a position has one for each component."""
        titles = {quantity.field: quantity.columns for quantity in quantities() if len(quantity.columns) > 1}
        columns: dict[str, Any] = {}
        for name, column in self.columns.items():
            columns |= zip(titles[name], column.T, strict=True) if name in titles else {name: column}
        return columns

    @property
    def simulated(self) -> bool:
        """Whether any row was recorded with a simulated box."""
        return bool(np.any(self["simulated"] != ""))

    def replace(self, **columns: Any) -> ObservationTable:
        """Return the table with these columns; None takes a column out."""
        return ObservationTable(self.columns, **columns)

    def completed(self, mimics: Mapping[int, Mimic], n_joints: int) -> ObservationTable:
        """Return the table with the readings, velocities and directions of all joints, also of mimic joints."""
        slopes = {joint: mimic._replace(offset=0.0) for joint, mimic in mimics.items()}
        columns = {name: completed(self.columns[name], slopes, n_joints) for name in MOTIONS if name in self.columns}
        if "side" in columns:
            columns["side"] = np.sign(columns["side"])
        return self.replace(q=completed(self.q, mimics, n_joints), **columns) if mimics else self

    def select(self, rows: NDArray[Any] | slice) -> ObservationTable:
        """Return the rows selected by a boolean mask, an index array or a slice. Raises InputError for anything else.

        All rows in their order are the table itself, not a copy.
        """
        numbers = np.arange(len(self))
        try:
            index = numbers[rows]
        except (IndexError, TypeError, ValueError):
            index = np.array(0)
        if index.ndim != 1:
            raise InputError(
                Argument("rows"), f": must be a mask of {len(self)} rows, an array of row numbers or a slice"
            )
        if np.array_equal(index, numbers):
            return self
        return ObservationTable({name: column[index] for name, column in self.columns.items()})

    @classmethod
    def joined(cls, tables: Sequence[ObservationTable]) -> ObservationTable:
        """Return the rows of several tables, concatenated.

        Raises TypeError, InputError unless they are tables with the same number of joints.
        """
        converted("tables", tables, Sequence[ObservationTable])
        if len({table.q.shape[1] for table in tables}) != 1:
            raise InputError(Argument("tables"), ": must be one or more tables with the same number of joints")
        names = {name for table in tables for name in table.columns}
        return cls({name: np.concatenate([table[name] for table in tables]) for name in names})
