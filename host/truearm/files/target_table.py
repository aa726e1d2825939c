"""Tables of targets (CSV) and of their corrections (docs/reference/target-format.md).

A row is a pose of the end: ``x_mm, y_mm, z_mm`` (or ``_m``) and, unless only positions matter, its rotation vector
``rx_deg, ry_deg, rz_deg`` (or ``_rad``). ``q1_deg …`` (or ``_rad``, ``_mm``, ``_m``) are joint readings near those that
the controller will choose; without them the configuration is searched for. ``name`` is free for the user.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from truearm.errors import TableError, TargetError
from truearm.files.csv_cells import Row, identifiers, numbers, read_cells
from truearm.files.disk import read_text
from truearm.files.observation_columns import Column
from truearm.model.mimic import NO_MIMICS, Mimic, completed, units_of
from truearm.model.poses import pose_of
from truearm.model.rotation import rotation_vector
from truearm.schema import IDENTIFIER, Key, Number, hint, quoted
from truearm.types import Floats, Strings
from truearm.units import DEG, MM, SUFFIXES, UNITS, key, shown

MAX_BYTES = 64 * 2**20
MAX_TARGETS = 100_000
ROWS = 10_000  # that are written at a time
NAME = Key("name", IDENTIFIER)
XYZ = tuple(Key(name, Number("m")) for name in "xyz")
TURN = tuple(Key(name, Number("rad")) for name in ("rx", "ry", "rz"))
# truearm's columns in a table that is corrected again
RESULTS = re.compile(r"(before|after)_(mm|deg)|simulated|told_.*|x_.*")


class Targets(NamedTuple):
    """n targets as read."""

    pose: Floats  # (n, 4, 4); the orientation is the identity if the table has none
    oriented: bool
    q_start: Floats | None  # (n, j)
    name: Strings  # (n,)
    source: tuple[str, ...]  # "targets.csv row 3"


def check_is_table(path: Path, programs: Sequence[str] = ()) -> None:
    """Raise TargetError unless the name of a file is that of a table; ``programs``: suffixes that are possible too."""
    if path.suffix.lower() != ".csv":
        expectation = f"neither a table of targets (.csv) nor a program ({', '.join(programs)})"
        raise TargetError(f"{path}: is {expectation if programs else 'no table of targets (.csv)'}; give one of these")


def read_targets(path: Path, joint_units: Sequence[str], mimics: Mapping[int, Mimic] = NO_MIMICS) -> Targets:
    """Read a table of targets for a robot with these joints ("rad" or "m"), with or without its ``mimics``.

    Raises TargetError, with row and column if the file is a table.
    """
    check_is_table(path)
    try:
        return parse_targets(read_text(path, MAX_BYTES, TargetError), str(path), joint_units, mimics)
    except TableError as exc:
        raise TargetError(*exc.args, **exc.values) from exc


def parse_targets(text: str, name: str, joint_units: Sequence[str], mimics: Mapping[int, Mimic] = NO_MIMICS) -> Targets:
    """Parse the text of a table of targets; ``name`` stands for the file in messages. Raises TargetError or TableError."""
    header, rows = read_cells(text, name)
    if not rows:
        raise TargetError("no-rows", place=name)
    if len(rows) > MAX_TARGETS:
        raise TargetError(f"{name}: has {len(rows)} targets, the maximum is {MAX_TARGETS}; split it")
    units = units_of(sum(title.startswith("q") for title in header), joint_units, mimics)
    joints = [Key(f"q{i}", Number(unit)) for i, unit in enumerate(units, start=1)]
    columns = _columns(header, name, joints)
    xyz = _together(rows, columns, XYZ, name)
    turn = _together(rows, columns, TURN, name)
    q = _together(rows, columns, joints, name)
    if xyz is None:
        raise TargetError("missing-column", place=name, column="x_mm", example="x_mm,y_mm,z_mm")
    return Targets(
        pose=pose_of(xyz, np.zeros_like(xyz) if turn is None else turn),
        oriented=turn is not None,
        q_start=None if q is None else completed(q, mimics, len(joint_units)),
        name=identifiers(rows, columns.get("name"), name),
        source=tuple(f"{name} row {row.number}" for row in rows),
    )


def _columns(header: list[str], name: str, joints: Sequence[Key]) -> dict[str, Column]:
    keys = {spelled: key for key in (NAME, *XYZ, *TURN, *joints) for spelled in key.spellings}
    columns: dict[str, Column] = {}
    for position, title in enumerate(header):
        place = f"{name} column {position + 1} ({quoted(title)})"
        quantity, _, unit = title.rpartition("_")
        spellings = [spelled for spelled, key in keys.items() if key.name == quantity]
        if title not in keys:
            if spellings and unit in SUFFIXES:
                raise TargetError("wrong-value", place=place, names=spellings)
            if title == "note" or RESULTS.fullmatch(title):
                continue
            raise TargetError("unknown-column", place=place, remedy=hint(title, list(keys)))
        key = keys[title]
        if key.name in columns:
            raise TargetError("given-twice", place=place, what=key.name)
        columns[key.name] = Column(title, position, key.spellings[title])
    return columns


def _together(rows: list[Row], columns: dict[str, Column], keys: Sequence[Key], name: str) -> Floats | None:
    """Return columns of numbers side by side (n, k); a table must have all of them or none."""
    missing = [key for key in keys if key.name not in columns]
    if len(missing) == len(keys):
        return None
    if missing:
        unit = next(columns[key.name].unit for key in keys if key.name in columns)
        written = ({suffix: title for title, suffix in key.spellings.items()} for key in keys)
        titles = ", ".join(titles_by_unit.get(unit, next(iter(titles_by_unit.values()))) for titles_by_unit in written)
        raise TargetError("missing-column", place=name, column=missing[0].name, example=titles)
    largest = [UNITS[SUFFIXES[columns[key.name].unit].si].largest for key in keys]
    both = zip(keys, largest, strict=True)
    return np.stack([numbers(rows, columns[key.name], name, limit, required=True) for key, limit in both], axis=1)


def format_corrected(
    targets: Targets,
    commanded: Floats,
    q: Floats,
    error_before: Floats,
    error_after: Floats,
    joint_units: Sequence[str],
    simulated: bool = False,
) -> str:
    """Return the table for a controller: false targets, corrected joint readings, errors [mm, deg] before and after.

    A table of a simulated calibration has a column ``simulated``, as a table of observations.

    Positions and joints are written to 1e-7 mm and 1e-9 deg, finer than any controller accepts.
    """
    columns = [("name", "%s")] + [(f"{axis}_mm", "%.7f") for axis in "xyz"]
    columns += [(f"{axis}_deg", "%.9f") for axis in ("rx", "ry", "rz")] * targets.oriented
    columns += [(key(f"q{i}", unit), "%.9f") for i, unit in enumerate(joint_units, start=1)]
    columns += [("before_mm", "%.6f"), ("after_mm", "%.6f")]
    columns += [("before_deg", "%.6f"), ("after_deg", "%.6f")] * targets.oriented
    columns += [("simulated", "yes")] * simulated
    titles, formats = (",".join(column) for column in zip(*columns, strict=True))
    errors = np.stack([error_before, error_after], axis=1)
    blocks = [MM.of(commanded[:, :3, 3])]
    blocks += [DEG.of(rotation_vector(commanded[:, :3, :3]))] * targets.oriented
    blocks += [shown(q[:, i, None], unit) for i, unit in enumerate(joint_units)]
    blocks += [MM.of(errors[:, :, 0])] + [DEG.of(errors[:, :, 1])] * targets.oriented
    rows = [titles]
    for start in range(0, len(q), ROWS):
        numbers_of_rows = np.concatenate([block[start : start + ROWS] for block in blocks], axis=1).tolist()
        names = targets.name[start : start + ROWS].tolist()
        rows += [formats % (name, *row) for name, row in zip(names, numbers_of_rows, strict=True)]
    return "\n".join([*rows, ""])
