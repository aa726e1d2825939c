"""``truearm identify``: observations in, parameters with their uncertainty out."""

from __future__ import annotations

import shlex
import sys
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from truearm.cli.options import ROBOT_HELP
from truearm.errors import InputError


class Prior(StrEnum):
    """What is believed of the robot before it is measured."""

    none = "none"
    weak = "weak"
    wide = "wide"


class Solver(StrEnum):
    """Names of ``estimate.identify.SOLVERS``, which --help must not import."""

    lm = "lm"
    map = "map"
    recursive = "recursive"
    renders_1991 = "renders-1991"
    ls = "ls"


class Loss(StrEnum):
    """Names of ``estimate.robust.LOSSES``."""

    linear = "linear"
    huber = "huber"
    cauchy = "cauchy"


@dataclass(frozen=True)
class _Request:
    """The command line, checked by typer."""

    inputs: list[Path]
    robot: str
    base: str | None
    tip: str | None
    noise: Path | None
    rigs: dict[str, Path]  # by the name that rows have in their column rig, "" for the one of all rows
    hold_out: list[str]
    seed: int
    free: list[str]
    also_free: list[str]
    freeze: list[str]
    prior: Prior | None
    solver: Solver
    loss: Loss
    max_iterations: int
    save_table: Path | None
    report: Path | None
    command: str
    allow_damaged: bool
    line_points: int | None


def identify(
    context: typer.Context,
    inputs: Annotated[
        list[Path], typer.Argument(metavar="INPUT", help="Sessions (.mcap) and tables (.csv); all are read as one.")
    ],
    robot: Annotated[
        str,
        typer.Option(
            metavar="ROBOT",
            help=ROBOT_HELP,
        ),
    ],
    base: Annotated[
        str | None, typer.Option(metavar="LINK", help="Link of the URDF where the chain begins; default: its root.")
    ] = None,
    tip: Annotated[
        str | None, typer.Option(metavar="LINK", help="Link of the URDF where the chain ends; default: its only leaf.")
    ] = None,
    rig: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[NAME=]FILE",
            help="Chucks, spheres, bars, sockets, devices (.toml). With a name: for the rows that have it in their "
            "column rig, and for the session of that name, a.mcap's being a (repeatable). Default: each session's own.",
        ),
    ] = None,
    noise: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="What truearm characterize found of joint readings and bars (.toml), in place of the rig's figures.",
        ),
    ] = None,
    hold_out: Annotated[
        list[str] | None,
        typer.Option(
            metavar="GROUP|FRACTION",
            help="Rows to judge by and not to fit: bar=bar61, shell=s1, place=front, line=left, likewise chuck, sphere, socket, "
            "target, tracker, plane or rig (repeatable), or a fraction such as 0.2.",
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, metavar="N", help="Draws the rows of a held-out fraction.")] = 0,
    free: Annotated[
        list[str] | None,
        typer.Option(metavar="PATTERN", help="Identify only parameters that match, as 'joint*.offset' (repeatable)."),
    ] = None,
    also_free: Annotated[
        list[str] | None,
        typer.Option(
            metavar="PATTERN",
            help="Identify these too, beside what the robot file frees: '*.gain,link3.y' (repeatable).",
        ),
    ] = None,
    freeze: Annotated[
        list[str] | None, typer.Option(metavar="PATTERN", help="Hold parameters that match (repeatable).")
    ] = None,
    all_free: Annotated[
        bool, typer.Option("--all-free", help="Identify also what the robot file holds fixed; like --free '*'.")
    ] = False,
    prior: Annotated[
        Prior | None,
        typer.Option(
            help="Nominal to 1 mm, 5 mrad (weak) or 10 mm, 52 mrad (wide). Default: weak for a URDF, else wide for "
            "--solver map, none for the others; ls has none."
        ),
    ] = None,
    solver: Annotated[
        Solver,
        typer.Option(
            help="lm: Levenberg-Marquardt. map: maximum a posteriori. recursive: row by row, leaves faulty rows out. "
            "ls, renders-1991: to compare with."
        ),
    ] = Solver.lm,
    loss: Annotated[
        Loss, typer.Option(help="huber and cauchy bear faulty rows; with the solvers lm and map.")
    ] = Loss.linear,
    max_iterations: Annotated[
        int, typer.Option(min=1, max=10_000, metavar="N", help="Stop there, converged or not.")
    ] = 50,
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="Write the result here (JSON).")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON and nothing else.")] = False,
    save_table: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write all observations as one table (CSV).")
    ] = None,
    report: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write a page about the result, with pictures (HTML).")
    ] = None,
    line_points: Annotated[
        int | None,
        typer.Option(
            min=5,
            metavar="N",
            help="Points of each pass along a line at most. Default: as many as the noise tells apart.",
        ),
    ] = None,
    allow_damaged: Annotated[
        bool,
        typer.Option(
            "--allow-damaged",
            "--allow-truncated",
            help="Use what is whole of a session that is damaged, or whose recorder was killed.",
        ),
    ] = False,
) -> None:
    """Identify a robot's parameters from observations.

    Prints nominal, value and standard deviation of every parameter, what the observations cannot see, and the errors
    before and after, on the rows held out too.

    \b
    Example:
      truearm identify poses.csv --robot puma560 --rig rig.toml --hold-out shell=s61
    """
    from truearm.files.result_file import format_document, write_result
    from truearm.workflows.inputs import check_files
    from truearm.workflows.session_parts import with_parts
    from truearm.workflows.session_rigs import rig_files

    _check_solver(solver, loss, prior)
    rigs = rig_files(rig or [])
    inputs = with_parts(inputs)
    check_files([*inputs, *([noise] if noise else [])], robot, rigs, out, save_table, report)
    request = _Request(
        inputs=inputs,
        robot=robot,
        base=base,
        tip=tip,
        noise=noise,
        rigs=rigs,
        hold_out=hold_out or [],
        seed=seed,
        free=["*"] if all_free else free or [],
        also_free=also_free or [],
        freeze=freeze or [],
        prior=prior,
        solver=solver,
        loss=loss,
        max_iterations=max_iterations,
        save_table=save_table,
        report=report,
        command=shlex.join(["truearm", *(context.obj or [])]),
        allow_damaged=allow_damaged,
        line_points=line_points,
    )
    document = _identified(request)
    if out is not None:
        write_result(out, document)
    if as_json:
        sys.stdout.write(format_document(document) + "\n")
    else:
        from truearm.cli.identify_text import show_result

        show_result(document, out)


