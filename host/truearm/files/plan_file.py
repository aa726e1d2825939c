"""Plan files: CSV with one row per pose or line, in the order of the visits (docs/reference/table-format.md).

The columns are ``pose, shell, bar, chuck, sphere``; in plans that contain more than dwells, ``move, line, target,
speed_mm_s``; optionally ``robot``, the name of the robot for which the plan was made; and ``q1_rad … qj_rad``. ``pose``
counts from 0. The recorder stores the plan in the session. Later a dwell is recognised by the planned joint vector near
it, and a line by the planned joint vectors between which it was driven.
"""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path
from typing import assert_never

import numpy as np

from truearm.errors import Argument, PlanError
from truearm.files.csv_cells import NUMBER, check_width, read_rows
from truearm.files.disk import read_text, write_atomic
from truearm.model.robot_tables import MAX_JOINTS
from truearm.schema import NAME
from truearm.types import BAR_MOUNTED, LINE_MOUNTED, Move, Plan, Rig
from truearm.units import MM_S, UNITS

MAX_BYTES = 16 * 2**20
IDS = Plan.IDS
MOTION = ("move", "line", "target", "speed_mm_s")  # all four or none
ROBOT = "robot"
MAX_ROBOT = 100  # characters of a robot's name
FASTEST = 10.0  # m/s; a higher speed was written in another unit


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
    rows = read_rows(text, name, PlanError)
    if not rows:
        raise PlanError(f"{name}: is empty; a plan begins with the header pose,shell,bar,chuck,sphere,q1_rad,...")
    header = rows[0].cells
    moving, named = MOTION[0] in header[:6], ROBOT in header[:10]
    names = _names(moving, named)
    expected = [*names, *_joints(len(header) - len(names))]
    if not len(names) < len(header) <= len(names) + MAX_JOINTS or header != expected:
        wrong = next((title for title, right in zip(header, expected, strict=False) if title != right), None)
        many = f"has more than {MAX_JOINTS} joint columns" if len(header) > len(names) else "has no joint columns"
        fault = many if wrong is None else f"column {wrong[:40]!r} is wrong"
        raise PlanError(
            f"{name} row 1: {fault}; the header is {','.join(_names(False, False))},q1_rad,... "
            f"or {','.join(_names(True, False))},q1_rad,..., with or without {ROBOT} before the joints"
        )
    if len(rows) == 1:
        raise PlanError("no-rows", place=name)
    for pose, row in enumerate(rows[1:]):
        check_width(row, len(header), name, PlanError)
        _check_names(dict(zip(names, row.cells, strict=False)), pose, f"{name} row {row.number}")
    q = np.array([[_angle(c, f"{name} row {number}") for c in cells[len(names) :]] for number, cells in rows[1:]])
    columns = dict(zip(names, np.array([cells[: len(names)] for _, cells in rows[1:]]).T, strict=True))
    ids = {name: columns[name] for name in (*IDS, *(ROBOT,) * named)}
    if not moving:
        return Plan(q, **ids)
    move = np.where(columns["move"] == "", Move.DWELL.value, columns["move"])
    if (move == Move.VIA).all():
        raise PlanError(
            f"{name}: has nothing to measure, only poses to pass through; add poses with bar, chuck and sphere, or a line"
        )
    speed = np.array([MM_S.to_si(float(cell)) if cell else np.nan for cell in columns["speed_mm_s"]])
    return Plan(q, **ids, move=move, line=columns["line"], target=columns["target"], speed=speed)


def _names(moving: bool, named: bool) -> list[str]:
    """Return the columns before the joints."""
    return ["pose", *IDS, *(MOTION if moving else ()), *(ROBOT,) * named]


def _joints(n_joints: int) -> list[str]:
    return [f"q{i + 1}_rad" for i in range(n_joints)]


