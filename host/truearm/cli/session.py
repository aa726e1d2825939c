"""``truearm session``: repair session files, and convert them for other programs."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

from truearm.bounds import OneOf
from truearm.cli.command import Answer, command
from truearm.cli.project import CommandGroup
from truearm.findings import Finding, entries
from truearm.model.robot_file import NO_ROBOT, RobotChoice
from truearm.record.robots.sources import FileOptions, files_help
from truearm.text import counted, one_line
from truearm.workflows.requests import ExportSession

app = CommandGroup(
    "session",
    help="Repair session files, and convert them for other programs.",
    epilog="Example: truearm session recover session.mcap",
)


@command(app, "recover")
def recover(session: Path, *, out: Path | None = None, force: bool = False) -> Answer:
    """Write all intact data of a damaged or unfinished session to a new file that every command reads.

    For a file whose recorder was killed, whose disk was full, or whose bytes were damaged. The file itself is not
    changed. Saved and lost data are listed by place, time and topic; gaps are not filled. An intact file is left alone.
    Exit code 0 if the data were saved, however many are lost, or if the file is intact; 2 if nothing could be saved.

    Example:
      truearm session recover session.mcap --out recovered.mcap

    Options
    -------
    out : FILE
        File to write: a session (default: NAME-recovered.mcap for NAME.mcap).
    details
        Print all damaged places, and what was saved and lost of each topic.
    """
    from truearm.report.tables import Table
    from truearm.workflows.recorded_session import further_parts, recovered_name
    from truearm.workflows.session_files import recover_file, recovery_findings

    out = out or recovered_name(session)
    recovered = recover_file(session, out, force)
    if recovered is None:
        intact = [Finding("session-intact", {"place": str(session)})]
        return Answer({"whole": True, "out": None, "findings": entries(intact)}, details_hint="")
    stated = [*recovery_findings(recovered), *further_parts(session, out)]
    document = {"whole": False, "out": str(out), **asdict(recovered), "findings": entries(stated)}
    rows = [(one_line(topic), account.saved, account.lost) for topic, account in recovered.topics.items()]
    return Answer(document, tables=[Table(("topic ", "saved", "lost"), rows)], written=[out])


@command(app, "relabel")
def relabel(
    session: Path,
    *,
    robot: RobotChoice = NO_ROBOT,
    rig: Path | None = None,
    trust: Annotated[str | None, OneOf(("plan", "typed", "evidence"))] = None,
    mounted: tuple[str, ...] = (),
) -> Answer:
    """Decide what was mounted at each dwell of a session where plan, operator and readings disagree.

    The session itself is not changed: the labels are written beside it, to NAME.labels.json, and all later commands use
    them; without that file, plan and confirmations apply again. A dwell is a rest of the robot at one pose. With
    --trust evidence it is labelled if one pairing of bar, chuck and sphere has a probability of at least 99.8 %,
    otherwise it is left out. Without --trust and --mounted, the doubtful dwells are printed, and nothing is written.

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
    details
        Print every dwell that is left out.
    """
    from truearm.kinds.rig_file import read_rig
    from truearm.workflows.relabel import relabel as relabel_session

    nominal = robot.load() if robot.robot else None
    document = relabel_session(session, nominal, trust, mounted, read_rig(rig) if rig else None)
    hint = None if document["saved"] else ""  # --mounted needs the number of every dwell
    return Answer(document, written=document["saved"], details_hint=hint)


@command(app, "add-joints", files=files_help())
def add_joints(
    session: Path,
    source: Path,
    *,
    out: Path,
    topic: str = "/joint_states",
    joints: str | None = None,
    robot: RobotChoice = NO_ROBOT,
    columns: tuple[tuple[str, str], ...] = (),
    zero: float | None = None,
    replace: bool = False,
    allow_damaged: bool = False,
    force: bool = False,
) -> Answer:
    """Add joint readings from a table or a ROS 2 bag to a session, as a new file.

    truearm did not see these readings arrive, so each is placed in time by the controller's clock. The new file records
    that its readings were added in this way.

    Example:
      truearm session add-joints session.mcap joints.csv --zero-s 3.2 --out with_joints.mcap
      truearm session add-joints s.mcap ur.csv --columns t_s=timestamp,q{}_rad=actual_q_{} --zero-s 3.2 --out new.mcap

    Arguments
    ---------
    source : FILE
        Joint readings: {files}.

    Options
    -------
    out : FILE
        File to write: a session (.mcap).
    zero_s : S
        When the controller's time was 0, in seconds after the first message of the session. Default: the controller's
        time is UTC.
    replace
        Replace the joint readings that the session has.
    """
    from truearm.workflows.recorded_session import further_parts
    from truearm.workflows.session_files import add_joints_file, joint_names

    joint_list = joint_names(joints, robot)
    options = FileOptions(topic, joint_list, allow_damaged, columns)
    count = add_joints_file(session, source, out, options, zero=zero, replace=replace, force=force)
    times = "UTC" if zero is None else "from --zero-s"
    added = Finding("joints-added", {"place": str(out), "n": count, "utc": zero is None})
    stated = [added, *further_parts(session, out)]
    return Answer({"out": str(out), "readings": count, "times": times, "findings": entries(stated)})


@command(app, "export")
def export_session(request: ExportSession) -> Answer:
    """Write a session as tables: all samples, joint readings, clock exchanges, events, plan, dwells, passes and
    observations.

    Writes one file per stream. A sample has the box's time, the synchronised host time with its error bound, the
    counts, and the value in the SI unit that its column names. Gaps are marked, not filled. session.json lists losses
    and describes the columns. --model determines which joints are prismatic; without it all are revolute.

    Example:
      truearm session export session.mcap --out tables --format parquet

    Options
    -------
    out : FOLDER
        Folder to write: the tables; it must be new or empty.
    format
        Format of the tables.
    """
    from truearm.workflows.recorded_session import further_parts
    from truearm.workflows.session_files import export_session_files

    document = export_session_files(request)
    tables = document["tables"]
    rows = {name: table["rows"] for name, table in tables.items()}
    nouns = {name: "sample" if "gap" in table["columns"] else "row" for name, table in tables.items()}
    texts = [f"{name} ({counted(n, nouns[name])})" for name, n in rows.items()]
    reason = document["not_paired"]
    stated = [
        Finding("tables-written", {"folder": str(request.out), "tables": texts}),
        *([Finding("session-not-evaluated", {"dwells": 0, "reason": reason})] if reason else []),
        *further_parts(request.session),
    ]
    return Answer({"folder": str(request.out), "rows": rows, "not_paired": reason, "findings": entries(stated)})