def _check_solver(solver: Solver, loss: Loss, prior: Prior | None) -> None:
    """Raise InputError for what a solver would silently ignore."""
    if loss is not Loss.linear and solver not in (Solver.lm, Solver.map):
        raise InputError(f"--loss {loss} goes with the solvers lm and map; {solver} has no robust loss")
    if prior in (Prior.weak, Prior.wide) and solver is Solver.ls:
        raise InputError(f"--prior {prior} is nothing to --solver ls, which knows no prior; use map")


def _prior(request: _Request, is_urdf: bool) -> Prior:
    """What was asked for; else what the solver or the robot needs."""
    if request.prior is not None or request.solver is Solver.ls:
        return request.prior or Prior.none
    if is_urdf:
        return Prior.weak
    return Prior.wide if request.solver is Solver.map else Prior.none


def _identified(request: _Request) -> dict[str, Any]:
    """Read everything, identify, and return the content of result.json."""
    from truearm.estimate.identify import identify as estimate_parameters
    from truearm.estimate.prior import free_without_gains, weak_prior, wide_prior
    from truearm.files.noise_file import read_noise
    from truearm.files.observation_table import write_table
    from truearm.files.result_file import RobotFrames, document_of
    from truearm.files.robot_file import is_urdf, joint_units, load_robot
    from truearm.workflows.calibration_report import judge, write_page
    from truearm.workflows.inputs import hashed_inputs, observed
    from truearm.workflows.selection import free_parameters, held_out_rows

    robot = load_robot(request.robot, request.base, request.tip)
    chain, units = robot.chain, joint_units(robot.chain)
    noise = None if request.noise is None else read_noise(request.noise)
    rig, table = observed(request.inputs, request.rigs, units, request.allow_damaged, noise, request.line_points)
    held_out = held_out_rows(table, request.hold_out, request.seed)
    # A URDF says nothing of what to hold; its constants are redundant, which the weak prior settles.
    by_default = free_without_gains(chain) if is_urdf(request.robot) else robot.free
    prior = _prior(request, is_urdf(request.robot))
    free = free_parameters(chain.parameter_names, by_default, request.free, request.freeze, request.also_free)
    if request.save_table is not None:
        write_table(request.save_table, table, units)

    estimate = estimate_parameters(
        chain,
        rig,
        table,
        free=free,
        hold_out=held_out,
        prior_sigma=None if prior is Prior.none else {Prior.weak: weak_prior, Prior.wide: wide_prior}[prior](chain),
        solver=request.solver,
        loss=request.loss,
        prefer=by_default,
        max_iterations=request.max_iterations,
    )
    judged = judge(chain, rig, table, estimate)
    if request.report is not None:
        write_page(request.report, chain, rig, table, estimate, judged, prior.value, request.command)
    frames = RobotFrames(chain.name, chain.base_frame, chain.end_frame, units)
    files = hashed_inputs(request.inputs, request.robot, *request.rigs.values(), noise=request.noise)
    return document_of(estimate, table, frames, files, request.hold_out, prior.value, *judged)
