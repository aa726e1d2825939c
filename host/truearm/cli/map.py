"""``truearm map``: where in its workspace the robot errs how much."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from truearm.cli.options import IdentifiedBaseOption, IdentifiedRobotOption, IdentifiedTipOption, ResultArgument
from truearm.units import MM


class Elbow(StrEnum):
    """Of the two configurations of the arm in the section."""

    up = "up"
    down = "down"


def map_(
    result: ResultArgument,
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="Write the cells as a table (.csv).")] = None,
    picture: Annotated[Path | None, typer.Option(metavar="FILE", help="Write the map as a picture (.svg).")] = None,
    robot: IdentifiedRobotOption = None,
    base: IdentifiedBaseOption = None,
    tip: IdentifiedTipOption = None,
    vary: Annotated[
        str, typer.Option(metavar="I,J", help="The two joints that span the section; their axes are parallel.")
    ] = "2,3",
    at: Annotated[
        str | None, typer.Option(metavar="Q1,Q2,...", help="Where the other joints stand [deg, mm]; default: 0.")
    ] = None,
    elbow: Annotated[Elbow, typer.Option(help="Which of the arm's two configurations.")] = Elbow.up,
    cell: Annotated[float, typer.Option(min=1.0, max=1000.0, metavar="MM", help="Size of a cell.")] = 25.0,
    task: Annotated[
        str | None, typer.Option(metavar="WxH", help="Find the best place for a task of this size [mm].")
    ] = None,
    within: Annotated[
        str | None,
        typer.Option(
            metavar="U0:U1,V0:V1",
            help="Look for that place only here, along the section's axes [mm]; default: all of it.",
        ),
    ] = None,
    own_frames: Annotated[bool, typer.Option("--own-frames", help="Leave out how base and tool were mounted.")] = False,
) -> None:
    """Map the robot's error without calibration over a section of its workspace, with the map's own uncertainty.

    \b
    Example:
      truearm map result.json --picture map.svg --task 300x200 --within 300:900,0:800
    """
    from truearm.files.robot_file import RobotChoice
    from truearm.workflows.error_map import Choice, map_files

    choice = Choice(
        RobotChoice(robot, base, tip), vary, at, elbow is Elbow.up, MM.to_si(cell), task, own_frames, within
    )
    for line in map_files(result, out, picture, choice):
        typer.echo(line)


map_.__name__ = "map"  # what the command is called; the name itself is Python's
