"""The work of ``truearm correct``: read, correct or refuse, write, say."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from truearm.correct.correction import Correction, correct
from truearm.correct.model_pair import Pair
from truearm.errors import InputError, ProgramError, TargetError
from truearm.files.disk import check_writable, write_atomic
from truearm.files.robot_file import RobotChoice
from truearm.files.target_programs import is_program, poses_of, quadrants_of, read_program, with_poses
from truearm.files.target_table import format_corrected, looks_like_targets, read_targets
from truearm.model.chain import point_jacobians
from truearm.model.poses import inverted, pose_of
from truearm.text import one_line
from truearm.types import Floats
from truearm.workflows.calibration import (
    Calibration,
    check_names,
    chosen_mountings,
    joints_of,
    mounting_lines,
    numbers_of,
    read_calibration,
)

SHOWN = 12  # targets printed one by one
MOVES = 1e-6  # m by a direction that was not seen, whose largest weight is 1
SEARCHED = (
    "The arm's configuration was searched for, each nearest to the one before. Give --home, or q1_deg … in a table, where the "
    "controller takes another."
)


class Choice(NamedTuple):
    """The command line."""

    robot: RobotChoice
    method: str
    steps: int
    own_frames: bool
    work: str | None
    tool: str | None
    home: str | None
    margin: float
    residuals: Path | None = None


@dataclass(frozen=True)
class _Request:
    """How to correct."""

    pair: Pair
    units: tuple[str, ...]
    method: str
    steps: int
    work: Floats  # (4, 4)
    tool: Floats  # (4, 4)
    home: Floats | None
    margin: float


class _Corrected(NamedTuple):
    """What was done, and what is to be said of it."""

    correction: Correction
    places: tuple[str, ...]  # of each target: "row 3", "line 12"
    notes: tuple[str, ...]


def correct_file(result: Path, targets: Path, out: Path, choice: Choice) -> list[str]:
    """Correct a table or a program and write it; returns what is to be said of it.

    Raises InputError in one line, and then writes nothing.
    """
    check_names(result, targets, out, choice.residuals)
    program = is_program(targets)
    read = [result, targets, *choice.robot.files]
    check_writable(out, inputs=read, ours=None if program else looks_like_targets)
    if program and out.exists():
        raise InputError(f"{out}: exists; a program is only written under a new name")
    calibration = read_calibration(result, choice.robot)
    request = _request(calibration, choice)
    if choice.residuals is not None:
        check_writable(choice.residuals, inputs=[*read, out], ours=looks_like_targets)
    found = _correct_program(targets, out, request) if program else _correct_table(targets, out, request)
    if choice.residuals is not None:
        write_atomic(choice.residuals, _residuals(found, "line" if program else "row"))
    return _summary(found, calibration, choice.own_frames, out)


def _request(calibration: Calibration, choice: Choice) -> _Request:
    taken_out = chosen_mountings(calibration, choice.own_frames)
    return _Request(
        pair=Pair(calibration.chain, calibration.nominal, calibration.identified, taken_out),
        units=calibration.joint_units,
        method=choice.method,
        steps=choice.steps,
        work=_frame("--work", choice.work),
        tool=_frame("--tool", choice.tool),
        home=joints_of("--home", choice.home, calibration.joint_units),
        margin=choice.margin,
    )


def _correct_table(path: Path, out: Path, request: _Request) -> _Corrected:
    targets = read_targets(path, request.units)
    if not targets.oriented and not np.array_equal(request.tool, np.eye(4)):
        raise TargetError(f"{path}: positions without orientations cannot be moved by --tool; give rx, ry, rz too")
    done = correct(
        request.pair,
        request.work @ targets.pose @ inverted(request.tool),
        request.method,
        request.steps,
        oriented=targets.oriented,
        q_start=targets.q_start,
        home=request.home,
        margin=request.margin,
    )
    _refuse(done, targets.source, TargetError)
    told = inverted(request.work) @ done.told @ request.tool
    write_atomic(out, format_corrected(targets, told, done.q, done.before, done.after, request.units))
    rows = tuple(source.rpartition(" ")[2] for source in targets.source)
    return _Corrected(done, rows, (SEARCHED,) if targets.q_start is None else ())


def _correct_program(path: Path, out: Path, request: _Request) -> _Corrected:
    program = read_program(path)
    quadrants = quadrants_of(program, len(request.units))
    done = correct(
        request.pair,
        request.work @ poses_of(program) @ inverted(request.tool),
        request.method,
        request.steps,
        home=request.home,
        quadrants=quadrants,
        margin=request.margin,
    )
    _refuse(done, [f"{path} line {target.line}" for target in program.targets], ProgramError)
    write_atomic(out, with_poses(program, inverted(request.work) @ done.told @ request.tool))
    lines = tuple(str(target.line) for target in program.targets)
    searched = [SEARCHED] if quadrants is None else _other_quadrant(done, quadrants, lines)
    return _Corrected(done, lines, (*_left(program.left), *searched))


def _refuse(done: Correction, sources: Sequence[str], error: type[InputError]) -> None:
    """Raise for the first target that cannot be corrected."""
    bad = [i for i, problem in enumerate(done.problem) if problem]
    if bad:
        more = f" ({len(bad)} of {len(sources)} targets cannot be corrected)" if len(bad) > 1 else ""
        raise error(f"{sources[bad[0]]}: {done.problem[bad[0]]}{more}; nothing was written")


def _left(lines: Sequence[int]) -> list[str]:
    return [f"Left as they are: {len(lines)} p[…] that no move goes to (lines {_listed(lines)})."] if lines else []


def _other_quadrant(done: Correction, quadrants: Floats, lines: Sequence[str]) -> list[str]:
    """Targets whose configuration data the corrected joints contradict."""
    wrong = ((np.floor(done.q / (0.5 * np.pi)) != quadrants) & ~np.isnan(quadrants)).any(axis=1)
    where = [line for line, is_wrong in zip(lines, wrong, strict=True) if is_wrong]
    return [
        f"Check the configuration data of {len(where)} robtargets (lines {_listed(where)}): by this model an axis is in another "
        "quarter turn."
    ] * bool(where)


def _listed(lines: Sequence[object]) -> str:
    return ", ".join(map(str, lines[:SHOWN])) + (", …" if len(lines) > SHOWN else "")


def _summary(found: _Corrected, calibration: Calibration, own_frames: bool, out: Path) -> list[str]:
    done, chain = found.correction, calibration.chain
    if own_frames:
        frames = "Targets lie in the robot's own base and flange frames; these mountings are left to you:"
    else:
        frames = (
            f"Targets are of {chain.end_frame} in {chain.base_frame}; how robot and tool were mounted is corrected too:"
        )
    lines = [
        one_line(frames),
        *(f"  {one_line(line)}" for line in mounting_lines(chain, calibration.nominal, calibration.identified)),
    ]
    lines.append(f"{'target':<10}{'before [mm]':>14}{'after [mm]':>14}{'before [deg]':>14}{'after [deg]':>14}")
    rows = list(zip(found.places, done.before, done.after, strict=True))
    lines += [f"{place:<10}{_cells(before, after)}" for place, before, after in rows[:SHOWN]]
    lines += [f"and {len(rows) - SHOWN} more"] * (len(rows) > SHOWN)
    before, after = (np.sqrt(np.mean(np.square(error), axis=0)) for error in (done.before, done.after))
    lines.append(f"{'RMS':<10}{_cells(before, after)}")
    lines.append("These errors are what the identified robot says; its own uncertainty comes on top.")
    lines += _doubts(calibration, done.q[:SHOWN], own_frames)
    return [*lines, *found.notes, f"Written: {one_line(str(out))}"]


def _doubts(calibration: Calibration, q: Floats, own_frames: bool) -> list[str]:
    """What a reader of the errors should know of the calibration."""
    doubts = []
    if calibration.stored.status != "converged":
        doubts.append(f"The fit had stopped early ({one_line(calibration.stored.status)[:40]}).")
    _, jac, _ = point_jacobians(calibration.chain, calibration.identified, q, np.zeros(3))
    if np.abs(jac @ calibration.unseen).max(initial=0.0) > MOVES:
        remedy = "" if own_frames else " With --own-frames base and tool stay out of the correction."
        doubts.append(
            "Combinations of parameters that the observations did not see move the end, how base or tool are mounted perhaps: "
            f"these are as described, not as measured.{remedy}"
        )
    return doubts


def _residuals(found: _Corrected, what: str) -> str:
    """One row a target; no angles where only positions matter."""
    lines = [f"{what},before_mm,after_mm,before_deg,after_deg"]
    for place, before, after in zip(found.places, found.correction.before, found.correction.after, strict=True):
        lengths = [f"{1e3 * error[0]:.6f}" for error in (before, after)]
        angles = [f"{math.degrees(error[1]):.6f}" if math.isfinite(error[1]) else "" for error in (before, after)]
        lines.append(",".join([place, *lengths, *angles]))
    return "\n".join([*lines, ""])


def _cells(before: Floats, after: Floats) -> str:
    mm = [f"{1e3 * error[0]:>14.4f}" for error in (before, after)]
    deg = [f"{math.degrees(error[1]):>14.5f}" if math.isfinite(error[1]) else f"{'-':>14}" for error in (before, after)]
    return "".join(mm + deg)


def _frame(option: str, text: str | None) -> Floats:
    """A pose (4, 4) of six numbers in mm and deg, the last three a rotation vector."""
    numbers = np.zeros(6) if text is None else numbers_of(option, text, 6)
    if np.abs(numbers[:3]).max() > 1e5 or np.abs(numbers[3:]).max() > 720.0:
        raise InputError(f"{option} {text}: needs x, y, z in mm and a rotation vector in deg")
    return np.asarray(pose_of(1e-3 * numbers[None, :3], np.radians(numbers[None, 3:]))[0])
