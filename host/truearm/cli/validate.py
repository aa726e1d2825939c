"""``truearm validate``: judge a calibration by other measurements."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import click

from truearm.bounds import Within
from truearm.cli.command import Answer, command
from truearm.cli.options import command_line, issue_of, sources_of
from truearm.cli.output import before_error
from truearm.errors import Argument, InputError
from truearm.model.robot_file import NO_ROBOT, RobotChoice


@command()
def validate(
    context: click.Context,
    result: Path,
    inputs: tuple[Path, ...],
    *,
    robot: RobotChoice = NO_ROBOT,
    rig: tuple[str, ...] = (),
    keep_rig: bool = False,
    report: Path | None = None,
    number: str = "",
    tolerance_mm: Annotated[float | None, Within(1e-3, 100.0)] = None,
    allow_damaged: bool = False,
    force: bool = False,
) -> Answer:
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
    report : FILE
        Write a page with a certificate of the validation (.html).
    details
        Print every note and the errors in parts of the workspace.

    Expert options
    --------------
    keep_rig
        Hold the rig at its identified values: trackers, targets, chucks, bars, and the faults that --apply estimated
        over all rows (without @FIRST). Only if nothing was moved since.
    """
    from truearm.report.validation_findings import error_tables
    from truearm.workflows.identify import IdentifyFiles
    from truearm.workflows.report import validate_files

    sources = sources_of(inputs, rig, allow_damaged=allow_damaged)
    if report is None and (number or tolerance_mm is not None):
        raise InputError("needs-option", place="the details of a certificate", needed=Argument("report"))
    files = IdentifyFiles(robot, sources, report=report, command=command_line(context), force=force)
    with before_error(sources.said):
        document = validate_files(result, files, issue_of(number, tolerance_mm), keep_rig).document
    return Answer(document, tables=error_tables(document), written=[report], details_hint="Errors by region: --details")
