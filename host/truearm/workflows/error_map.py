"""The work of ``truearm map``: the section, its table and picture, the best region."""

from __future__ import annotations

import csv
import io
import math
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from truearm.correct.error_map import ErrorMap, Region, best_region, error_map
from truearm.correct.model_pair import Pair
from truearm.errors import InputError
from truearm.files.disk import check_writable, write_atomic
from truearm.files.robot_file import RobotChoice
from truearm.report.map_picture import map_picture
from truearm.text import one_line
from truearm.types import Floats
from truearm.units import MM, key, number
from truearm.workflows.calibration import (
    Calibration,
    check_names,
    chosen_mountings,
    joints_of,
    read_calibration,
)

MARK = "u_mm,v_mm"


class Choice(NamedTuple):
    """The command line."""

    robot: RobotChoice
    vary: str
    at: str | None
    elbow_up: bool
    cell: float  # m
    task: str | None
    own_frames: bool
    within: str | None = None


def map_files(result: Path, out: Path | None, picture: Path | None, choice: Choice) -> list[str]:
    """Write what was asked for; returns what is to be said. Raises InputError in one line."""
    check_names(result, out, picture)
    read = [result, *choice.robot.files]
    if out is not None:
        check_writable(out, inputs=read, ours=lambda head: not head.strip() or head.startswith(MARK.encode()))
    if picture is not None:
        check_writable(picture, inputs=[*read, *filter(None, [out])], ours=_looks_like_picture)
    calibration = read_calibration(result, choice.robot)
    found, region = _mapped(calibration, choice)
    if out is not None:
        write_atomic(out, _table(found, calibration.joint_units))
    if picture is not None:
        write_atomic(picture, _picture(found, region, calibration))
    return [*_said(found, region, choice), *(f"Written: {one_line(str(path))}" for path in (out, picture) if path)]


def _looks_like_picture(head: bytes) -> bool:
    return not head.strip() or (head.startswith(b"<svg") and b"Error of" in head)


def _mapped(calibration: Calibration, choice: Choice) -> tuple[ErrorMap, Region | None]:
    chain = calibration.chain
    pair = Pair(chain, calibration.nominal, calibration.identified, chosen_mountings(calibration, choice.own_frames))
    q = joints_of("--at", choice.at, calibration.joint_units)
    q = np.zeros(len(chain.joints)) if q is None else q
    varied = _pair_of(choice.vary, q.size)
    for i, joint in enumerate(chain.joints):
        if choice.at and i not in varied and not joint.lower <= q[i] <= joint.upper:
            raise InputError(f"--at {choice.at[:60]}: joint {i + 1} would be outside its limits")
    found = error_map(pair, q, varied, choice.cell, calibration.covariance, calibration.unseen, choice.elbow_up)
    return found, _best(found, choice)


def _pair_of(text: str, n_joints: int) -> tuple[int, int]:
    match = re.fullmatch(r"([1-9][0-9]?),([1-9][0-9]?)", text)
    if match is None or max(int(match[1]), int(match[2])) > n_joints:
        raise InputError(f"--vary {text[:40]}: needs two joints between 1 and {n_joints}, as 2,3")
    return int(match[1]) - 1, int(match[2]) - 1


def _best(found: ErrorMap, choice: Choice) -> Region | None:
    """The best place for a task, where one was asked for."""
    if choice.task is None:
        if choice.within is not None:
            raise InputError("--within: is of the place for a --task WxH; give that too")
        return None
    return best_region(found, *_size_of(choice.task), None if choice.within is None else _span_of(choice.within))


def _span_of(text: str) -> tuple[float, float, float, float]:
    """u0, u1, v0, v1 [m]"""
    number = r"(-?[0-9]{1,6}(?:\.[0-9]{1,6})?)"
    match = re.fullmatch(f"{number}:{number},{number}:{number}", text)
    u0, u1, v0, v1 = (MM.to_si(float(part)) for part in match.groups()) if match else (0.0,) * 4
    if u0 >= u1 or v0 >= v1:
        raise InputError(
            f"--within {text[:40]}: needs LOW:HIGH,LOW:HIGH in mm along the section's axes, as 300:900,0:800"
        )
    return u0, u1, v0, v1


