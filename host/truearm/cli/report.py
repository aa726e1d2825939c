"""``truearm report``: write the report on a result, with its certificate."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import click

from truearm.bounds import LINE_POINTS, Within
from truearm.cli.command import Answer, command
from truearm.cli.options import command_line, issue_of, sources_of
from truearm.cli.output import before_error
from truearm.findings import entries, option
from truearm.model.robot_file import NO_ROBOT, RobotChoice
from truearm.text import one_line


@command()
def report(
    context: click.Context,
    result: Path,
    inputs: tuple[Path, ...] = (),
    *,
    out: Path,
    robot: RobotChoice = NO_ROBOT,
    rig: tuple[str, ...] = (),
    number: str = "",
    tolerance_mm: Annotated[float | None, Within(1e-3, 100.0)] = None,
    line_points: Annotated[int | None, LINE_POINTS] = None,
    force: bool = False,
) -> Answer:
    """Write the report on a result, with a certificate as its first page.

    The fit is repeated from the files of the result, with the same options. If the files differ, or the outcome does, no report is written.
    The certificate takes name, serial number, controller, customer and operator from truearm.toml.

    Example:
      truearm report result.json session.mcap --number 2026-7 --out report.html

    Arguments
    ---------
    inputs : INPUT...
        Sessions (.mcap) and tables (.csv) that the result was made from. Default: those in the folder of the result, in this
        folder and in the project.

    Options
    -------
    out : FILE
        File to write: the report (.html).
    rig : [NAME=]FILE
        Rig (.toml). {named_rigs}. Default: the rig in each session, or the one that the result was made from.

    Expert options
    --------------
    line_points : N
        Points of each pass, as given to truearm identify.
    """
    from truearm.workflows.identify import IdentifyFiles
    from truearm.workflows.report import report_files

    sources = sources_of(inputs, rig, allow_damaged=True, line_points=line_points)
    files = IdentifyFiles(robot, sources, command=command_line(context), force=force)
    with before_error(sources.said):
        certificate = report_files(result, files, out, issue_of(number, tolerance_mm))
    decision = certificate.findings[0].text(option)
    lines = [f"{certificate.heading}: {decision}", f"Written: {one_line(str(out))}"]
    return Answer({"report": str(out), "decision": decision, "findings": entries(certificate.findings)}, lines)
