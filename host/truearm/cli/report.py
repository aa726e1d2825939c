"""``truearm report``: write the report on a result, with its certificate."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer

from truearm.bounds import LINE_POINTS
from truearm.cli.options import (
    AllowDamagedOption,
    ControllerOption,
    CustomerOption,
    ForceOption,
    IdentifiedBaseOption,
    IdentifiedRobotOption,
    IdentifiedTipOption,
    InputsArgument,
    JsonOption,
    NamedRigsOption,
    NameOption,
    NumberOption,
    OperatorOption,
    ResultArgument,
    SerialOption,
    ToleranceOption,
    bounded,
    issue_of,
    out_file,
    rigs_of,
)
from truearm.cli.output import print_result, warn
from truearm.text import one_line


def report(
    context: typer.Context,
    result: ResultArgument,
    inputs: InputsArgument,
    out: Annotated[Path, out_file("the report (.html)")],
    robot: IdentifiedRobotOption = None,
    base: IdentifiedBaseOption = None,
    tip: IdentifiedTipOption = None,
    rig: NamedRigsOption = None,
    noise: Annotated[
        Path | None, typer.Option(metavar="FILE", help="The noise file that was given to truearm identify.")
    ] = None,
    serial: SerialOption = None,
    operator: OperatorOption = None,
    name: NameOption = None,
    controller: ControllerOption = None,
    customer: CustomerOption = None,
    number: NumberOption = "",
    tolerance: ToleranceOption = None,
    line_points: Annotated[
        int | None,
        typer.Option(metavar="N", help="Points of each pass, as given to truearm identify.", **bounded(LINE_POINTS)),
    ] = None,
    allow_damaged: AllowDamagedOption = False,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Write the report on a result, with a certificate as its first page.

    The fit is repeated from the files of the result, with the same options. If the files differ, or the outcome does, no report is written.

    \b
    Example:
      truearm report result.json session.mcap --serial 2019-7 --operator "A. Smith" --out report.html
    """
    from truearm.files.robot_file import RobotChoice
    from truearm.workflows.identify import IdentifyFiles
    from truearm.workflows.inputs import Sources
    from truearm.workflows.report import ReportFiles, report_files

    issue = issue_of(
        number, tolerance, serial=serial, operator=operator, name=name, controller=controller, customer=customer
    )
    sources = Sources(tuple(inputs), rigs_of(rig), noise, allow_damaged, line_points, warn)
    command = shlex.join(["truearm", *(context.obj or [])])
    report_files(
        ReportFiles(
            result, IdentifyFiles(RobotChoice(robot, base, tip), sources, command=command, force=force), out, issue
        )
    )
    print_result({"report": str(out)}, [f"Written: {one_line(str(out))}"], as_json)
