"""Plan files: CSV with one row per pose or line, in the order of the visits (docs/reference/table-format.md).

The columns are the fields of ``_Visit`` and ``q1_rad … qj_rad``. Written are ``pose, shell, bar, chuck, sphere``; in
plans that contain more than dwells, ``move, line, target, speed_mm_s``; ``robot``, if the plan was made for one.
``pose`` counts from 0. The recorder stores the plan in the session. Later a dwell is recognised by the planned joint
vector near it, and a line by the planned joint vectors between which it was driven.
"""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta, Struct

from truearm.errors import Argument, PlanError, TableError
from truearm.files.csv_cells import numbers, read_cells
from truearm.files.disk import read_text, write_atomic
from truearm.files.observation_columns import Column
from truearm.model.robot_tables import MAX_JOINTS
from truearm.schema import NAME
from truearm.types import BAR_MOUNTED, Move, Plan, Rig
from truearm.units import MM_S, UNITS

MAX_BYTES = 16 * 2**20
FASTEST = 10.0  # m/s; a higher speed was written in another unit
HEADER = "pose,shell,bar,chuck,sphere,q1_rad,..., for lines with move,line,target,speed_mm_s before the joints"

Name = Annotated[str, Meta(pattern=rf"^(?:{NAME.pattern})\Z")]


class _Visit(Struct, frozen=True, forbid_unknown_fields=True):
    """A row without its joints; an empty cell has the default."""

    pose: int
    shell: Name = ""
    bar: Name = ""
    chuck: Name = ""
    sphere: Name = ""
    move: Move = Move.DWELL
    line: Name = ""
    target: Name = ""
    speed_mm_s: Annotated[float, Meta(gt=0.0, le=MM_S.of(FASTEST))] = math.nan
    robot: Annotated[str, Meta(max_length=100)] = ""

    def __post_init__(self) -> None:
        n_mounted, has_speed = sum(bool(getattr(self, name)) for name in BAR_MOUNTED), not math.isnan(self.speed_mm_s)
        if self.move == Move.LINE:
            if n_mounted or not self.line or not has_speed:
                raise ValueError("a line needs line and speed_mm_s, and no bar, chuck or sphere")
        elif self.line or self.target or has_speed:
            raise ValueError("only lines have line, target or speed_mm_s; leave them empty")
        elif n_mounted not in (0, 3) or (self.move == Move.DWELL and not n_mounted):
            raise ValueError("needs bar, chuck and sphere" + ", or none of them" * (self.move == Move.VIA))


def concatenate(*plans: Plan) -> Plan:
    """Return several plans, visited one after the other. Raises PlanError if their numbers of joints differ."""
    joints = sorted({plan.q.shape[1] for plan in plans})
    if len(joints) != 1:
        raise PlanError(
            f"the plans are for different robots: they have {' and '.join(str(n) for n in joints)} joints; give plans for one robot"
        )
    return Plan(**{name: np.concatenate([getattr(plan, name) for plan in plans]) for name in Plan.columns()})


def read_plan(path: Path) -> Plan:
    """Read a plan file. Raises PlanError that names file, row and column."""
    return parse_plan(read_text(path, MAX_BYTES, PlanError), str(path))


