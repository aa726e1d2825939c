"""``truearm characterize``: how well a robot repeats, and the noise file that ``truearm identify`` uses."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from truearm.cli.options import (
    AllowDamagedOption,
    BaseOption,
    ForceOption,
    JsonOption,
    PlanOption,
    RobotOption,
    SessionArgument,
    SessionRigOption,
    TipOption,
    out_file,
)
from truearm.cli.output import print_json, print_lines
from truearm.errors import InputError
from truearm.text import one_line
from truearm.units import MM

BANDS_MM = (0.02, 0.05, 0.1)


def characterize(
    session: SessionArgument,
    robot: RobotOption,
    base: BaseOption = None,
    tip: TipOption = None,
    rig: SessionRigOption = None,
    plan: PlanOption = None,
    within_mm: Annotated[
        list[float] | None,
        typer.Option(
            min=1e-4,
            max=100.0,
            metavar="MM",
            help="Count the arm as settled once the length stays within this distance of its final value (repeatable). Default: 0.02, 0.05, 0.1.",
        ),
    ] = None,
    out: Annotated[Path | None, out_file("the noise file for truearm identify --noise (.toml)")] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
    allow_damaged: AllowDamagedOption = False,
) -> None:
    """Measure how well a robot repeats: spread, backlash, settling time, noise of joints and sensor, each with its 95 % interval.

    The session is a recording of a plan of truearm plan characterize; files that continue it (truearm record
    --resume) are read with it. The nominal robot is sufficient. Give --plan if the session contains no plan.

    \b
    Example:
      truearm characterize approaches.mcap --model puma560 --out noise.toml
    """
    from truearm.cli.characterize_text import lines, remarks
    from truearm.files.robot_file import RobotChoice
    from truearm.workflows.characterize import CharacterizeFiles, characterize_files

    for mm in within_mm or ():
        if not 0.0 < mm < math.inf:  # typer's bounds accept nan
            raise InputError(f"--within-mm must be a finite number, is {mm}")
    if out == Path("-"):
        raise InputError("--out -: is not a file name; --json prints to standard output")
    bands = sorted({MM.to_si(mm) for mm in within_mm or BANDS_MM})
    name = one_line(session.name)
    files = CharacterizeFiles(session, RobotChoice(robot, base, tip), rig, plan, out, allow_damaged, force)
    found = characterize_files(files, bands, lambda document: remarks(document, name))
    if as_json:
        print_json(found)
        return
    print_lines(lines(found, name))
    if out is not None:
        typer.echo(f"\nwritten: {out}, for truearm identify --noise {out}")
