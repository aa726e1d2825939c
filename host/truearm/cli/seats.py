"""``truearm seats``: take the joints of seats in sockets from the arm's own log."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from truearm.bounds import Within
from truearm.cli.command import Answer, command
from truearm.findings import entries
from truearm.model.robot_file import NO_ROBOT, RobotChoice
from truearm.record.robots.sources import TABLE, FileOptions, file_entry, files_help
from truearm.units import DEG


@command(files=files_help())
def seats(
    source: Path,
    *,
    table: Path,
    robot: RobotChoice = NO_ROBOT,
    topic: str = "/joint_states",
    joints: str | None = None,
    columns: tuple[tuple[str, str], ...] = (),
    rest_s: Annotated[float, Within(0.2, 600.0)] = 1.0,
    rest_deg: Annotated[float, Within(0.001, 5.0)] = 0.1,
    allow_damaged: bool = False,
) -> Answer:
    """Fill the joints of seats in sockets into their table, from a log of the arm.

    The arm rests in the sockets in the order of the rows. Each rest fills the next row that has no joints. If there are more or
    fewer rests than such rows, they are listed and nothing is written.

    Example:
      truearm seats log.csv --table seats.csv --rest-s 5

    Arguments
    ---------
    source : FILE
        Joint readings: {files}.

    Options
    -------
    table : FILE
        Table of seats that truearm init made (.csv). It is changed.
    rest_s : S
        Shortest rest in a socket.
    rest_deg : DEG
        Range within which every joint remains during a rest; of a prismatic joint in mm.
    """
    from truearm.workflows.seat_log import fill_seats
    from truearm.workflows.session_copies import joint_names

    named = joints is not None or file_entry(source) is TABLE  # a table's columns are in order
    names = joint_names(joints, NO_ROBOT if named else robot)
    options = FileOptions(topic, names, allow_damaged, columns)
    finding = fill_seats(table, source, options, rest_s, DEG.to_si(rest_deg))
    return Answer({"findings": entries([finding]), "written": [str(table)]})
