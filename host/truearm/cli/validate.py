"""``truearm validate``: does a calibration hold on other measurements?"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from truearm.cli.options import (
    IdentifiedBaseOption,
    IdentifiedRobotOption,
    IdentifiedTipOption,
    ResultArgument,
    rigs_of,
    warn,
)


def validate(
    result: ResultArgument,
    inputs: Annotated[
        list[Path], typer.Argument(metavar="INPUT", help="Sessions (.mcap) and tables (.csv) to judge by.")
    ],
    robot: IdentifiedRobotOption = None,
    base: IdentifiedBaseOption = None,
    tip: IdentifiedTipOption = None,
    rig: Annotated[
        list[str] | None,
        typer.Option(metavar="[NAME=]FILE", help="As of truearm identify; default: each session's own."),
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print numbers and verdict as JSON and nothing else.")
    ] = False,
    allow_damaged: Annotated[
        bool, typer.Option("--allow-damaged", help="Use what is whole of a session that is damaged.")
    ] = False,
) -> None:
    """Judge a calibration by other measurements: errors with and without it, by region, and a verdict.

    The robot stays as identified. What the rig does not know is settled on the rows that judge, for both alike.

    \b
    Example:
      truearm validate result.json friday.csv --rig rig.toml
    """
    from truearm.files.result_file import format_document
    from truearm.files.robot_file import RobotChoice
    from truearm.workflows.inputs import Sources
    from truearm.workflows.validate import validate_files, validation_lines

    sources = Sources(tuple(inputs), rigs_of(rig), allow_damaged=allow_damaged, say=warn)
    document = validate_files(result, RobotChoice(robot, base, tip), sources)
    if as_json:
        sys.stdout.write(format_document(document) + "\n")
        return
    for line in validation_lines(document):
        typer.echo(line)
