"""``truearm identify``: observations in, parameters with their uncertainty out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import click

from truearm.bounds import LINE_POINTS
from truearm.cli.command import Answer, command
from truearm.cli.options import command_line, sources_of
from truearm.cli.output import before_error
from truearm.cli.project import typed
from truearm.errors import InputError
from truearm.estimate.solvers import SOLVERS, with_loss
from truearm.exit_codes import ExitCode
from truearm.findings import Finding
from truearm.model.robot_file import RobotChoice
from truearm.units import tolerances
from truearm.workflows.requests import FitOptions


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

    Prints whether the result is usable, the error of the tool, what to look at, and what to do next; with --details also
    every parameter, combination and residual. A fit that is not usable is written too, marked as such, and the exit code is
    3.

    Example:
      truearm identify poses.csv --model puma560 --rig rig.toml --hold-out shell=s61

    Options
    -------
    rig : [NAME=]FILE
        Rig (.toml). {named_rigs}. Default: the rig in each session.
    noise : FILE
        Noise file of truearm characterize (.toml). It replaces the rig's sigmas of joint readings and bars.
    hold_out : GROUP|FRACTION
        Rows to hold out: judged, not fitted. COLUMN=VALUE or LOW:HIGH, such as place=front or q1_deg=-180:0 (repeatable),
        or a fraction of the poses such as 0.2, drawn with --seed. place=* or folds=5: each place, or each of five shares
        of the poses, is held out of a fit of its own in turn.
    apply : mean|NAME[@FIRST[:LAST]]
        Put a fault into the result that the output names: mean, the mean of its possible causes, or one of them, such as
        bar.bar46.zero, chuck.c2@183 (from row 183 on, counted from 1 over all inputs), joint2@91:270,
        bar.bar46.zero.drift or .thermal_drift, joint1.backlash or .settling (repeatable).
    leave_out : ROWS
        Rows to leave out completely: 120:140, counted from 1 over all inputs, or a row as messages name it, such as
        'poses.csv row 100' (repeatable).
    out : FILE
        File to write: the result (.json). In a project, the result is kept in the folder results as well.
    report : FILE
        Write a report on the result (.html).
    details
        Print everything: parameters, combinations, residuals, all notes.

    Expert options
    --------------
    fit_only : GROUP
        Fit only these rows, such as place=front (repeatable). All others are held out.
    free : PATTERN
        Identify only parameters that match, such as 'joint*.offset' (repeatable); '*': also those that the robot file
        fixes.
    also_free : PATTERN
        Identify these too, in addition to those that the robot file frees: '*.gain,link3.y' (repeatable).
    freeze : PATTERN
        Hold parameters that match at their nominal values (repeatable).
    prior
        Prior about the nominal values. weak: sigma of {weak}. wide: {wide}. where-needed: like
        weak, but for weakly identifiable parameters only. Default for a URDF: weak. Default for other robots:
        where-needed; wide with --solver map, none with renders-1991. The solver ls uses no prior.
    solver
        {solvers}.
    loss
        huber and cauchy tolerate outliers; for the solvers {lossy}.
    joint_laws
        Joint laws to fit: curve (error curves), sag, or auto (both, if geometry and declared noise do not explain the
        residuals). A law is kept only if the rows give evidence for it. none: geometry alone.
    max_iterations : N
        Stop after N iterations, converged or not.
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
    with before_error(sources.said):
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
