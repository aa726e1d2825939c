"""Tables of targets (CSV) and of their corrections (docs/reference/target-format.md).

A row is a pose of the end: ``x_mm, y_mm, z_mm`` (or ``_m``) and, unless only positions matter, its rotation vector
``rx_deg, ry_deg, rz_deg`` (or ``_rad``). ``q1_deg …`` (or ``_rad``, ``_mm``, ``_m``) are joint readings near those that
the controller will choose; without them the configuration is searched for. ``name`` is free for the user.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from truearm.disk import read_text
from truearm.errors import TableError, TargetError
from truearm.kinds.csv_cells import joint_titles, read_csv
from truearm.model.chain_structure import NO_MIMICS, Mimic, completed
from truearm.model.robot_tables import MAX_JOINTS
from truearm.model.transforms import pose_of, rotation_vector
from truearm.text import page
from truearm.types import Floats, Strings
from truearm.units import DEG, MM, key, named, shown, suffixes

MAX_BYTES = 64 * 2**20
MAX_TARGETS = 100_000
ROWS = 10_000  # that are written at a time
XYZ, TURN = ("x", "y", "z"), ("rx", "ry", "rz")
RESULTS = r"(before|after)_(mm|deg)|simulated|told_.*"  # truearm's columns in a table that is corrected again


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
    """Parse the text of a table of targets; ``name`` stands for the file in messages.

    Raises TargetError or TableError.
    """
    lengths = {named(axis, unit): (axis, unit) for axis in XYZ for unit in suffixes("m")}
    angles = {named(axis, unit): (axis, unit) for axis in TURN for unit in suffixes("rad")}
    joints = joint_titles("q", (*suffixes("rad"), *suffixes("m")), MAX_JOINTS)
    titles = {"x_mm": ("x", "mm"), "name": ("name", ""), **lengths, **angles, **joints}
    cells = read_csv(text, name, titles, page("Targets and programs"), RESULTS)
    if len(cells.rows) > MAX_TARGETS:
        raise TargetError(f"{name}: has {len(cells.rows)} targets, the maximum is {MAX_TARGETS}; split it")
    xyz, turn = (cells.vectors(axes, ", ".join(axes), required=True) for axes in (XYZ, TURN))
    oriented, placed = "rx" in cells.columns, bool(cells.numbered("q"))
    return Targets(
        pose=pose_of(xyz, turn if oriented else np.zeros_like(xyz)),
        oriented=oriented,
        q_start=completed(cells.joints(joint_units, mimics), mimics, len(joint_units)) if placed else None,
        name=cells.identifiers("name"),
        source=tuple(cells.sources),
    )


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
