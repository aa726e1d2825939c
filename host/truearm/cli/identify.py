"""Identify: parameters with their uncertainty from observations, and what they are worth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated

import click

from truearm.bounds import LINE_POINTS, Within
from truearm.cli.command import Answer, command
from truearm.cli.options import command_line, issue_of, joints_of, sources_of
from truearm.cli.project import typed
from truearm.errors import Argument, ExitCode, InputError
from truearm.estimate.solvers import SOLVERS, with_loss
from truearm.findings import Finding, entries, option
from truearm.model.robot_file import NO_ROBOT, RobotChoice
from truearm.text import one_line
from truearm.units import tolerances
from truearm.workflows.requests import FitOptions, FleetOptions, MapFiles, Section


def _located(finding: Finding, paths: Mapping[str, str]) -> Finding:
    """Return a finding with the path of a session, by its name in the result, as the user gave it."""
    names = finding.values.get("path")
    located = {"path": [paths.get(name, name) for name in names]} if names else {}
    return replace(finding, values={**finding.values, **located})


@command(
    weak=" and ".join(tolerances("weak")[:2]),
    wide=" and ".join(tolerances("wide")[:2]),
    lossy=" and ".join(with_loss()),
    solvers=". ".join(f"{name}: {entry.summary}" for name, entry in SOLVERS.items()),
)
def identify(
    context: click.Context,
    inputs: tuple[Path, ...],
    *,
    robot: RobotChoice,
    rig: tuple[str, ...] = (),
    noise: Path | None = None,
    hold_out: tuple[str, ...] = (),
    options: FitOptions,
    out: Path | None = None,
    force: bool = False,
    table_out: Path | None = None,
    report: Path | None = None,
    line_points: Annotated[int | None, LINE_POINTS] = None,
    allow_damaged: bool = False,
) -> Answer:
    """Identify a robot's parameters from observations.

    Prints whether the result is usable, the error of the tool, what to look at, and what to do next; with --details
    also every parameter, combination and residual. A fit that is not usable is written too, marked as such, and the
    exit code is 3.

    Example:
      truearm identify poses.csv --model puma560 --rig rig.toml --hold-out shell=s61

    Options
    -------
    rig : [NAME=]FILE
        Rig (.toml). {named_rigs}. Default: the rig in each session.
    noise : FILE
        Noise file of truearm characterize (.toml). It replaces the rig's sigmas of joint readings and bars.
    hold_out : GROUP|FRACTION
        Rows to hold out: judged, not fitted. COLUMN=VALUE or LOW:HIGH, such as place=front or q1_deg=-180:0
        (repeatable), or a fraction of the poses such as 0.2, drawn with --seed. place=* or folds=5: each place, or each
        of five shares of the poses, is held out of a fit of its own in turn.
    out : FILE
        File to write: the result (.json). In a project, the result is kept in the folder results as well.
    report : FILE
        Write a report on the result (.html).
    details
        Print everything: parameters, combinations, residuals, all notes.

    Expert options
    --------------
    table_out : FILE
        Write all observations as one table (.csv).
    """
    from truearm.report.result_tables import result_tables
    from truearm.workflows.identify import IdentifyFiles, IdentifyOptions, identify_files
    from truearm.workflows.selection import is_drawn

    if typed(context, "seed") is not None and not any(map(is_drawn, hold_out)):
        raise InputError("needs-option", place="--seed", needed="a fraction to hold out, such as --hold-out 0.2")
    sources = sources_of(inputs, rig, noise=noise, allow_damaged=allow_damaged, line_points=line_points)
    results = [] if out is None else [out]
    default = context.lookup_default("out")  # in the project
    if out and default and typed(context, "out") and Path(default).resolve().parent != out.resolve().parent:
        results.append(Path(default))
    files = IdentifyFiles(robot, sources, tuple(results), table_out, report, command_line(context), force)
    identification = identify_files(files, hold_out, IdentifyOptions(**vars(options)))
    document, paths = identification.document, {path.name: str(path) for path in inputs}
    return Answer(
        document,
        findings=[_located(finding, paths) for finding in identification.findings],
        tables=result_tables(document),
        written=(*results, table_out, report),
        details_hint="Parameters, residuals and all notes: --details, or --report report.html",
        end=ExitCode.DONE if document["usable"] else ExitCode.UNUSABLE,
    )


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

    The fit is repeated from the files of the result, with the same options. If the files differ, or the outcome does,
    no report is written. The certificate takes name, serial number, controller, customer and operator from
    truearm.toml.

    Example:
      truearm report result.json session.mcap --number 2026-7 --out report.html

    Arguments
    ---------
    inputs : INPUT...
        Sessions (.mcap) and tables (.csv) that the result was made from. Default: those in the folder of the result, in
        this folder and in the project.

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
    certificate = report_files(result, files, out, issue_of(number, tolerance_mm))
    decision = certificate.findings[0].text(option)
    lines = [f"{certificate.heading}: {decision}", f"Written: {one_line(str(out))}"]
    return Answer({"report": str(out), "decision": decision, "findings": entries(certificate.findings)}, lines)


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

    The robot's parameters stay as identified. The unknowns of the rig are estimated from the new rows, with and without
    the calibration alike, or held with --keep-rig. For the errors without the calibration, the poses of base and tool
    are estimated from these rows too if the rows determine them; the output says so.

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
        detail = Argument("number" if number else "tolerance_mm")
        raise InputError("needs-option", place=detail, needed=Argument("report"))
    files = IdentifyFiles(robot, sources, report=report, command=command_line(context), force=force)
    document = validate_files(result, files, issue_of(number, tolerance_mm), keep_rig).document
    return Answer(document, tables=error_tables(document), written=[report], details_hint="Errors by region: --details")


@command(title="map")
def map_(files: MapFiles, *, section: Section) -> Answer:
    """Map the error of the uncalibrated robot over a section of its workspace, with the uncertainty of the map.

    Example:
      truearm map result.json --picture-out map.svg --task 300x200 --within 300:900,0:800

    Options
    -------
    out : FILE
        File to write: the cells as a table (.csv).
    picture_out : FILE
        Write the map as a picture (.svg).
    report : FILE
        Write a report (.html): the errors, the picture, and the arm with the cells in 3-D.
    vary : I,J
        The two joints that span the section; their axes must be parallel. Default: 2,3.
    at : Q1,Q2,...
        Values of all joints [deg, mm]; of those of --vary, only the configuration of the elbow matters. Default: the
        middle of the measured readings, and the map ends where these end.
    cell_mm : MM
        Size of a cell.
    task : WxH
        Find the best place for a task of this size [mm].

    Expert options
    --------------
    within : U0:U1,V0:V1
        Range of the search for --task, along the section's axes [mm]. Default: the whole section.
    """
    from truearm.workflows.calibration import read_usable
    from truearm.workflows.map import map_files

    if section.task is None and section.within is not None:
        raise InputError("needs-option", place="--within", needed="--task WxH")
    calibration = read_usable(files)
    return Answer(map_files(calibration, files, replace(section, at=joints_of(section.at, calibration.chain))))


@command()
def fleet(folders: tuple[Path, ...], *, options: FleetOptions) -> Answer:
    """Identify the robots of all projects in some folders, several at a time.

    Each project is identified as by truearm identify in its folder, and its result is written into its folder results.
    A project that has a result of the same files and options is not identified again. The exit code is that of
    the worst arm.

    Example:
      truearm fleet cells --hold-out 0.2 --out fleet.csv

    Arguments
    ---------
    folders : FOLDER...
        Folders of projects (truearm init), or folders that contain them.

    Options
    -------
    hold_out : GROUP|FRACTION
        Rows of each arm to hold out, as for truearm identify (repeatable).
    reports
        Write a report beside each result (.html), with a certificate.
    workers : N
        Number of arms at a time. Default: one per core.
    dask : ADDRESS|local
        Use the workers of a Dask scheduler, such as tcp://10.0.0.5:8786; they need the same folders. local: start them
        on this machine.
    out : FILE
        File to write: the table of all arms (.csv). It replaces an earlier table of arms.
    """
    from truearm.workflows.fleet import identify_fleet, worst

    rows = identify_fleet(folders, options)
    width = max(len(one_line(row.arm)) for row in rows)
    lines = [f"{'arm':<{width}}    nominal  identified"]
    for row in rows:
        errors = [f"{mm:.3f} mm" if mm is not None else "" for mm in (row.before_mm, row.after_mm)]
        remark = one_line(row.verdict) * (row.code != ExitCode.DONE)
        lines.append(f"{one_line(row.arm):<{width}}  {errors[0]:>9}  {errors[1]:>9}  {remark}".rstrip())
    if options.out is not None:
        lines.append(f"Written: {one_line(str(options.out))}")
    document = {"format": "truearm-fleet", "arms": [asdict(row) for row in rows]}
    return Answer(document, lines, end=worst(rows))
