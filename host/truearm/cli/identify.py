"""``truearm identify``: observations in, parameters with their uncertainty out."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer

from truearm import option_defaults
from truearm.bounds import ITERATIONS, LINE_POINTS
from truearm.cli.options import (
    AllowDamagedOption,
    BaseOption,
    ForceOption,
    InputsArgument,
    JsonOption,
    NamedRigsOption,
    RobotOption,
    SeedOption,
    TipOption,
    bounded,
    choices,
    completed,
    one_of,
    out_file,
    rigs_of,
)
from truearm.cli.output import warn
from truearm.cli.project import typed
from truearm.errors import InputError
from truearm.estimate.solvers import SOLVERS, LawMode, Loss, Prior, with_loss
from truearm.exit_codes import ExitCode
from truearm.units import tolerances

DEFAULT_JOINT_LAWS = LawMode(option_defaults.JOINT_LAWS)


def identify(
    context: typer.Context,
    inputs: InputsArgument,
    robot: RobotOption,
    base: BaseOption = None,
    tip: TipOption = None,
    rig: NamedRigsOption = None,
    noise: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Noise file of truearm characterize (.toml). It replaces the rig's sigmas of joint readings and bars.",
        ),
    ] = None,
    hold_out: Annotated[
        list[str] | None,
        typer.Option(
            metavar="GROUP|FRACTION",
            help="Rows to hold out: judged, not fitted. COLUMN=NAME, such as bar=bar61, shell=s46_c1 or place=front (repeatable), "
            "or a fraction such as 0.2, drawn with --seed.",
        ),
    ] = None,
    fit_only: Annotated[
        list[str] | None,
        typer.Option(
            metavar="GROUP", help="Fit only these rows, such as place=front (repeatable). All others are held out."
        ),
    ] = None,
    seed: SeedOption = option_defaults.SEED,
    free: Annotated[
        list[str] | None,
        typer.Option(
            metavar="PATTERN", help="Identify only parameters that match, such as 'joint*.offset' (repeatable)."
        ),
    ] = None,
    also_free: Annotated[
        list[str] | None,
        typer.Option(
            metavar="PATTERN",
            help="Identify these too, in addition to those that the robot file frees: '*.gain,link3.y' (repeatable).",
        ),
    ] = None,
    freeze: Annotated[
        list[str] | None,
        typer.Option(metavar="PATTERN", help="Hold parameters that match at their nominal values (repeatable)."),
    ] = None,
    all_free: Annotated[
        bool,
        typer.Option("--all-free", help="Identify also the parameters that the robot file fixes; like --free '*'."),
    ] = False,
    prior: Annotated[
        Prior | None,
        typer.Option(
            help=f"Prior about the nominal values. weak: sigma of {' and '.join(tolerances('weak')[:2])}. wide: {' and '.join(tolerances('wide')[:2])}. "
            "where-needed: like weak, but for weakly identifiable parameters only. Default for a URDF: weak. Default for "
            "other robots: where-needed; wide with --solver map, none with renders-1991. The solver ls uses no prior."
        ),
    ] = None,
    solver: Annotated[
        str,
        typer.Option(
            metavar=choices(SOLVERS),
            callback=one_of(SOLVERS),
            autocompletion=completed(SOLVERS),
            help=". ".join(f"{name}: {entry.summary}" for name, entry in SOLVERS.items()) + ".",
        ),
    ] = option_defaults.SOLVER,
    loss: Annotated[
        str,
        typer.Option(
            metavar=choices(tuple(Loss)),
            callback=one_of(tuple(Loss)),
            autocompletion=completed(tuple(Loss)),
            help=f"huber and cauchy tolerate outliers; for the solvers {' and '.join(with_loss())}.",
        ),
    ] = option_defaults.LOSS,
    joint_laws: Annotated[
        LawMode,
        typer.Option(
            help="Joint laws to fit: curve (error curves), sag, or auto (both, if geometry and declared noise do not explain the residuals). A law is kept only if the rows give evidence for it. none: geometry alone."
        ),
    ] = DEFAULT_JOINT_LAWS,
    allow: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME[@FIRST[:LAST]]",
            help="Estimate a systematic error too: bar.bar46.zero, chuck.c2@183 (from row 183 on, counted from 1 over all inputs), joint2@91:270, "
            "bar.bar46.zero.drift or .thermal_drift, joint1.backlash or .settling (repeatable). The check after a fit names what to allow.",
        ),
    ] = None,
    leave_out: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ROWS",
            help="Rows to leave out completely: 120:140, counted from 1 over all inputs, or a row as messages name it, "
            "such as 'poses.csv row 100' (repeatable).",
        ),
    ] = None,
    max_iterations: Annotated[
        int, typer.Option(metavar="N", help="Stop after N iterations, converged or not.", **bounded(ITERATIONS))
    ] = option_defaults.MAX_ITERATIONS,
    out: Annotated[Path | None, out_file("the result (.json)")] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
    save_table: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write all observations as one table (.csv).")
    ] = None,
    report: Annotated[Path | None, typer.Option(metavar="FILE", help="Write a report on the result (.html).")] = None,
    line_points: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="Largest number of points of each pass along a line. Default: as many as the noise allows.",
            **bounded(LINE_POINTS),
        ),
    ] = None,
    allow_damaged: AllowDamagedOption = False,
) -> None:
    """Identify a robot's parameters from observations.

    Prints the nominal value, the estimate and the standard deviation of every parameter, the combinations that are
    unidentifiable, and the errors before and after, also on held-out rows. A fit that is not usable is written too, marked
    as such, and the exit code is 3.

    \b
    Example:
      truearm identify poses.csv --model puma560 --rig rig.toml --hold-out shell=s61
    """
    from truearm.cli.identify_text import ResultFiles, show_result
    from truearm.files.result_file import format_document
    from truearm.files.robot_file import RobotChoice
    from truearm.workflows.identify import IdentifyFiles, IdentifyOptions, identify_files
    from truearm.workflows.inputs import Sources
    from truearm.workflows.selection import held_out_fraction

    if typed(context, "seed") is not None and all(held_out_fraction(text) is None for text in hold_out or ()):
        raise InputError("--seed draws a fraction to hold out, such as --hold-out 0.2; without one, leave it out")
    sources = Sources(tuple(inputs), rigs_of(rig), noise, allow_damaged, line_points, warn)
    command = shlex.join(["truearm", *(context.obj or [])])
    files = IdentifyFiles(RobotChoice(robot, base, tip), sources, out, save_table, report, command, force)
    options = IdentifyOptions(
        free=("*",) if all_free else tuple(free or ()),
        also_free=tuple(also_free or ()),
        freeze=tuple(freeze or ()),
        prior=None if prior is None else prior.value,
        solver=solver,
        loss=loss,
        joint_laws=joint_laws.value,
        max_iterations=max_iterations,
        seed=seed,
        allow=tuple(allow or ()),
        leave_out=tuple(leave_out or ()),
        fit_only=tuple(fit_only or ()),
    )
    document = identify_files(files, hold_out or [], options).document
    if as_json:
        typer.echo(format_document(document))
    else:
        others = [path for path in (save_table, report) if path is not None]
        show_result(document, ResultFiles(inputs, out, others))
    if not document["usable"]:
        raise typer.Exit(ExitCode.UNUSABLE)
