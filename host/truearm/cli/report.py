"""``truearm report``: write the report on a result, with its certificate."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer

from truearm.bounds import LINE_POINTS, Within
from truearm.cli.command import command
from truearm.cli.options import issue_of, rigs_of
from truearm.cli.output import print_result, warn
from truearm.text import one_line


@command()
def report(
    context: typer.Context,
    result: Path,
    inputs: list[Path] | None = None,
    *,
    out: Path,
    model: str | None = None,
    base: str | None = None,
    tip: str | None = None,
    rig: list[str] | None = None,
    noise: Path | None = None,
    serial: str | None = None,
    operator: str | None = None,
    name: str | None = None,
    controller: str | None = None,
    customer: str | None = None,
    number: str = "",
    tolerance_mm: Annotated[float | None, Within(1e-3, 100.0)] = None,
    line_points: Annotated[int | None, LINE_POINTS] = None,
    allow_damaged: bool = False,
    force: bool = False,
    json: bool = False,
) -> None:
    """Write the report on a result, with a certificate as its first page.

    The fit is repeated from the files of the result, with the same options. If the files differ, or the outcome does, no report is written.

    Example:
      truearm report result.json session.mcap --serial 2019-7 --operator "A. Smith" --out report.html

    Arguments
    ---------
    inputs : INPUT...
        Sessions (.mcap) and tables (.csv) that the result was made from. Default: those in the folder of the result, in this
        folder and in the project.

    Options
    -------
    out : FILE
        File to write: the report (.html).
    noise : FILE
        The noise file that was given to truearm identify.
    rig : [NAME=]FILE
        Rig (.toml). {named_rigs}. Default: the rig in each session.

    Expert options
    --------------
    line_points : N
        Points of each pass, as given to truearm identify.
    """
    from truearm.files.robot_file import RobotChoice
    from truearm.workflows.identify import IdentifyFiles
    from truearm.workflows.inputs import Sources
    from truearm.workflows.report import ReportFiles, report_files

    sources = Sources(tuple(inputs or ()), rigs_of(rig), noise, allow_damaged, line_points, warn)
    command_line = shlex.join(["truearm", *(context.obj or [])])
    files = IdentifyFiles(RobotChoice(model, base, tip), sources, command=command_line, force=force)
    report_files(ReportFiles(result, files, out, issue_of(locals())))
    print_result({"report": str(out)}, [f"Written: {one_line(str(out))}"], json)
