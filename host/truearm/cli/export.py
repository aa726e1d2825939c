"""``truearm export``: write a calibrated robot for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

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
    choices,
    completed,
    one_of,
    out_file,
    payload_of,
)
from truearm.cli.output import print_result
from truearm.export.formats import FORMATS, formats_help


def export(
    result: ResultArgument,
    form: Annotated[
        str,
        typer.Option(
            "--format",
            metavar=choices(FORMATS),
            callback=one_of(FORMATS),
            autocompletion=completed(FORMATS),
            help=formats_help(),
        ),
    ],
    out: Annotated[Path, out_file("the robot")],
    robot: IdentifiedRobotOption = None,
    base: IdentifiedBaseOption = None,
    tip: IdentifiedTipOption = None,
    own_frames: OwnFramesOption = False,
    payload: PayloadOption = None,
    adjust: Annotated[
        list[str] | None,
        typer.Option(
            metavar="PATTERN",
            help="Change only parameters that match, such as 'joint*.offset'; all others stay nominal (repeatable).",
        ),
    ] = None,
    over: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Poses over which to refit: a table or a plan (.csv). Default: random poses within the joint limits, or within the fitted readings if the result has joint laws.",
        ),
    ] = None,
    curves: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Write the joints' error curves too (.csv): reading, error, sigma, and whether the calibration covered the reading.",
        ),
    ] = None,
    allow_unusable: AllowUnusableOption = False,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Write a calibrated robot for other programs.

    If the format has no place for a parameter, or --adjust excludes it, the other parameters are refitted to compensate. The
    remaining error is printed.

    \b
    Example:
      truearm export result.json --format urdf --model panda.urdf --out calibrated.urdf
    """
    from truearm.cli.export_text import document, lines
    from truearm.files.robot_file import RobotChoice
    from truearm.workflows.export import ExportOptions, export_file

    options = ExportOptions(form, own_frames, tuple(adjust or ()), payload_of(payload))
    found = export_file(result, RobotChoice(robot, base, tip), out, options, over, curves, force, allow_unusable)
    written = [path for path in (out, curves) if path is not None]
    print_result(document(found, written), lines(found, written, over), as_json)
