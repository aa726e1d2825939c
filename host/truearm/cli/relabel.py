"""``truearm session relabel``: settle after the recording what was mounted at each dwell."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from truearm.bounds import OneOf
from truearm.cli.command import command
from truearm.cli.output import print_result
from truearm.text import counted, one_line


@command()
def relabel(
    session: Path,
    *,
    model: str | None = None,
    base: str | None = None,
    tip: str | None = None,
    rig: Path | None = None,
    trust: Annotated[str | None, OneOf(("plan", "typed", "evidence"))] = None,
    mounted: list[str] | None = None,
    json: bool = False,
) -> None:
    """Decide what was mounted at each dwell of a session where plan, operator and readings disagree.

    The session itself is not changed: the labels are written beside it, to NAME.labels.json, and all later commands use them;
    without that file, plan and confirmations apply again. A dwell is a rest of the robot at one pose. With --trust evidence it is
    labelled if one pairing of bar, chuck and sphere has a probability of at least 99.8 %, otherwise it is left out. Without --trust
    and --mounted, the doubtful dwells are printed, and nothing is written.

    Example:
      truearm session relabel session.mcap --model puma560
      truearm session relabel session.mcap --model puma560 --trust evidence --mounted 12:14=bar46,c1,s2

    Options
    -------
    trust
        Accept the plan, the typed confirmations, or the evidence of both and the readings together (needs --model).
        Default: none of them, where they disagree.
    mounted : DWELLS=BAR,CHUCK,SPHERE
        What was mounted at some dwells, numbered as printed: 12:14=bar46,c1,s2; of a further part, "s.2.mcap 12=...".
    """
    from truearm.files.rig_file import read_rig
    from truearm.files.robot_file import RobotChoice
    from truearm.workflows.relabel import relabel as relabel_session

    robot = RobotChoice(model, base, tip).load() if model else None
    document = relabel_session(session, robot, trust, mounted or (), read_rig(rig) if rig else None)
    left_out, saved = document["left_out"], document["saved"]
    sessions, dwells = ", ".join(map(one_line, document["sessions"])), counted(document["dwells"], "dwell")
    summary = f"{sessions}: {dwells}, {document['with_reading']} with a reading within the stroke; "
    text = [summary + (f"{len(left_out)} left out:" if left_out else "none is left out")]
    text += [f"  {one_line(row['session'])} dwell {row['dwell']}: {one_line(row['detail'])}" for row in left_out]
    if saved:
        text.append(f"Written: {', '.join(map(one_line, saved))}. To undo this, delete it.")
    else:
        text.append("Nothing was written. Give --trust, or what was mounted, as --mounted 12:14=BAR,CHUCK,SPHERE.")
    print_result(document, text, json)
