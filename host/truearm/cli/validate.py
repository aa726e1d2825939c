"""``truearm validate``: does a calibration hold on other measurements?"""

from __future__ import annotations

from typing import Annotated

import typer

from truearm.cli.options import (
    AllowDamagedOption,
    BaseOption,
    IdentifiedRobotOption,
    InputsArgument,
    JsonOption,
    NamedRigsOption,
    ResultArgument,
    TipOption,
    rigs_of,
)
from truearm.cli.output import print_lines, warn


def validate(
    result: ResultArgument,
    inputs: InputsArgument,
    robot: IdentifiedRobotOption = None,
    base: BaseOption = None,
    tip: TipOption = None,
    rig: NamedRigsOption = None,
    keep_rig: Annotated[
        bool,
        typer.Option(
            "--keep-rig",
            help="Hold what the identification found of the rig: trackers, targets, chucks, bars, and what --allow found in all rows.",
        ),
    ] = False,
    as_json: JsonOption = False,
    allow_damaged: AllowDamagedOption = False,
) -> None:
    """Judge a calibration by other measurements: errors with and without it, by region, and a verdict.

    The robot stays as identified. What the rig does not know is settled on the rows that judge, for both alike, or with --keep-rig
    held as it was identified, where nothing was moved since. Without the calibration base and tool are placed on these rows too.

    \b
    Example:
      truearm validate result.json friday.csv --rig rig.toml
    """
    from truearm.files.result_file import format_document
    from truearm.files.robot_file import RobotChoice
    from truearm.workflows.inputs import Sources
    from truearm.workflows.validate import validate_files, validation_lines

    sources = Sources(tuple(inputs), rigs_of(rig), allow_damaged=allow_damaged, say=warn)
    document = validate_files(result, RobotChoice(robot, base, tip), sources, keep_rig).document
    if as_json:
        typer.echo(format_document(document))
    else:
        print_lines(validation_lines(document))
