"""``truearm identify``: observations in, parameters with their uncertainty out."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from truearm.commands.choice import Mask
    from truearm.files.result import Input
    from truearm.types import Estimate, ObservationTable


class Prior(StrEnum):
    """What is believed of the robot before it is measured."""

    none = "none"
    weak = "weak"


@dataclass(frozen=True)
class _Request:
    """The command line, checked by typer."""

    inputs: list[Path]
    robot: str
    base: str | None
    tip: str | None
    rig: Path | None
    hold_out: list[str]
    seed: int
    free: list[str]
    freeze: list[str]
    prior: Prior | None
    max_iterations: int
    save_table: Path | None


def identify(
    inputs: Annotated[
        list[Path], typer.Argument(metavar="INPUT", help="Tables of observations (.csv); several are read as one.")
    ],
    robot: Annotated[
        str, typer.Option(metavar="ROBOT", help="Built-in robot (puma560), robot file (.toml) or URDF (.urdf).")
    ],
    base: Annotated[
        str | None, typer.Option(metavar="LINK", help="Link of the URDF where the chain begins; default: its root.")
    ] = None,
    tip: Annotated[
        str | None, typer.Option(metavar="LINK", help="Link of the URDF where the chain ends; default: its only leaf.")
    ] = None,
    rig: Annotated[Path | None, typer.Option(metavar="FILE", help="Chucks, spheres, bars, sockets (.toml).")] = None,
    hold_out: Annotated[
        list[str] | None,
        typer.Option(
            metavar="GROUP|FRACTION",
            help="Rows to judge by and not to fit: shell=s61 or place=front (repeatable), or a fraction such as 0.2.",
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, metavar="N", help="Draws the rows of a held-out fraction.")] = 0,
    free: Annotated[
        list[str] | None,
        typer.Option(metavar="PATTERN", help="Identify only parameters that match, as 'joint*.offset' (repeatable)."),
    ] = None,
    freeze: Annotated[
        list[str] | None, typer.Option(metavar="PATTERN", help="Hold parameters that match (repeatable).")
    ] = None,
    all_free: Annotated[
        bool, typer.Option("--all-free", help="Identify also what the robot file holds fixed; like --free '*'.")
    ] = False,
    prior: Annotated[
        Prior | None,
        typer.Option(help="weak: nominal to 1 mm, 5 mrad. Default: weak for a URDF, none for other robots."),
    ] = None,
    max_iterations: Annotated[
        int, typer.Option(min=1, max=10_000, metavar="N", help="Stop there, converged or not.")
    ] = 50,
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="Write the result here (JSON).")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON and nothing else.")] = False,
    save_table: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write all observations as one table (CSV).")
    ] = None,
) -> None:
    """Identify a robot's parameters from observations.

    Prints nominal, value and standard deviation of every parameter, what the observations cannot see, and the errors
    before and after, on the rows held out too.

    \b
    Example:
      truearm identify poses.csv --robot puma560 --rig rig.toml --hold-out shell=s61
    """
    from truearm.files.disk import check_writable
    from truearm.files.result import format_document, write_result

    for path in (out, save_table):
        if path is not None:
            check_writable(path)
    request = _Request(
        inputs=inputs,
        robot=robot,
        base=base,
        tip=tip,
        rig=rig,
        hold_out=hold_out or [],
        seed=seed,
        free=["*"] if all_free else free or [],
        freeze=freeze or [],
        prior=prior,
        max_iterations=max_iterations,
        save_table=save_table,
    )
    document = _identified(request)
    if out is not None:
        write_result(out, document)
    if as_json:
        sys.stdout.write(format_document(document) + "\n")
    else:
        from truearm.commands.show import show_result

        show_result(document, out)


def _identified(request: _Request) -> dict[str, Any]:
    """Read everything, identify, and return the content of result.json."""
    from truearm.commands.choice import free_parameters, held_out_rows
    from truearm.estimate.identify import identify as estimate_parameters
    from truearm.estimate.prior import free_without_gains, weak_prior
    from truearm.files.result import RobotFrames, document_of
    from truearm.files.rig import read_rig
    from truearm.files.robot import is_urdf, joint_units, load_robot
    from truearm.files.table import check_against_rig, write_table
    from truearm.types import Rig

    robot = load_robot(request.robot, request.base, request.tip)
    chain, units = robot.chain, joint_units(robot.chain)
    rig = read_rig(request.rig) if request.rig else Rig()
    table = read_inputs(request.inputs, units)
    check_against_rig(table, rig)
    held_out = held_out_rows(table, request.hold_out, request.seed)
    # A URDF says nothing of what to hold; its constants are redundant, which the weak prior settles.
    by_default = free_without_gains(chain) if is_urdf(request.robot) else robot.free
    prior = request.prior or (Prior.weak if is_urdf(request.robot) else Prior.none)
    free = free_parameters(chain.parameter_names, by_default, request.free, request.freeze)
    if request.save_table is not None:
        write_table(request.save_table, table, units)

    def fit(mask: Mask) -> Estimate:
        return estimate_parameters(
            chain,
            rig,
            table,
            free=mask,
            hold_out=held_out,
            prior_sigma=weak_prior(chain) if prior is Prior.weak else None,
            max_iterations=request.max_iterations,
        )

    estimate = _with_fair_before(fit(free), fit)
    frames = RobotFrames(chain.name, chain.base_frame, chain.end_frame, units)
    files = hashed_inputs(request.inputs, request.robot, request.rig)
    return document_of(estimate, table, frames, files, request.hold_out, prior.value)


def _with_fair_before(estimate: Estimate, fit: Callable[[Mask], Estimate]) -> Estimate:
    """The estimate with, as "before", what the nominal robot reaches once the rig's unknowns are fitted to it.

    A ball or a chuck whose place nobody measured is no error of the robot; with the rig as guessed the identification
    would be credited with finding it.
    """
    import numpy as np

    n_robot = estimate.n_robot_parameters
    if len(estimate.parameter_names) == n_robot:
        return estimate
    nominal = fit(np.zeros(n_robot, dtype=bool))
    return replace(
        estimate,
        rms_before=nominal.rms_after,
        held_out_before=nominal.held_out,
        residual_before=nominal.residual,
    )


def read_inputs(paths: list[Path], joint_units: tuple[str, ...]) -> ObservationTable:
    """The observations of all inputs, one after the other."""
    from truearm.files.table import concatenate

    return concatenate([_read_input(path, joint_units) for path in paths])


def _read_input(path: Path, joint_units: tuple[str, ...]) -> ObservationTable:
    from truearm.files.table import read_table

    return read_table(path, joint_units)


def hashed_inputs(inputs: list[Path], robot: str, rig: Path | None) -> list[Input]:
    """Name and SHA-256 of every file that an identification read."""
    from truearm.files.result import input_of
    from truearm.files.robot import robot_file

    file = robot_file(robot)
    return [
        *(input_of("observations", path) for path in inputs),
        *([input_of("rig", rig)] if rig else []),
        *([input_of("robot", file)] if file else []),
    ]
