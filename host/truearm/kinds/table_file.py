"""Tables of observations: CSV with units in the column names, one observation per row (docs/reference/table-format.md).

``kinds.csv_cells`` reads the columns that ``table_titles`` declares. ``check_values`` then checks the rows, as it does
those of a table that was made in Python. Every error message names the file, the row (as an editor or a spreadsheet
counts, with the header as row 1) and the column.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from truearm.disk import read_text, write_atomic
from truearm.errors import Argument, TableError
from truearm.kinds import registry
from truearm.kinds.columns import ANYWHERE, CIRCUMSTANCES, LARGEST_NOISE, Quantity, is_label, quantities
from truearm.kinds.columns import identifiers as identifier_columns
from truearm.kinds.csv_cells import Column, CsvTable, Titles, csv_text, joint_titles, read_csv
from truearm.kinds.table import ObservationTable
from truearm.model.chain_structure import NO_MIMICS, Mimic
from truearm.model.robot_tables import MAX_JOINTS
from truearm.model.transforms import rotation_vector
from truearm.schema import HUGE, quoted
from truearm.text import page, with_article
from truearm.types import Floats, Rig
from truearm.units import SUFFIXES, named, suffixes

QUATERNION = ("qw", "qx", "qy", "qz")
MATRIX = tuple(f"r{row}{column}" for row in "123" for column in "123")
HOMOGENEOUS = tuple(f"m{row}{column}" for row in "012" for column in "012")
LAST_ROW = "m3[0-3]"
ROUNDING = 5e-3  # by which a published quaternion's length or a matrix's products may differ from those of a rotation


def rotation_vectors(cells: CsvTable) -> Floats | None:
    """Return the orientations (n, 3) [rad] of a table with a quaternion or a matrix, NaN in rows without one.

    None if it has neither. Raises TableError.
    """
    notations = [titles for titles in (QUATERNION, MATRIX, HOMOGENEOUS) if {*titles} & {*cells.columns}]
    if not notations:
        return None
    titles, *further = notations
    for title in titles:
        if title not in cells.columns:
            raise TableError("missing-column", place=cells.name, column=title)
    if further or "rx" in cells.columns:
        second_notation = f"{further[0][0]} to {further[0][-1]}" if further else cells.columns["rx"].title
        raise TableError(
            f"{cells.name}: has the orientation in {titles[0]} to {titles[-1]} and in {second_notation}; keep one"
        )
    values = cells.vectors(titles, f"{titles[0]} to {titles[-1]}")
    measured = np.flatnonzero(~np.isnan(values[:, 0]))
    out = np.full((len(values), 3), np.nan)
    if titles == QUATERNION:
        w, imaginary = values[measured, 0], values[measured, 1:]
        sine = np.linalg.norm(imaginary, axis=1)
        wrong = np.abs(np.hypot(w, sine) - 1.0) > ROUNDING
        per_sine = 2.0 * np.arctan2(sine, np.abs(w)) / np.where(sine > 0.0, sine, 1.0) * np.copysign(1.0, w)
        out[measured], remedy = per_sine[:, None] * imaginary, "are no quaternion of length 1"
    else:
        u, singular, vt = np.linalg.svd(values[measured].reshape(-1, 3, 3))
        wrong = (np.abs(singular - 1.0).max(axis=1) > ROUNDING) | (np.linalg.det(u @ vt) < 0.0)
        out[measured], remedy = (
            rotation_vector(u @ vt),
            "are not a rotation matrix; give them by rows, for right-handed axes",
        )
    for row in measured[wrong][:1]:
        raise TableError(f"{cells.sources[row]}: {titles[0]} to {titles[-1]} {remedy}")
    return out


MAX_BYTES = 16 * 2**20
OTHERS = (".toml", ".json", ".urdf", ".xml", ".xacro", ".html")  # of rigs, robots, results, reports
RIG = ".toml"
PAGE = page("Observations, rigs and robots as files")
LONGEST_LABEL = 64  # characters in a cell of the user's own columns; longer texts are notes
AT_ONCE = 2.0  # usual times between rows: a time so close to the first one begins another session


def check_is_observations(path: Path) -> None:
    """Raise TableError for a file with one of the suffixes OTHERS: commands read it as something else."""
    if path.suffix.lower() in OTHERS:
        hint = ("; a rig is given as ", Argument("rig")) if path.suffix.lower() == RIG else ()
        raise TableError(f"{path}: by its name, is neither a table of observations (.csv) nor a session (.mcap)", *hint)


def read_table(
    path: Path, joint_units: Sequence[str] | None = None, mimics: Mapping[int, Mimic] = NO_MIMICS
) -> ObservationTable:
    """Read a CSV table of observations.

    If ``joint_units`` ("rad" or "m" for each joint of the robot) is given, the joint columns must match it; those of
    the robot's ``mimics`` may be missing, and are computed. If all rows have a time, they are returned in that order.
    Raises TableError with file, row and column.
    """
    check_is_observations(path)
    return in_order_of_time(parse_table(read_text(path, MAX_BYTES, TableError), str(path), joint_units, mimics))


def parse_table(
    text: str, name: str, joint_units: Sequence[str] | None = None, mimics: Mapping[int, Mimic] = NO_MIMICS
) -> ObservationTable:
    """Parse the text of a table; ``name`` stands for the file in messages and in ``source``. See ``read_table``."""
    registry.check_kinds()
    cells = read_csv(text, name, table_titles(), PAGE, LAST_ROW)
    q, kind = cells.joints(joint_units, mimics), np.array(cells.cells("kind"))
    content: dict[str, Any] = {column: cells.identifiers(column) for column in identifier_columns()}
    content |= {quantity.field: _numbers(cells, quantity) for quantity in quantities()}
    if (rotation := rotation_vectors(cells)) is not None:
        content["rotation"] = rotation
    labels = {title: cells.cells(title) for title in filter(is_label, cells.columns)}
    content |= {title: np.array(texts) for title, texts in labels.items() if max(map(len, texts)) <= LONGEST_LABEL}
    content |= {"sigma": _sigmas(cells, kind), "q_rate": _rates(cells)}
    columns = {field: column for field, column in content.items() if _filled(column).any()}
    table = ObservationTable(columns, q=q, kind=kind, source=np.array(cells.sources))
    table = table.completed(mimics, len(joint_units or q.T))
    check_values(table, joint_units, cells.columns)
    return table


def table_titles() -> Titles:
    """Return the titles that a table may have, with the quantities that they stand for.

    A ``sigma`` in a unit other than metres is a separate quantity, ``sigma_rad``: a table may have both.
    """
    numbers = {
        named(column, unit): (column, unit)
        for quantity in quantities()
        for column in quantity.columns
        for unit in suffixes(quantity.unit)
    }
    sigmas = {named("sigma", unit): (_sigma(si), unit) for si in registry.units() for unit in suffixes(si)}
    positions = {named(f"m{i}3", unit): (axis, unit) for i, axis in enumerate("xyz") for unit in suffixes("m")}
    plain = ("kind", *identifier_columns(), *QUATERNION, *MATRIX, *HOMOGENEOUS)
    joints = joint_titles("q", (*suffixes("rad"), *suffixes("m")), MAX_JOINTS)
    rates = joint_titles("qd", (*suffixes("rad/s"), *suffixes("m/s")), MAX_JOINTS)
    return {title: (title, "") for title in plain} | sigmas | numbers | positions | joints | rates


def _sigma(si: str) -> str:
    """Return the quantity of the standard deviations in an SI unit."""
    return "sigma" if si == "m" else f"sigma_{si}"


def _numbers(cells: CsvTable, quantity: Quantity) -> Floats:
    """Return one column of a quantity as (n,), or several as (n, c), of any size."""
    if len(quantity.columns) == 1:
        return cells.numbers(quantity.columns[0], HUGE)
    return cells.vectors(quantity.columns, quantity.words, HUGE)


def _sigmas(cells: CsvTable, kind: np.ndarray) -> Floats:
    """Return the standard deviation (n,) of each row in the unit of its kind."""
    sigma = np.full(len(kind), np.nan)
    for unit in registry.units():
        values = cells.numbers(_sigma(unit), HUGE)
        has_unit = np.isin(kind, [key for key, entry in registry.kinds().items() if entry.components[0] == unit])
        for row in np.flatnonzero(~has_unit & ~np.isnan(values))[:1]:
            text = f"the residual of {with_article(kind[row])} row is not in its unit; leave that cell empty"
            raise TableError(f"{cells.place(row, _sigma(unit))}: {text}")
        sigma[has_unit] = values[has_unit]
    return sigma


def _rates(cells: CsvTable) -> Floats:
    """Return the joint velocities (n, j), NaN if the table has none."""
    joints, rates = cells.numbered("q"), cells.numbered("qd")
    if rates and len(rates) != len(joints):
        text = f"has {len(joints)} joint columns but {len(rates)} of velocities; give all or none"
        raise TableError(f"{cells.name}: {text}")
    for joint, rate in zip(joints, rates, strict=False):
        if f"{SUFFIXES[joint.unit].si}/s" != SUFFIXES[rate.unit].si:
            text = f"does not fit {joint.title}; one is revolute, the other prismatic"
            raise TableError(f"{cells.name} column {rate.title}: {text}")
    return cells.vectors([f"qd{i + 1}" for i in range(len(joints))], "the velocities of all joints")


def _filled(column: np.ndarray) -> np.ndarray:
    """Return a mask (n,) of the rows that are not empty in a column of identifiers or numbers."""
    return np.asarray(column != "" if column.dtype.kind == "U" else ~np.isnan(column.reshape(len(column), -1)[:, 0]))


def _field(column: str | Quantity) -> str:
    return column if isinstance(column, str) else column.field


def concatenate(tables: Sequence[ObservationTable]) -> ObservationTable:
    """Return the rows of several tables one after the other. Raises TableError if their numbers of joints differ."""
    for table in tables[1:]:
        if table.q.shape[1] != tables[0].q.shape[1]:
            raise TableError(
                f"{table.source[0]}: has {table.q.shape[1]} joints, {tables[0].source[0]} has {tables[0].q.shape[1]}; give rows of one robot"
            )
    return ObservationTable.joined(tables)


def check_values(
    table: ObservationTable, joint_units: Sequence[str] | None, columns: Mapping[str, Column] | None = None
) -> None:
    """Raise TableError for the first row of no kind, without what its kind needs, or with an implausible number.

    ``columns``: of the file that the table was read from, whose cells must be empty where its kind has nothing.
    """
    for row in np.flatnonzero(~np.isin(table.kind, list(registry.kinds())))[:1]:
        text = f"{quoted(str(table.kind[row]))} is not an observation kind; use {' or '.join(registry.kinds())}"
        raise TableError(f"{table.source[row]} column kind: {text}")
    for row, joint in np.argwhere(~np.isfinite(table.q))[:1].tolist():
        raise TableError(f"{table.source[row]}: q[{joint}] is not a finite number")
    rows_by_kind = {key: table.kind == key for key in dict.fromkeys(table.kind.tolist())}
    _check_kinds(table, rows_by_kind, columns is not None)
    every = np.ones(len(table), dtype=bool)
    noise = {unit: Quantity("sigma", (_sigma(unit),), unit, LARGEST_NOISE, positive=True) for unit in registry.units()}
    for quantity in CIRCUMSTANCES:
        _check_numbers(table, quantity, table[quantity.field], every, columns or {})
    for key, rows in rows_by_kind.items():
        kind = registry.kinds()[key]
        for quantity in (*kind.quantities, noise[kind.components[0]]):
            _check_numbers(table, quantity, table[quantity.field], rows, columns or {})
    for j, unit in enumerate(joint_units or ()):
        for name, readings, si in (("q", table.q, unit), ("q_rate", table.q_rate, f"{unit}/s")):
            _check_numbers(table, Quantity(name, (f"{name}[{j}]",), si), readings[:, j], every, {})


def _check_kinds(table: ObservationTable, rows_by_kind: Mapping[str, np.ndarray], strict: bool) -> None:
    """Raise TableError for the first row without what its kind needs or, if ``strict``, with what contradicts it."""
    titles = {column: column for column in identifier_columns()} | {q.field: q.title for q in quantities()}
    filled = {column: _filled(table[column]) for column in titles}
    wrong: list[tuple[int, str]] = []
    for key, rows in rows_by_kind.items():
        kind = registry.kinds()[key]
        needs = {*map(_field, kind.needs)}
        leaves = filled.keys() - {*needs, *map(_field, kind.may), *ANYWHERE, *map(_field, CIRCUMSTANCES)}
        for column in (*needs, *(leaves if strict else ())):
            text = "has no {}; leave that cell empty" if column in leaves else "needs {}, which is empty or missing"
            title = with_article(column) if column in needs and titles[column] == column else titles[column]
            bad = np.flatnonzero(rows & (filled[column] == (column in leaves)))
            wrong += [(int(row), f"{with_article(key)} row {text.format(title)}") for row in bad[:1]]
    if wrong:
        row, text = min(wrong)
        raise TableError(f"{table.source[row]}: {text}")


def _check_numbers(
    table: ObservationTable, quantity: Quantity, values: Floats, rows: np.ndarray, columns: Mapping[str, Column]
) -> None:
    """Raise TableError for the first implausible value (n, …) of a quantity in these rows (n,)."""
    bad = np.argwhere(quantity.implausible(values.reshape(len(table), -1)) & rows[:, None])
    for i, k in bad[:1].tolist():
        column = columns.get(quantity.columns[k], Column(quantity.columns[k], k, _own(quantity.unit)))
        unit, value = SUFFIXES[column.unit], float(values.reshape(len(table), -1)[i, k])
        bounds = f"{unit.text(quantity.least)} and {unit.text(quantity.most)}"
        text = f"{unit.text(value)} is not between {bounds}; is it in another unit?"
        raise TableError(f"{table.source[i]} column {column.title}: {text}")


def check_against_rig(table: ObservationTable, rig: Rig) -> None:
    """Raise TableError for the first row that names a bar, chuck, sphere, … that the rig does not have.

    It is also raised for a row that does not state which of several points it refers to, and for anything that the
    row's kind rejects.
    """
    for column, rig_names in registry.rig_names(rig).items():
        if unknown := {*table[column].tolist()} - {"", *rig_names}:
            i = np.flatnonzero(np.isin(table[column], [*unknown]))[0]
            where, name = table.source[i], table[column][i]
            raise TableError("not-in-rig", place=where, what=column, name=name, names=sorted(rig_names))
    for key, kind in registry.kinds().items():
        rows, points = table.kind == key, kind.points(rig)
        nameless = np.flatnonzero(rows & (table[kind.point] == "")) if len(points) > 1 else np.zeros(0, int)
        if nameless.size:
            names = ", ".join(sorted(points))
            place = f"{table.source[nameless[0]]} column {kind.point}"
            raise TableError(f"{place}: is empty; name one of the rig's ({names})")
        if kind.check and rows.any():
            kind.check(table, rig)


def format_table(table: ObservationTable, joint_units: Sequence[str]) -> str:
    """Return the text of a table, in rad and m so that numbers are stored bit for bit; ``source`` is not written."""
    columns = table_columns(table, joint_units)
    cells = [map(_written, c.tolist()) if c.dtype.kind == "f" else c.tolist() for c in columns.values()]
    return csv_text([columns, *zip(*cells, strict=True)])


def table_columns(table: ObservationTable, joint_units: Sequence[str]) -> dict[str, Any]:
    """Return titles and values of the columns that ``format_table`` writes; ``source`` is not among them."""
    names = {column: table[column] for column in (*identifier_columns(), *filter(is_label, table.columns))}
    return {
        "kind": table.kind,
        **_number_columns(table, joint_units),
        **{title: column for title, column in names.items() if np.any(column != "")},
    }


def _number_columns(table: ObservationTable, joint_units: Sequence[str]) -> dict[str, Floats]:
    """Return titles and values of the columns of numbers: the joints, and the others that contain any values."""
    joints = {f"q{i}_{unit}": table.q[:, i - 1] for i, unit in enumerate(joint_units, start=1)}
    measured: dict[str, Floats] = {}
    for quantity in quantities():
        components = np.atleast_2d(table[quantity.field].T)  # (components, rows), also of a table without rows
        measured |= {
            named(title, _own(quantity.unit)): component
            for title, component in zip(quantity.columns, components, strict=False)
        }
    for unit in registry.units():
        kind_names = [key for key, kind in registry.kinds().items() if kind.components[0] == unit]
        measured[named("sigma", _own(unit))] = np.where(np.isin(table.kind, kind_names), table.sigma, np.nan)
    measured |= {f"qd{i}_{unit}_s": table.q_rate[:, i - 1] for i, unit in enumerate(joint_units, start=1)}
    return joints | {title: column for title, column in measured.items() if not np.isnan(column).all()}


def column_of_title(table: ObservationTable, title: str) -> Floats | None:
    """Return a column of numbers (n,) in the unit of its title, such as "payload_kg" or "q1_deg".

    None if there is none.
    """
    if is_label(title) and title in table.columns:
        try:
            return np.where(table[title] == "", "nan", table[title]).astype(float)
        except ValueError:
            return None
    if title not in (titles := table_titles()):
        return None
    quantity, unit = titles[title]
    scale = SUFFIXES[unit]
    joint_units = [scale.si.removesuffix("/s")] * table.q.shape[1]
    column = _number_columns(table, joint_units).get(named(quantity, _own(scale.si)))
    return None if column is None else np.asarray(scale.of(column))


def _own(unit: str) -> str:
    """Return the ending of a title in an SI unit."""
    return next(iter(suffixes(unit)))


def _written(number: float) -> str:
    return "" if math.isnan(number) else repr(float(number))


def write_table(path: Path, table: ObservationTable, joint_units: Sequence[str]) -> None:
    """Write a table that ``read_table`` reads back exactly, except for ``source``.

    Raises TableError for rows that ``read_table`` would reject, and InputError if the file cannot be written.
    """
    text = format_table(table, joint_units)
    try:
        parse_table(text, "the table", joint_units)
    except TableError as error:
        raise TableError(f"{path}: not written, because it could not be read back: {error}") from None
    write_atomic(path, text)


def in_order_of_time(table: ObservationTable) -> ObservationTable:
    """Return the rows of one file in the order of their times; the table itself if they are in it.

    A table may be sorted by something else.

    Also if a row has no time, or if the times begin again: several sessions, one after the other, each with its own
    zero.
    """
    time = table.time
    if len(table) < 2 or not np.isfinite(time).all():
        return table
    back = np.flatnonzero(np.diff(time) < 0.0) + 1
    order = np.argsort(time, kind="stable")
    usual = float(np.median(np.diff(time[order])))
    begins_again = back.size > 0 and bool((time[back] <= time[order[0]] + AT_ONCE * usual).all())
    return table if begins_again else table.select(order)
