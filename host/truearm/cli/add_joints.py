"""``truearm session add-joints``: add joint readings that another program recorded to a copy of a session."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from truearm.cli.options import (
    AllowDamagedOption,
    BaseOption,
    ForceOption,
    JsonOption,
    OptionalRobotOption,
    SessionArgument,
    TipOption,
    out_file,
)
from truearm.cli.output import print_result, warn_of_further_parts
from truearm.record.robots.sources import FileOptions, files_help
from truearm.text import one_line


def add_joints(
    session: SessionArgument,
    source: Annotated[Path, typer.Argument(metavar="FILE", help=f"Joint readings: {files_help()}.")],
    out: Annotated[Path, out_file("a session (.mcap)")],
    topic: Annotated[str, typer.Option(metavar="NAME", help="Topic of the joint states in a bag.")] = "/joint_states",
    joints: Annotated[
        str | None,
        typer.Option(
            metavar="LIST", help="Names of a bag's joints, from the base on: a,b,c. Default: those of --model."
        ),
    ] = None,
    robot: OptionalRobotOption = None,
    base: BaseOption = None,
    tip: TipOption = None,
    columns: Annotated[
        str | None,
        typer.Option(
            metavar="OURS=THEIRS,…",
            help="Names of a table's columns, {} for a joint's number: t_s=timestamp,q{}_rad=actual_q_{}. "
            "Other columns are skipped.",
        ),
    ] = None,
    zero: Annotated[
        float | None,
        typer.Option(
            metavar="S",
            help="When the controller's time was 0, in seconds after the first message of the session. Default: the controller's time is UTC.",
        ),
    ] = None,
    replace: Annotated[
        bool, typer.Option("--replace", help="Replace the joint readings that the session has.")
    ] = False,
    allow_damaged: AllowDamagedOption = False,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Add joint readings from a table or a ROS 2 bag to a session, as a new file.

    truearm did not see these readings arrive, so each is placed in time by the controller's clock. The new file records that
    its readings were added in this way.

    \b
    Example:
      truearm session add-joints session.mcap joints.csv --zero 3.2 --out with_joints.mcap
      truearm session add-joints session.mcap rtde.csv --columns t_s=timestamp,q{}_rad=actual_q_{} --zero 3.2 --out with_joints.mcap
    """
    from truearm.files.robot_file import RobotChoice
    from truearm.record.robots.joint_columns import parse_renames
    from truearm.workflows.add_joints import AddJoints, add_joints_file, joint_names

    count = add_joints_file(
        AddJoints(
            session=session,
            source=source,
            out=out,
            options=FileOptions(
                topic,
                joint_names(joints, RobotChoice(robot, base, tip)),
                allow_damaged,
                () if columns is None else parse_renames(columns),
            ),
            zero=zero,
            replace=replace,
        ),
        force,
    )
    times = "UTC" if zero is None else "from --zero"
    by = "their own times" if zero is None else "their own times and --zero"
    text = f"{out}: {count} joint readings added, placed by {by}"
    print_result({"out": str(out), "readings": count, "times": times}, [text], as_json)
    warn_of_further_parts(
        session,
        f"add the joints to each of them; later commands do not find the new files from {one_line(out.name)}, so name each file",
    )