def _size_of(text: str) -> tuple[float, float]:
    match = re.fullmatch(r"([0-9]{1,6}(?:\.[0-9]{1,6})?)x([0-9]{1,6}(?:\.[0-9]{1,6})?)", text)
    if match is None or min(float(match[1]), float(match[2])) <= 0.0:
        raise InputError(f"--task {text[:40]}: needs width and height in mm, as 300x200")
    return MM.to_si(float(match[1])), MM.to_si(float(match[2]))


def _table(found: ErrorMap, units: tuple[str, ...]) -> str:
    """One row a cell that is reached; u, v are the cell's middle, x, y, z where the nominal end is."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    joints = [key(f"q{i}", unit) for i, unit in enumerate(units, start=1)]
    writer.writerow(["u_mm", "v_mm", "x_mm", "y_mm", "z_mm", *joints, "error_mm", "sigma_mm"])
    for i, j in zip(*np.nonzero(~np.isnan(found.error)), strict=True):
        place = MM.of(np.array([found.u[j], found.v[i], *found.point[i, j]]))
        sigma = number(found.sigma[i, j], "m", 5) if np.isfinite(found.sigma[i, j]) else ""
        cells = [f"{value:.3f}" for value in place] + [
            number(value, unit, 5) for value, unit in zip(found.q[i, j], units, strict=True)
        ]
        writer.writerow([*cells, number(found.error[i, j], "m", 5), sigma])
    return text.getvalue()


def _picture(found: ErrorMap, region: Region | None, calibration: Calibration) -> str:
    task = None if region is None else MM.of(np.array([*region.u, *region.v])).tolist()
    labels = [f"{_axis(direction)} [mm]" for direction in found.axes]
    title = f"Error of {one_line(calibration.chain.name)[:40]} as described"
    return map_picture(MM.of(found.u), MM.of(found.v), MM.of(found.error), MM.of(found.sigma), title, task, labels)


def _axis(direction: Floats) -> str:
    """x, y, z for the axes of the base frame, else the direction's components."""
    for i, name in enumerate("xyz"):
        if abs(direction[i]) > 1.0 - 1e-6:
            return ("-" if direction[i] < 0.0 else "") + name
    return "along (" + ", ".join(f"{value:.2f}" for value in direction) + ")"


def _said(found: ErrorMap, region: Region | None, choice: Choice) -> list[str]:
    error = MM.of(found.error[~np.isnan(found.error)])
    rms = math.sqrt(float(np.mean(error**2)))
    lines = [
        f"{error.size} cells of {MM.text(choice.cell)}: error without calibration {error.min():.3f} to {error.max():.3f} mm, "
        f"RMS {rms:.3f} mm."
    ]
    sigma = MM.of(found.sigma[np.isfinite(found.sigma)])
    if sigma.size:
        lines.append(
            f"With it, by the parameters' covariance: {sigma.min():.3f} to {sigma.max():.3f} mm (standard deviation)."
        )
    if sigma.size < error.size:
        lines.append(
            f"In {error.size - sigma.size} cells that cannot be said: combinations of parameters that were not seen move the end."
        )
    if choice.task:
        lines.append(_task_said(found, region, choice.task))
    return lines


def _task_said(found: ErrorMap, region: Region | None, task: str) -> str:
    if region is None:
        return f"A task of {task} mm fits nowhere into what the arm reaches in this section."
    u, v = (tuple(round(MM.of(value)) for value in span) for span in (region.u, region.v))
    names = [_axis(direction) for direction in found.axes]
    return (
        f"Best place for a task of {task} mm: {names[0]} {u[0]} to {u[1]}, {names[1]} {v[0]} to {v[1]} mm; error at most "
        f"{MM.text(region.largest, '.3f')}, RMS {MM.text(region.rms, '.3f')}."
    )
