"""``truearm correct``: targets or a program in, what to tell the controller out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from truearm.cli.options import (
    BaseOption,
    IdentifiedRobotOption,
    OwnFramesOption,
    ResultArgument,
    TipOption,
    frame_of,
    joints_of,
    numbers_of,
    out_file,
)
from truearm.cli.output import print_lines
from truearm.correct.methods import Method, methods_help, with_steps

MOST_STEPS = 50


def correct(
    result: ResultArgument,
    targets: Annotated[
        Path,
        typer.Argument(metavar="TARGETS", help="Targets (.csv), a RAPID module (.mod, .prg) or a URScript (.script)."),
    ],
    out: Annotated[Path, out_file("the corrected table or program")],
    robot: IdentifiedRobotOption = None,
    base: BaseOption = None,
    tip: TipOption = None,
    method: Annotated[Method, typer.Option(help=methods_help())] = Method.NEWTON,
    steps: Annotated[
        int, typer.Option(min=1, max=MOST_STEPS, metavar="N", help=f"Apply {' or '.join(with_steps())} so often.")
    ] = 1,
    own_frames: OwnFramesOption = False,
    work: Annotated[
        str | None,
        typer.Option(metavar="X,Y,Z,RX,RY,RZ", help="Frame that the targets are in, in the base frame [mm, deg]."),
    ] = None,
    tool: Annotated[
        str | None, typer.Option(metavar="X,Y,Z,RX,RY,RZ", help="The tool's pose in the end frame [mm, deg].")
    ] = None,
    home: Annotated[
        str | None,
        typer.Option(
            metavar="Q1,Q2,...", help="Joints near those of the first target, to choose the configuration [deg, mm]."
        ),
    ] = None,
    residuals: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write every target's error before and after as a table (.csv).")
    ] = None,
    margin: Annotated[
        float, typer.Option(min=1e-4, max=1.0, metavar="SIGMA", help="Refuse targets nearer to a singularity.")
    ] = 0.05,
) -> None:
    """Correct targets, so that the true robot goes where they say.

    Of a program only the numbers of its targets change. Nothing is written where one target cannot be corrected.

    \b
    Example:
      truearm correct result.json program.mod --robot irb120 --out corrected.mod
    """
    from truearm.cli.correct_text import lines
    from truearm.files.robot_file import RobotChoice
    from truearm.workflows.calibration import read_calibration
    from truearm.workflows.correct import CorrectFiles, CorrectOptions, correct_file

    work_frame, tool_frame, shown = frame_of("--work", work), frame_of("--tool", tool), numbers_of("--home", home)
    files = CorrectFiles(result, RobotChoice(robot, base, tip), targets, out, residuals)
    calibration = read_calibration(files.result, files.robot)
    options = CorrectOptions(
        method=method,
        steps=steps,
        own_frames=own_frames,
        margin=margin,
        work=work_frame,
        tool=tool_frame,
        home=joints_of("--home", shown, calibration.joint_units),
    )
    print_lines(lines(correct_file(calibration, files, options)))
