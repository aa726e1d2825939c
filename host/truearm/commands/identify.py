"""``truearm identify``: observations in, parameters with their uncertainty out."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from truearm.files.result import Input
    from truearm.types import ObservationTable


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
    patterns = (["*"] if all_free else free or [], freeze or [])
    document = _identified(inputs, (robot, base, tip), rig, hold_out or [], seed, patterns, max_iterations, save_table)
    if out is not None:
        write_result(out, document)
    if as_json:
        sys.stdout.write(format_document(document) + "\n")
    else:
        from truearm.commands.show import show_result

        show_result(document, out)


def _identified(
    inputs: list[Path],
    robot: tuple[str, str | None, str | None],
    rig: Path | None,
    hold_out: list[str],
    seed: int,
    patterns: tuple[list[str], list[str]],
    max_iterations: int,
    save_table: Path | None,
) -> dict[str, Any]:
    """Read everything, identify, and return the content of result.json."""
    from truearm.commands.choice import free_parameters, held_out_rows
    from truearm.estimate.identify import identify as estimate_parameters
    from truearm.files.result import RobotFrames, document_of
    from truearm.files.rig import read_rig
    from truearm.files.robot import joint_units, load_robot
    from truearm.files.table import check_against_rig, write_table
    from truearm.types import Rig

    model = load_robot(*robot)
    chain, units = model.chain, joint_units(model.chain)
    surroundings = read_rig(rig) if rig else Rig()
    table = read_inputs(inputs, units)
    check_against_rig(table, surroundings)
    held_out = held_out_rows(table, hold_out, seed)
    free = free_parameters(chain.parameter_names, model.free, *patterns)
    if save_table is not None:
        write_table(save_table, table, units)
    estimate = estimate_parameters(
        chain, surroundings, table, free=free, hold_out=held_out, max_iterations=max_iterations
    )
    frames = RobotFrames(chain.name, chain.base_frame, chain.end_frame, units)
    return document_of(estimate, table, frames, _hashed(inputs, robot[0], rig), hold_out)


def read_inputs(paths: list[Path], joint_units: tuple[str, ...]) -> ObservationTable:
    """The observations of all inputs, one after the other."""
    from truearm.files.table import concatenate

    return concatenate([_read_input(path, joint_units) for path in paths])


def _read_input(path: Path, joint_units: tuple[str, ...]) -> ObservationTable:
    from truearm.files.table import read_table

    return read_table(path, joint_units)


def _hashed(inputs: list[Path], robot: str, rig: Path | None) -> list[Input]:
    from truearm.files.result import input_of
    from truearm.files.robot import robot_file

    file = robot_file(robot)
    return [
        *(input_of("observations", path) for path in inputs),
        *([input_of("rig", rig)] if rig else []),
        *([input_of("robot", file)] if file else []),
    ]
