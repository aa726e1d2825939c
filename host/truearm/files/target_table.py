"""Tables of targets (CSV) and of what became of them (docs/target-format.md).

A row is a pose of the end: ``x_mm, y_mm, z_mm`` (or ``_m``) and, unless only positions matter, its rotation vector
``rx_deg, ry_deg, rz_deg`` (or ``_rad``). ``q1_deg …`` (or ``_rad``, ``_mm``, ``_m``) are joint readings near those that the
controller will take; without them the configuration is searched for. ``name`` is the user's own.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from truearm.errors import TableError, TargetError
from truearm.files.csv_cells import Row, identifiers, numbers, read_cells
from truearm.files.disk import read_text
from truearm.files.observation_columns import Column, shown
from truearm.model.poses import pose_of
from truearm.types import Floats, Strings
from truearm.units import DEG, MM, SUFFIXES, UNITS, key, number

MAX_BYTES = 16 * 2**20
MAX_TARGETS = 20_000
_TITLE = re.compile(r"(r?[xyz]|q[1-9][0-9]?)_(mm|m|deg|rad)")
RESULTS = re.compile(r"(before|after)_(mm|deg)|told_.*|x_.*")  # columns of ours in a table that is corrected again


class Targets(NamedTuple):
    """n targets as read."""

    pose: Floats  # (n, 4, 4); the orientation is the identity where the table has none
    oriented: bool
    q_start: Floats | None  # (n, j)
    name: Strings  # (n,)
    source: tuple[str, ...]  # "targets.csv row 3"


def read_targets(path: Path, joint_units: Sequence[str]) -> Targets:
    """Read a table of targets for a robot with these joints ("rad" or "m"). Raises TargetError with row and column."""
    try:
        return parse_targets(read_text(path, MAX_BYTES, TargetError), str(path), joint_units)
    except TableError as exc:
        raise TargetError(str(exc)) from exc


def parse_targets(text: str, name: str, joint_units: Sequence[str]) -> Targets:
    """Parse the text of a table of targets; ``name`` stands for the file in messages. Raises TargetError or TableError."""
    header, rows = read_cells(text, name)
    if not rows:
        raise TargetError(f"{name}: has a header but no targets")
    if len(rows) > MAX_TARGETS:
        raise TargetError(f"{name}: has {len(rows)} targets, the most is {MAX_TARGETS}; split it")
    columns = _columns(header, name)
    xyz = _three(rows, columns, ("x", "y", "z"), name)
    turn = _three(rows, columns, ("rx", "ry", "rz"), name)
    if xyz is None:
        raise TargetError(f"{name}: has no columns x_mm, y_mm, z_mm (or x_m, y_m, z_m)")
    return Targets(
        pose=pose_of(xyz, np.zeros_like(xyz) if turn is None else turn),
        oriented=turn is not None,
        q_start=_joints(rows, columns, joint_units, name),
        name=identifiers(rows, columns.get("name"), name),
        source=tuple(f"{name} row {row.number}" for row in rows),
    )


def _columns(header: list[str], name: str) -> dict[str, Column]:
    columns: dict[str, Column] = {}
    for position, title in enumerate(header):
        where = f"{name} column {position + 1} ({shown(title)})"
        match = _TITLE.fullmatch(title)
        quantity = "name" if title == "name" else match[1] if match else ""
        if not quantity:
            if title == "note" or RESULTS.fullmatch(title):
                continue
            raise TargetError(
                f"{where}: is no known column; use name, x_mm, y_mm, z_mm, rx_deg, ry_deg, rz_deg, q1_deg"
            )
        unit = match[2] if match else ""
        if match and quantity[0] != "q" and SUFFIXES[unit].si != ("rad" if quantity[0] == "r" else "m"):
            raise TargetError(f"{where}: unit {unit} does not fit {quantity}")
        if quantity in columns:
            raise TargetError(f"{where}: {quantity} is given twice; keep one")
        columns[quantity] = Column(title, position, unit)
    return columns


def _three(rows: list[Row], columns: dict[str, Column], names: Sequence[str], name: str) -> Floats | None:
    given = [quantity for quantity in names if quantity in columns]
    if not given:
        return None
    if len(given) < len(names):
        raise TargetError(f"{name}: has {', '.join(given)} but not all of {', '.join(names)}")
    return np.stack([_required(rows, columns[quantity], name) for quantity in names], axis=1)


def _joints(rows: list[Row], columns: dict[str, Column], units: Sequence[str], name: str) -> Floats | None:
    given = {quantity for quantity in columns if quantity[0] == "q"}
    if not given:
        return None
    wanted = [f"q{i}" for i in range(1, len(units) + 1)]
    if given != set(wanted):
        raise TargetError(f"{name}: the robot has {len(units)} joints; give q1 to q{len(units)}, or none")
    for quantity, unit in zip(wanted, units, strict=True):
        if SUFFIXES[columns[quantity].unit].si != unit:
            raise TargetError(f"{name} column {columns[quantity].name}: the robot's joint is measured in {unit}")
    return np.stack([_required(rows, columns[quantity], name) for quantity in wanted], axis=1)


def _required(rows: list[Row], column: Column, name: str) -> Floats:
    return numbers(rows, column, name, UNITS[SUFFIXES[column.unit].si].largest, required=True)


def format_corrected(
    targets: Targets, told: Floats, q: Floats, before: Floats, after: Floats, joint_units: Sequence[str]
) -> str:
    """The table to tell a controller: false targets, corrected joint readings, and errors [mm, deg] before and after.

    Positions and joints have 1e-7 mm and 1e-9 deg, less than any controller takes.
    """
    turn = DEG.of(Rotation.from_matrix(told[:, :3, :3]).as_rotvec())
    titles = ["name", "x_mm", "y_mm", "z_mm", *(["rx_deg", "ry_deg", "rz_deg"] if targets.oriented else [])]
    titles += [key(f"q{i}", unit) for i, unit in enumerate(joint_units, start=1)]
    titles += ["before_mm", "after_mm", *(["before_deg", "after_deg"] if targets.oriented else [])]
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(titles)
    for i, label in enumerate(targets.name):
        place = [f"{v:.7f}" for v in MM.of(told[i, :3, 3])] + [f"{v:.9f}" for v in turn[i]] * targets.oriented
        errors = [f"{MM.of(v):.6f}" for v in (before[i, 0], after[i, 0])]
        angles = [f"{DEG.of(v):.6f}" for v in (before[i, 1], after[i, 1])] if targets.oriented else []
        writer.writerow(
            [label, *place, *(number(v, unit, 9) for v, unit in zip(q[i], joint_units, strict=True)), *errors, *angles]
        )
    return text.getvalue()


def looks_like_targets(head: bytes) -> bool:
    """Whether a file that begins so is a table of corrected targets, or empty."""
    return not head.strip() or b"after_mm" in head.split(b"\n", 1)[0]
