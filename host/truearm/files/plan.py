"""Plan files: CSV with one row a pose, in the order of the visits (docs/table-format.md).

Columns ``pose, shell, bar, chuck, sphere, q1_rad … qj_rad``; ``pose`` counts from 0. The recorder stores the plan in the
session; later a dwell is known by the planned joint vector that it stands at. A plan without shells may leave ``shell``
empty.
"""

from __future__ import annotations

import csv
import io
import math
import re
from pathlib import Path

import numpy as np

from truearm.errors import PlanError
from truearm.files.disk import read_text, write_atomic
from truearm.types import Plan, Rig

MAX_BYTES = 16 * 2**20
MAX_JOINTS = 64
IDS = Plan.IDS
LARGEST = 20.0 * math.pi  # rad; an angle beyond ten turns was written in degrees

_ID = re.compile(r"[\w-]{1,64}")
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)


def concatenate(*plans: Plan) -> Plan:
    """Several plans visited one after the other. Raises PlanError when their joints differ in number."""
    if len({plan.q.shape[1] for plan in plans}) != 1:
        raise PlanError(f"plans of different robots: they have {[plan.q.shape[1] for plan in plans]} joints")
    ids = (np.concatenate([getattr(plan, name) for plan in plans]) for name in IDS)
    return Plan(np.concatenate([plan.q for plan in plans]), *ids)


def read_plan(path: Path) -> Plan:
    """Read a plan file. Raises PlanError that names file, row and column."""
    return parse_plan(read_text(path, MAX_BYTES, PlanError), str(path))


def parse_plan(text: str, name: str) -> Plan:
    """Parse the text of a plan; ``name`` stands for the file in messages. See ``read_plan``."""
    rows = _rows(text, name)
    if not rows:
        raise PlanError(f"{name}: is empty; a plan begins with the header pose,shell,bar,chuck,sphere,q1_rad,...")
    header = rows[0][1]
    n_joints = len(header) - 1 - len(IDS)
    expected = _header(n_joints)
    if not 1 <= n_joints <= MAX_JOINTS or header != expected:
        wrong = next((title for title, right in zip(header, expected, strict=False) if title != right), "the last")
        raise PlanError(f"{name} row 1: column {wrong[:40]!r} is wrong; the header is pose,{','.join(IDS)},q1_rad,...")
    if len(rows) == 1:
        raise PlanError(f"{name}: has a header but no poses")
    for pose, (number, cells) in enumerate(rows[1:]):
        _check_row(cells, pose, len(header), f"{name} row {number}")
    q = np.array([[_angle(cell, f"{name} row {number}") for cell in cells[5:]] for number, cells in rows[1:]])
    columns = np.array([cells[1:5] for _, cells in rows[1:]]).T
    return Plan(q, *columns)


def _header(n_joints: int) -> list[str]:
    return ["pose", *IDS, *(f"q{i + 1}_rad" for i in range(n_joints))]


def _rows(text: str, name: str) -> list[tuple[int, list[str]]]:
    """Line numbers and stripped cells; blank lines are passed over."""
    reader = csv.reader(io.StringIO(text, newline=None), strict=True)
    try:
        return [(reader.line_num, [cell.strip() for cell in cells]) for cells in reader if cells]
    except csv.Error as exc:
        raise PlanError(f"{name} row {reader.line_num}: is not CSV: {exc}") from exc


def _check_row(cells: list[str], pose: int, width: int, where: str) -> None:
    if len(cells) != width:
        raise PlanError(f"{where}: has {len(cells)} cells, the header has {width}")
    if cells[0] != str(pose):
        raise PlanError(f"{where}: pose is {cells[0][:40]!r}, expected {pose}; poses count from 0 without gaps")
    for name, cell in zip(IDS, cells[1:], strict=False):
        if not _ID.fullmatch(cell) and not (name == "shell" and cell == ""):
            raise PlanError(f"{where} column {name}: {cell[:40]!r} is no identifier (letters, digits, '-', '_')")


def _angle(cell: str, where: str) -> float:
    if len(cell) > 60 or not _NUMBER.fullmatch(cell):
        raise PlanError(f"{where}: {cell[:40]!r} is not a number")
    if abs(float(cell)) > LARGEST:
        raise PlanError(f"{where}: {cell} rad is more than ten turns; are the joints in degrees?")
    return float(cell)


def check_against_rig(plan: Plan, rig: Rig, name: str) -> None:
    """Raise PlanError for the first pose with a bar, chuck or sphere that the rig does not have."""
    for column, known in (("bar", rig.bars), ("chuck", rig.chucks), ("sphere", rig.spheres)):
        for pose, identifier in enumerate(getattr(plan, column)):
            if identifier not in known:
                names = ", ".join(sorted(known)) or "none"
                raise PlanError(
                    f"{name} pose {pose} column {column}: {str(identifier)!r} is not in the rig (it has {names})"
                )


def format_plan(plan: Plan) -> str:
    """The text of a plan file; every number comes back bit for bit."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(_header(plan.q.shape[1]))
    for pose in range(len(plan)):
        writer.writerow([pose, *(getattr(plan, name)[pose] for name in IDS), *map(repr, plan.q[pose].tolist())])
    return text.getvalue()


def write_plan(path: Path, plan: Plan) -> None:
    """Write a plan that ``read_plan`` reads back exactly. Raises InputError."""
    write_atomic(path, format_plan(plan))