def parse_plan(text: str, name: str) -> Plan:
    """Parse the text of a plan; ``name`` stands for the file in messages. See ``read_plan``."""
    try:
        header, rows = read_cells(text, name)
        joints = [Column(title, i, "rad") for i, title in enumerate(header) if title.startswith("q")]
        names = [joint.name for joint in joints]
        if names != _joints(len(names)) or not 0 < len(names) <= MAX_JOINTS or len({*header}) < len(header):
            raise PlanError(
                f"{name} row 1: needs the columns q1_rad to at most q{MAX_JOINTS}_rad, and none twice; write {HEADER}"
            )
        if not rows:
            raise PlanError("no-rows", place=name)
        q = np.stack([numbers(rows, joint, name, UNITS["rad"].largest, required=True) for joint in joints], axis=1)
    except TableError as exc:
        raise PlanError(*exc.args, **exc.values) from exc
    titles = {title: i for i, title in enumerate(header) if not title.startswith("q")}
    visits = [_visit({title: row.cells[i] for title, i in titles.items()}, f"{name} row {row.number}") for row in rows]
    for number, visit in enumerate(visits):
        if visit.pose != number:
            raise PlanError(
                f"{name}: pose {visit.pose} is in the place of pose {number}; number them from 0 without gaps"
            )
    if visits[0].move == Move.LINE:
        raise PlanError(f"{name} row {rows[0].number}: a line starts at the pose of the row before it; add that row")
    columns = {title: np.array([getattr(visit, title) for visit in visits]) for title in _Visit.__struct_fields__[1:]}
    speed = MM_S.to_si(columns.pop("speed_mm_s"))
    if (columns["move"] == Move.VIA).all():
        raise PlanError(
            f"{name}: has nothing to measure, only poses to pass through; add poses with bar, chuck and sphere, or a line"
        )
    return Plan(q, **columns, speed=speed)


def _visit(cells: dict[str, str], place: str) -> _Visit:
    """Return a row from its cells by title. Raises PlanError."""
    try:
        return msgspec.convert({title: cell for title, cell in cells.items() if cell}, _Visit, strict=False)
    except msgspec.ValidationError as exc:
        reason, _, column = str(exc).replace("`", "").partition(" - at $.")
        prefix = f"{place} column {column}: {cells[column][:40]!r}: " if column else f"{place}: "
        raise PlanError(f"{prefix}{reason[0].lower()}{reason[1:]}; the columns are {HEADER}") from exc


def _joints(n_joints: int) -> list[str]:
    return [f"q{i + 1}_rad" for i in range(n_joints)]


def check_against_rig(plan: Plan, rig: Rig, name: str) -> None:
    """Raise PlanError for the first row that names something unknown to the rig, or no target where there are several."""
    lines = rig.lines or dict.fromkeys(plan.line[plan.lines].tolist())  # a rig that lists none accepts any
    for column, names in {**rig.mounted(), "line": lines}.items():
        for pose, identifier in enumerate(getattr(plan, column)):
            chosen = column == "target" and plan.move[pose] == Move.LINE and len(names) > 1
            if identifier not in names and (identifier or chosen):
                raise PlanError(
                    "not-in-rig", place=f"{name} pose {pose}", what=column, name=identifier, names=sorted(names)
                )


def check_robot(plan: Plan, robot: str, name: str, *remedy: str | Argument) -> None:
    """Raise PlanError for a plan that states that it was made for another robot; ``remedy`` ends the message."""
    robots = sorted(set(plan.robot.tolist()) - {"", robot})
    if robots:
        raise PlanError(f"{name}: was made for robot {', '.join(robots)}, not for {robot}", *remedy)


def format_plan(plan: Plan) -> str:
    """Return the text of a plan file.

    Joints are stored bit for bit, speeds to 1 pm/s. Plans with dwells only have no columns of motion.
    """
    columns = {"pose": range(len(plan)), **{name: getattr(plan, name) for name in Plan.IDS}}
    if not plan.dwells.all():
        speeds = ["" if math.isnan(speed) else repr(round(MM_S.of(speed), 9)) for speed in plan.speed.tolist()]
        columns |= {"move": plan.move, "line": plan.line, "target": plan.target, "speed_mm_s": speeds}
    if (plan.robot != "").any():
        columns["robot"] = plan.robot
    columns |= {title: map(repr, q.tolist()) for title, q in zip(_joints(plan.q.shape[1]), plan.q.T, strict=True)}
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*columns.values(), strict=True))
    return text.getvalue()


def write_plan(path: Path, plan: Plan) -> None:
    """Write a plan that ``read_plan`` reads back exactly. Raises InputError."""
    write_atomic(path, format_plan(plan))
