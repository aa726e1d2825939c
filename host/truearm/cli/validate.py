"""``truearm validate``: judge a calibration by other measurements."""

from __future__ import annotations

from pathlib import Path

import typer

from truearm.cli.command import command
from truearm.cli.options import rigs_of
from truearm.cli.output import print_lines, warn


@command()
def validate(
    result: Path,
    inputs: list[Path],
    *,
    model: str | None = None,
    base: str | None = None,
    tip: str | None = None,
    rig: list[str] | None = None,
    keep_rig: bool = False,
    json: bool = False,
    allow_damaged: bool = False,
) -> None:
    """Judge a calibration by other measurements: errors with and without it, in parts of the workspace, and a verdict.

    The robot's parameters stay as identified. The unknowns of the rig are estimated from the new rows, with and without the
    calibration alike, or held with --keep-rig. For the errors without the calibration, the poses of base and tool are estimated
    from these rows too if the rows determine them; the output says so.

    Example:
      truearm validate result.json friday.csv --rig rig.toml

    Options
    -------
    rig : [NAME=]FILE
        Rig (.toml). {named_rigs}. Default: the rig in each session.
    keep_rig
        Hold the rig at its identified values: trackers, targets, chucks, bars, and the errors that --allow estimated
        over all rows (without @FIRST). Only if nothing was moved since.
    """
    from truearm.files.result_file import format_document
    from truearm.files.robot_file import RobotChoice
    from truearm.report.validation_words import validation_lines
    from truearm.workflows.inputs import Sources
    from truearm.workflows.validate import validate_files

    sources = Sources(tuple(inputs), rigs_of(rig), allow_damaged=allow_damaged, say=warn)
    document = validate_files(result, RobotChoice(model, base, tip), sources, keep_rig).document
    if json:
        typer.echo(format_document(document))
    else:
        print_lines(validation_lines(document))
