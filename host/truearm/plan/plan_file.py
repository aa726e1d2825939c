"""Plan files: CSV with one row per pose or line, in the order of the visits (docs/reference/table-format.md).

The columns are ``COLUMNS`` and ``q1_rad … qj_rad``, in any order. Written are ``pose, shell, bar, chuck, sphere``; in
plans that contain more than dwells, ``move, line, target, speed_mm_s``; ``robot``, if the plan was made for one.
``pose`` counts from 0. The recorder stores the plan in the session. Later a dwell is recognised by the planned joint
vector near it, and a line by the planned joint vectors between which it was driven.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from truearm.disk import read_text, write_atomic
from truearm.errors import Argument, PlanError, TableError
from truearm.kinds.csv_cells import csv_text, joint_titles, read_csv
from truearm.model.robot_tables import MAX_JOINTS
from truearm.schema import quoted
from truearm.text import page
from truearm.types import BAR_MOUNTED, Move, Plan, Rig
from truearm.units import MM_S

MAX_BYTES = 16 * 2**20
SLOWEST, FASTEST = 1e-12, 10.0  # m/s; a higher speed was written in another unit
MAX_ROBOT = 100  # characters of a robot's name
MOTION = ("line", "target", "speed_mm_s")
COLUMNS = ("pose", *Plan.IDS, "move", *MOTION, "robot")


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
    joints = joint_titles("q", ("rad",), MAX_JOINTS)
    titles = {title: (title, "") for title in COLUMNS} | {"speed_mm_s": ("speed", MM_S.suffix)} | joints
    try:
        cells = read_csv(text, name, titles, page("Observations, rigs and robots as files"))
        q = cells.joints()
        ids = {title: cells.identifiers(title) for title in (*Plan.IDS, *MOTION[:2])}
        speed = cells.numbers("speed", FASTEST, SLOWEST)
    except TableError as exc:
        raise PlanError(*exc.args, **exc.values) from exc
    columns = {title: cells.cells(titles[title][0]) for title in COLUMNS}
    for pose, (visit, place) in enumerate(zip(zip(*columns.values()), cells.sources, strict=True)):
        _check_visit(dict(zip(columns, visit, strict=True)), pose, place)
    move = np.array([move or Move.DWELL.value for move in columns["move"]])
    if (move == Move.VIA).all():
        raise PlanError(
            f"{name}: has nothing to measure, only poses to pass through; add poses with bar, chuck and sphere, or a line"
        )
    return Plan(q, **ids, move=move, speed=speed, robot=np.array(columns["robot"]))


def _check_visit(visit: dict[str, str], pose: int, place: str) -> None:
    """Raise PlanError if the cells of a row, by column, are not those of ``pose``, or do not fit its move."""
    if visit["pose"] != str(pose):
        text = f"{quoted(visit['pose'])}, expected {pose}; rows are numbered from 0 without gaps"
        raise PlanError(f"{place} column pose: {text}")
    if len(visit["robot"]) > MAX_ROBOT:
        raise PlanError(f"{place} column robot: has more than {MAX_ROBOT} characters; give the robot's name")
    move = visit["move"] or Move.DWELL.value
    if move not in tuple(Move):
        raise PlanError("wrong-value", place=f"{place} column move", value=move[:40], names=list(Move))
    mounted = [title for title in BAR_MOUNTED if visit[title]]
    needed: tuple[str, ...] = BAR_MOUNTED if mounted or move == Move.DWELL else ()
    foreign, reason = [title for title in MOTION if visit[title]], "only lines have this value"
    if move == Move.LINE:
        if pose == 0:
            raise PlanError(f"{place}: a line starts at the pose of the row before it; add that row")
        needed, foreign, reason = ("line", "speed_mm_s"), mounted, "no bar is mounted on a line"
    if missing := [title for title in needed if not visit[title]]:
        remedy = f"every {move} needs {' and '.join(needed)}"
        if move == Move.VIA:
            remedy = "name bar, chuck and sphere, or none of them"
        raise PlanError(f"{place} column {missing[0]}: has no value; {remedy}")
    if foreign:
        raise PlanError(f"{place} column {foreign[0]}: {reason}; leave it empty")


def check_against_rig(plan: Plan, rig: Rig, name: str) -> None:
    """Raise PlanError for the first row that names something unknown to the rig, or no target though it has several."""
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
    columns |= {f"q{i}_rad": map(repr, q.tolist()) for i, q in enumerate(plan.q.T, start=1)}
    return csv_text([columns, *zip(*columns.values(), strict=True)])


def write_plan(path: Path, plan: Plan) -> None:
    """Write a plan that ``read_plan`` reads back exactly. Raises InputError."""
    write_atomic(path, format_plan(plan))
