"""``truearm characterize``: how well a robot repeats, and the noise file that ``truearm identify`` uses."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from truearm.errors import InputError, RigError
from truearm.units import MM

if TYPE_CHECKING:
    from truearm.session.session_file import Session
    from truearm.types import Message, Rig

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
    from truearm.files.disk import check_writable, write_atomic
    from truearm.files.noise_file import format_noise, looks_like_noise
    from truearm.files.robot_file import load_robot, robot_file
    from truearm.files.strict_json import strict_json
    from truearm.session.session_file import open_session
    from truearm.text import one_line
    from truearm.workflows.characterize import Part, characterized
    from truearm.workflows.inspect import ident_of
    from truearm.workflows.session_parts import session_parts

    for mm in within_mm or ():
        if not 0.0 < mm < math.inf:  # typer's bounds let nan pass
            raise InputError(f"--within-mm must be a finite number, is {mm}")
    files = session_parts(session)
    if out == Path("-"):
        raise InputError("-: is no file name; --json prints to standard output")
    if out is not None:
        read = [*files, *filter(None, [rig, plan, robot_file(robot)])]
        check_writable(out, inputs=read, ours=looks_like_noise)
    loaded = load_robot(robot, base, tip)
    opened = {path: open_session(path, allow_damaged) for path in files}
    bands = sorted({MM.to_si(mm) for mm in within_mm or BANDS_MM})
    around = _rig(opened, rig)
    parts = [Part(_with_plan(one, plan), path.name, ident_of(one)) for path, one in opened.items()]
    found, noise = characterized(parts, loaded.chain, around, bands)
    if out is not None:
        prismatic = any(joint.kind == "prismatic" for joint in loaded.chain.joints)
        said = list(remarks(found, one_line(session.name)))
        write_atomic(out, format_noise(noise, said, prismatic))
    if as_json:
        sys.stdout.write(strict_json(found, indent=1) + "\n")
        return
    for line in lines(found, one_line(session.name)):
        typer.echo(line)
    if out is not None:
        typer.echo(f"\nwritten: {out}, for truearm identify --noise {out}")


def _rig(opened: Mapping[Path, Session], given: Path | None) -> Rig:
    """The rig that was given, else the one that all parts were recorded with."""
    from truearm.files.rig_file import read_rig
    from truearm.workflows.session_observations import attached_rig

    if given is not None:
        return read_rig(given)
    first: Rig | None = None
    for path, session in opened.items():
        found = attached_rig(session, path)
        if found is None:
            raise RigError(f"{path}: was recorded without a rig; give one with --rig")
        first = first or found
        if found != first:
            raise RigError(f"{path}: was recorded with another rig than {next(iter(opened))}; give one with --rig")
    assert first is not None
    return first


def _with_plan(session: Session, path: Path | None) -> Callable[[Collection[str] | None], Iterator[Message]]:
    """What the session holds, a plan file's rows in place of its own plan."""
    from truearm.files.plan_file import read_plan
    from truearm.types import Message
    from truearm.workflows.record import plan_rows

    if path is None:
        return lambda topics: session.messages(topics)
    rows = [Message("/plan", 0, json.dumps(row).encode()) for row in plan_rows(read_plan(path))]

    def messages(topics: Collection[str] | None) -> Iterator[Message]:
        if topics is None:
            yield from rows
        yield from (message for message in session.messages(topics) if message.topic != "/plan")

    return messages
