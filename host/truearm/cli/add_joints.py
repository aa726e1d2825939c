"""``truearm session add-joints``: add joint readings that another program recorded to a copy of a session."""

from __future__ import annotations

from pathlib import Path

from truearm.cli.command import command, fill
from truearm.cli.output import print_result, warn_of_further_parts
from truearm.record.robots.sources import FileOptions, files_help
from truearm.text import one_line


@command(files=files_help())
def add_joints(
    session: Path,
    source: Path,
    *,
    out: Path,
    topic: str = "/joint_states",
    joints: str | None = None,
    model: str | None = None,
    base: str | None = None,
    tip: str | None = None,
    columns: str | None = None,
    zero_s: float | None = None,
    replace: bool = False,
    allow_damaged: bool = False,
    force: bool = False,
    json: bool = False,
) -> None:
    """Add joint readings from a table or a ROS 2 bag to a session, as a new file.

    truearm did not see these readings arrive, so each is placed in time by the controller's clock. The new file records that
    its readings were added in this way.

    Example:
      truearm session add-joints session.mcap joints.csv --zero-s 3.2 --out with_joints.mcap
      truearm session add-joints session.mcap rtde.csv --columns t_s=timestamp,q{}_rad=actual_q_{} --zero-s 3.2 --out with_joints.mcap

    Arguments
    ---------
    source : FILE
        Joint readings: {files}.

    Options
    -------
    out : FILE
        File to write: a session (.mcap).
    topic : NAME
        Topic of the joint states in a bag.
    joints : LIST
        Names of a bag's joints, from the base on: a,b,c. Default: those of --model.
    columns : OURS=THEIRS,…
        Names of a table's columns, {} for a joint's number: t_s=timestamp,q{}_rad=actual_q_{}. Other columns are
        skipped.
    zero_s : S
        When the controller's time was 0, in seconds after the first message of the session. Default: the controller's
        time is UTC.
    replace
        Replace the joint readings that the session has.
    """
    from truearm.files.robot_file import RobotChoice
    from truearm.record.robots.joint_columns import parse_renames
    from truearm.workflows.add_joints import AddJoints, add_joints_file, joint_names

    joint_list = joint_names(joints, RobotChoice(model, base, tip))
    renames = () if columns is None else parse_renames(columns)
    files = fill(AddJoints, locals(), options=FileOptions(topic, joint_list, allow_damaged, renames))
    count = add_joints_file(files, force)
    times = "UTC" if zero_s is None else "from --zero-s"
    by = "their own times" if zero_s is None else "their own times and --zero-s"
    text = f"{out}: {count} joint readings added, placed by {by}"
    print_result({"out": str(out), "readings": count, "times": times}, [text], json)
    warn_of_further_parts(
        session,
        f"add the joints to each of them; later commands do not find the new files from {one_line(out.name)}, so name each file",
    )
