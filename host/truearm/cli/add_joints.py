"""``truearm add-joints``: joint readings that were taken down elsewhere, into a copy of a session."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from truearm.cli.options import say_parts
from truearm.record.robots.sources import FileOptions, files_help
from truearm.text import one_line


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
    from truearm.files.robot_file import RobotChoice
    from truearm.workflows.add_joints import AddJoints, add_joints_file, joint_names

    count = add_joints_file(
        AddJoints(
            session=session,
            source=source,
            out=out,
            options=FileOptions(topic, joint_names(joints, RobotChoice(robot, base, tip)), allow_damaged),
            zero=zero,
            replace=replace,
        ),
        force,
    )
    typer.echo(
        f"{out}: {count} joint readings added; their times are {'UTC' if zero is None else 'from --zero'}, not arrivals"
    )
    say_parts(session, f"add the joints to each by itself, and name the files one by one beside {one_line(out.name)}")
