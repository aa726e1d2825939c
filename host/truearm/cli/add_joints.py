"""``truearm add-joints``: joint readings that were taken down elsewhere, into a copy of a session."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import Annotated

import typer

from truearm.errors import InputError
from truearm.record.robots.sources import FileOptions, files_help, readings_of_file


def add_joints(
    session: Annotated[Path, typer.Argument(metavar="SESSION", help="Session file (.mcap) of truearm record.")],
    source: Annotated[
        Path,
        typer.Argument(metavar="FILE", help=f"Joint readings: {files_help()}."),
    ],
    out: Annotated[Path, typer.Option(metavar="FILE", help="The session file to write (.mcap).")],
    topic: Annotated[str, typer.Option(metavar="NAME", help="Of the joint states in a bag.")] = "/joint_states",
    joints: Annotated[
        str | None, typer.Option(metavar="LIST", help="Names of a bag's joints from the base on: a,b,c.")
    ] = None,
    robot: Annotated[
        str | None, typer.Option(metavar="ROBOT", help="Takes the names from a robot: a name, a .toml or a .urdf file.")
    ] = None,
    base: Annotated[str | None, typer.Option(metavar="LINK", help="First link of a URDF.")] = None,
    tip: Annotated[str | None, typer.Option(metavar="LINK", help="Last link of a URDF.")] = None,
    zero: Annotated[
        float | None,
        typer.Option(
            metavar="S", help="When the controller's time was 0, after the session's begin; default: it is UTC."
        ),
    ] = None,
    replace: Annotated[bool, typer.Option("--replace", help="Leave out the readings that the session has.")] = False,
    allow_damaged: Annotated[
        bool, typer.Option("--allow-damaged", help="Use what is whole of a damaged session or bag (.mcap).")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Overwrite the file to write.")] = False,
) -> None:
    """Add joint readings from a table or a ROS 2 bag to a session, as a new file.

    Nobody saw them arrive: their place in the session is worked out from the controller's time, and the file says so.

    \b
    Example:
      truearm add-joints session.mcap joints.csv --zero 3.2 --out with_joints.mcap
    """
    from truearm.files.disk import check_writable, sha256
    from truearm.record.robots.add_readings import add_readings
    from truearm.session.session_file import open_session
    from truearm.text import one_line
    from truearm.workflows.session_parts import say_parts

    check_writable(out, inputs=[session, source])
    if out.exists() and not force:
        raise InputError(f"{out}: exists; choose another name or give --force")
    if zero is not None and not abs(zero) < 1e9:
        raise InputError(f"--zero {zero:g} is no time; give seconds")
    opened = open_session(session, allow_damaged)
    readings = readings_of_file(source, FileOptions(topic, _joint_names(joints, robot, base, tip), allow_damaged))
    said = {
        "source": source.name,
        "session": session.name,
        "session_sha256": sha256(session),
        "time": "utc" if zero is None else f"0 at {zero!r} s of the session",
    }
    if opened.damage or opened.truncated:
        said["damaged"] = "what was not whole of the session is left out"
    with tempfile.TemporaryDirectory(prefix=".truearm-", dir=out.parent) as folder:
        partial = Path(folder) / "session.mcap"
        count = add_readings(opened, readings, partial, zero, said, replace)
        os.replace(partial, out)
    typer.echo(
        f"{out}: {count} joint readings added; their times are {'UTC' if zero is None else 'from --zero'}, not arrivals"
    )
    say_parts(session, f"add the joints to each by itself, and name the files one by one beside {one_line(out.name)}")


def _joint_names(joints: str | None, robot: str | None, base: str | None, tip: str | None) -> list[str]:
    """The joints' names from the base on; [] if nobody said. Raises InputError."""
    if joints is not None and robot is not None:
        raise InputError("--joints and --robot both name the joints; give one")
    if robot is not None:
        from truearm.files.robot_file import load_robot

        return [joint.name for joint in load_robot(robot, base, tip).chain.joints]
    names = [] if joints is None else [name.strip() for name in joints.split(",")]
    if "" in names or len(set(names)) < len(names):
        raise InputError(f"--joints {joints!r} is no list of different names: a,b,c")
    return names
