"""``truearm map``: map the robot's error over its workspace."""

from __future__ import annotations

import re
from enum import StrEnum
from pathlib import Path
from typing import Annotated, assert_never

import typer

from truearm.bounds import CELL
from truearm.cli.options import (
    AllowUnusableOption,
    ForceOption,
    IdentifiedBaseOption,
    IdentifiedRobotOption,
    IdentifiedTipOption,
    JsonOption,
    OwnFramesOption,
    PayloadOption,
    ResultArgument,
    bounded,
    joints_of,
    numbers_of,
    out_file,
    payload_of,
)
from truearm.cli.output import print_result
from truearm.errors import InputError
from truearm.text import one_line
from truearm.units import MM


class Elbow(StrEnum):
    """Configuration of the arm in the section."""

    up = "up"
    down = "down"


def map_(
    result: ResultArgument,
    out: Annotated[Path | None, out_file("the cells as a table (.csv)")] = None,
    picture: Annotated[Path | None, typer.Option(metavar="FILE", help="Write the map as a picture (.svg).")] = None,
    robot: IdentifiedRobotOption = None,
    base: IdentifiedBaseOption = None,
    tip: IdentifiedTipOption = None,
    joints: Annotated[
        str,
        typer.Option(
            "--vary", metavar="I,J", help="The two joints that span the section; their axes must be parallel."
        ),
    ] = "2,3",
    at: Annotated[
        str | None,
        typer.Option(
            metavar="Q1,Q2,...", help="Values of all joints [deg, mm]; those of --vary do not matter. Default: 0."
        ),
    ] = None,
    elbow: Annotated[Elbow, typer.Option(help="Configuration of the elbow.")] = Elbow.up,
    cell: Annotated[float, typer.Option(metavar="MM", help="Size of a cell.", **bounded(CELL, MM))] = 25.0,
    task: Annotated[
        str | None, typer.Option(metavar="WxH", help="Find the best place for a task of this size [mm].")
    ] = None,
    within: Annotated[
        str | None,
        typer.Option(
            metavar="U0:U1,V0:V1",
            help="Range of the search for --task, along the section's axes [mm]. Default: the whole section.",
        ),
    ] = None,
    own_frames: OwnFramesOption = False,
    payload: PayloadOption = None,
    allow_unusable: AllowUnusableOption = False,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Map the error of the uncalibrated robot over a section of its workspace, with the uncertainty of the map.

    \b
    Example:
      truearm map result.json --picture map.svg --task 300x200 --within 300:900,0:800
    """
    from truearm.cli.map_text import document, lines
    from truearm.files.robot_file import RobotChoice
    from truearm.report.result_words import SIMULATED
    from truearm.workflows.calibration import read_usable
    from truearm.workflows.map import MapFiles, MapTask, Section, map_files

    if task is None and within is not None:
        raise InputError("--within needs --task WxH: it says where the task may be placed")
    varied, shown = _joints_of(joints), numbers_of("--at", at)
    wanted = None if task is None else MapTask(_size_of(task), None if within is None else _span_of(within))
    files = MapFiles(result, RobotChoice(robot, base, tip), out, picture, force)
    calibration = read_usable(files.result, files.robot, allow_unusable).carrying(*payload_of(payload))
    stand = joints_of("--at", shown, calibration.joint_units)
    section = Section(varied, stand, _is_up(elbow), MM.to_si(cell), own_frames)
    found = map_files(calibration, files, section, wanted)
    written = [str(path) for path in (out, picture) if path is not None]
    origin = [SIMULATED] if calibration.simulated else []
    print_result(
        {"simulated": calibration.simulated, **document(found, section.cell), "written": written},
        [
            *origin,
            *lines(found, section.cell, task, within is not None),
            *(f"Written: {one_line(path)}" for path in written),
        ],
        as_json,
    )


def _is_up(elbow: Elbow) -> bool:
    match elbow:
        case Elbow.up:
            return True
        case Elbow.down:
            return False
        case _:
            assert_never(elbow)


def _joints_of(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"([1-9][0-9]?),([1-9][0-9]?)", text)
    if match is None:
        raise InputError(f"--vary {text[:40]}: needs two joints, such as 2,3")
    return int(match[1]), int(match[2])


def _span_of(text: str) -> tuple[float, float, float, float]:
    """u0, u1, v0, v1 [m]"""
    number = r"(-?[0-9]{1,6}(?:\.[0-9]{1,6})?)"
    match = re.fullmatch(f"{number}:{number},{number}:{number}", text)
    u0, u1, v0, v1 = (MM.to_si(float(part)) for part in match.groups()) if match else (0.0,) * 4
    if u0 >= u1 or v0 >= v1:
        raise InputError(
            f"--within {text[:40]}: needs LOW:HIGH,LOW:HIGH in mm along the section's axes, such as 300:900,0:800"
        )
    return u0, u1, v0, v1


def _size_of(text: str) -> tuple[float, float]:
    match = re.fullmatch(r"([0-9]{1,6}(?:\.[0-9]{1,6})?)x([0-9]{1,6}(?:\.[0-9]{1,6})?)", text)
    if match is None or min(float(match[1]), float(match[2])) <= 0.0:
        raise InputError(f"--task {text[:40]}: needs width and height in mm, such as 300x200")
    return MM.to_si(float(match[1])), MM.to_si(float(match[2]))


map_.__name__ = "map"  # the command's name; map itself is a Python builtin
