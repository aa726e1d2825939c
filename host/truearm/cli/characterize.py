"""``truearm characterize``: how well a robot repeats, and the noise file that ``truearm identify`` uses."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Annotated

import typer

from truearm.errors import InputError
from truearm.text import one_line
from truearm.units import MM

BANDS_MM = (0.02, 0.05, 0.1)


def characterize(
    session: Annotated[
        Path,
        typer.Argument(
            metavar="SESSION",
            help="Session (.mcap, its further parts are read with it) of the run that truearm plan characterize plans.",
        ),
    ],
    robot: Annotated[
        str, typer.Option(metavar="ROBOT", help="Built-in robot, robot file (.toml) or URDF; its design will do.")
    ],
    base: Annotated[str | None, typer.Option(metavar="LINK", help="First link of a URDF.")] = None,
    tip: Annotated[str | None, typer.Option(metavar="LINK", help="Last link of a URDF.")] = None,
    rig: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Chucks, spheres, bars (.toml); default: the session's own.")
    ] = None,
    plan: Annotated[
        Path | None, typer.Option(metavar="FILE", help="What the robot visited (.csv), where the session has no plan.")
    ] = None,
    within_mm: Annotated[
        list[float] | None,
        typer.Option(
            min=1e-4, max=100.0, metavar="MM", help="Band to settle in (repeatable); default 0.02, 0.05, 0.1."
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the noise file for truearm identify --noise (.toml).")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print everything as JSON and nothing else.")] = False,
    allow_damaged: Annotated[
        bool, typer.Option("--allow-damaged", help="Use what is whole of a damaged session.")
    ] = False,
) -> None:
    """Say how well a robot repeats: spread, backlash, settling time, noise of joints and sensor, with their intervals.

    \b
    Example:
      truearm characterize approaches.mcap --robot puma560 --out noise.toml
    """
    from truearm.cli.characterize_text import lines, remarks
    from truearm.files.robot_file import RobotChoice
    from truearm.files.strict_json import strict_json
    from truearm.workflows.characterize import CharacterizeFiles, characterize_files

    for mm in within_mm or ():
        if not 0.0 < mm < math.inf:  # typer's bounds let nan pass
            raise InputError(f"--within-mm must be a finite number, is {mm}")
    if out == Path("-"):
        raise InputError("-: is no file name; --json prints to standard output")
    bands = sorted({MM.to_si(mm) for mm in within_mm or BANDS_MM})
    name = one_line(session.name)
    files = CharacterizeFiles(session, RobotChoice(robot, base, tip), rig, plan, out, allow_damaged)
    found = characterize_files(files, bands, lambda document: remarks(document, name))
    if as_json:
        sys.stdout.write(strict_json(found, indent=1) + "\n")
        return
    for line in lines(found, name):
        typer.echo(line)
    if out is not None:
        typer.echo(f"\nwritten: {out}, for truearm identify --noise {out}")