def _check_names(cells: dict[str, str], pose: int, where: str) -> None:
    """Check that the names in one row match its kind of move."""
    if cells["pose"] != str(pose):
        raise PlanError(
            f"{where}: pose is {cells['pose'][:40]!r}, expected {pose}; poses are numbered from 0 without gaps"
        )
    if len(cells.get(ROBOT, "")) > MAX_ROBOT:
        raise PlanError(f"{where} column {ROBOT}: has more than {MAX_ROBOT} characters")
    move = cells.get("move") or Move.DWELL
    if move not in tuple(Move):
        raise PlanError("wrong-value", place=f"{where} column move", value=move[:40], names=list(Move))
    for name in (*IDS, *LINE_MOUNTED):
        cell = cells.get(name, "")
        if not NAME.fullmatch(cell) and (cell or name in _required(Move(move))):
            raise PlanError(f"{where} column {name}: {cell[:40]!r} is not an identifier (letters, digits, '-', '_')")
    fitted = [name for name in BAR_MOUNTED if cells[name]]
    if move == Move.LINE:
        if pose == 0:
            raise PlanError(f"{where}: a line starts at the pose of the row before it; add that row")
        if fitted:
            raise PlanError(f"{where} column {fitted[0]}: no bar is mounted on a line; leave it empty")
        _speed(cells["speed_mm_s"], where)
        return
    if len(fitted) not in (0, 3):
        missing = " and ".join(name for name in BAR_MOUNTED if name not in fitted)
        raise PlanError(f"{where}: names {' and '.join(fitted)} but not {missing}; name all three or none")
    for name in ("line", "target", "speed_mm_s"):
        if cells.get(name):
            raise PlanError(f"{where} column {name}: only lines have this value; leave it empty")


def _required(move: Move) -> tuple[str, ...]:
    """Return the columns that a row must fill in."""
    match move:
        case Move.DWELL:
            return BAR_MOUNTED
        case Move.VIA:
            return ()
        case Move.LINE:
            return ("line",)
        case _:
            assert_never(move)


def _speed(cell: str, where: str) -> None:
    if not NUMBER.fullmatch(cell[:60]) or not 0.0 < float(cell[:60]) <= MM_S.of(FASTEST):
        raise PlanError(
            f"{where} column speed_mm_s: {cell[:40]!r} is not a speed in mm/s above 0 and at most {MM_S.of(FASTEST):g}"
        )


def _angle(cell: str, where: str) -> float:
    if len(cell) > 60 or not NUMBER.fullmatch(cell):
        raise PlanError(f"{where}: {cell[:40]!r} is not a number; write digits with a decimal point, such as -0.25")
    if abs(float(cell)) > UNITS["rad"].largest:
        raise PlanError(f"{where}: {cell} rad is more than ten turns; are the joints in degrees?")
    return float(cell)


def check_against_rig(plan: Plan, rig: Rig, name: str) -> None:
    """Raise PlanError for the first row that names something unknown to the rig, or no target where there are several."""
    lines = rig.lines or dict.fromkeys(plan.line[plan.lines].tolist())  # a rig that lists none accepts any
    for column, known in {**rig.mounted(), "line": lines}.items():
        for pose, identifier in enumerate(getattr(plan, column)):
            chosen = column == "target" and plan.move[pose] == Move.LINE and len(known) > 1
            if identifier not in known and (identifier or chosen):
                raise PlanError(
                    "not-in-rig", place=f"{name} pose {pose}", what=column, name=identifier, names=sorted(known)
                )


def check_robot(plan: Plan, robot: str, name: str, *remedy: str | Argument) -> None:
    """Raise PlanError for a plan that states that it was made for another robot; ``remedy`` ends the message."""
    others = sorted(set(plan.robot.tolist()) - {"", robot})
    if others:
        raise PlanError(f"{name}: was made for robot {', '.join(others)}, not for {robot}", *remedy)


def format_plan(plan: Plan) -> str:
    """Return the text of a plan file.

    Joints are stored bit for bit, speeds to 1 pm/s. Plans with dwells only have no columns of motion.
    """
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    moving, named = not plan.dwells.all(), bool((plan.robot != "").any())
    writer.writerow([*_names(moving, named), *_joints(plan.q.shape[1])])
    for pose in range(len(plan)):
        motion = _motion(plan, pose) if moving else ()
        names = (getattr(plan, name)[pose] for name in IDS)
        robot = [plan.robot[pose]] if named else []
        writer.writerow([pose, *names, *motion, *robot, *map(repr, plan.q[pose].tolist())])
    return text.getvalue()


def _motion(plan: Plan, pose: int) -> tuple[str, ...]:
    """Return the cells of MOTION."""
    speed = float(plan.speed[pose])
    cell = "" if math.isnan(speed) else repr(round(MM_S.of(speed), 9))
    return str(plan.move[pose]), str(plan.line[pose]), str(plan.target[pose]), cell


def write_plan(path: Path, plan: Plan) -> None:
    """Write a plan that ``read_plan`` reads back exactly. Raises InputError."""
    write_atomic(path, format_plan(plan))
