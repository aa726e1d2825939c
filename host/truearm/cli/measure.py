"""Measure: the controller's model, plans, recordings, seats in sockets, and how well a robot repeats."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import click

from truearm.bounds import MINUTES, POSES, Within
from truearm.cli.command import Answer, command
from truearm.cli.output import print_json
from truearm.cli.project import CommandGroup, ProjectCommand, project_model, typed
from truearm.errors import ExitCode, IncompleteError
from truearm.findings import entries
from truearm.model.robot_file import NO_ROBOT, RobotChoice
from truearm.plan.options import ApproachOptions, Budget, LineOptions, PoseOptions
from truearm.record.robots.sources import TABLE, FileOptions, file_entry, files_help
from truearm.text import one_line
from truearm.units import DEG, MM
from truearm.workflows.requests import CharacterizeFiles, PlanFiles, RecordOptions

BANDS_MM = (0.02, 0.05, 0.1)  # of the settling time


robot = CommandGroup(
    "robot",
    help="Read the model that a robot's controller computes with.",
    epilog="Example: truearm robot read rtde://192.168.0.2 --model ur5e",
)


@command(robot)
def read(address: str, *, robot: str, out: Path = Path("robot.toml"), force: bool = False) -> Answer:
    """Read the factory calibration of a Universal Robots controller into a robot file.

    The controller computes with these kinematics, not with the drawing. Give the file as --model, or as model in
    truearm.toml, so that truearm identifies and corrects against them. truearm init reads them too. Nothing is sent to
    the controller.

    Example:
      truearm robot read rtde://192.168.0.2 --model ur5e
      truearm robot read calibration.conf --model ur5e --out robot.toml

    Arguments
    ---------
    address : SOURCE
        Controller (rtde://192.168.0.2, port 30001), its calibration.conf, or a file of ur_calibration (.yaml).

    Options
    -------
    model : ROBOT
        Built-in robot or robot file (.toml) with the values of the drawing.
    out : FILE
        File to write: the robot (.toml).
    """
    from truearm.workflows.controller_model import read_controller

    finding = read_controller(address, robot, out, force)
    return Answer({"findings": entries([finding]), "written": [str(out)]})


plan = CommandGroup(
    "plan",
    help="Plan what to measure, and predict what the measurements will determine.",
    epilog="\b\nExample:\n  truearm plan ballbar --model puma560 --rig rig.toml --minutes 40 --out plan.csv",
)


def _answer(document: dict[str, Any]) -> Answer:
    from truearm.cli.details import plan_tables

    return Answer(document, tables=plan_tables(document))


@command(plan, "ballbar")
def ballbar(
    files: PlanFiles,
    *,
    poses: Annotated[int | None, POSES] = None,
    minutes: Annotated[float | None, MINUTES] = None,
    chosen: PoseOptions,
    region: Any = None,
) -> Answer:
    """Plan ball-bar poses around the chucks.

    A pairing is one bar between one chuck (a magnetic cup on the table) and one sphere (a ball on the robot's end).
    With --minutes, only the pairings that are worth mounting are planned.

    Example:
      truearm plan ballbar --model puma560 --rig rig.toml --minutes 40 --out plan.csv --program-out plan.script

    Options
    -------
    out : FILE
        File to write: the plan that record follows (.csv).
    poses : N
        Budget in poses. Give this or --minutes.
    bar : NAME
        Use only this bar (repeatable).
    details
        Print the pairings, what can be held out, the unidentifiable combinations and the predicted sigma of every
        parameter.

    Expert options
    --------------
    measured : FILE
        Sessions and tables that are already measured (repeatable).
    region : X0:X1,Y0:Y1,Z0:Z1
        Box in which accuracy is wanted [mm, base frame]. Default: around the planned places of the spheres.
    candidates : N
        Poses to choose from.
    spread_mm : MM
        Vary the bar's length by up to this to either side of mid-travel, to determine its gain.
    visits : N
        Number of visits to every mount; with 2, drift and slip show.
    check_poses : N
        Poses to measure again: of the first mount half-way and at the end, of another mount at the end. At most one
        per 36 poses, none below 108 poses or with --visits 2 or more.
    joint_laws
        Also predict how well the poses will determine the joints' error curves.
    """
    from truearm.workflows.plan import BallBarOptions, plan_ball_bar_files

    options = BallBarOptions(**vars(chosen), region=region)
    return _answer(plan_ball_bar_files(files, Budget(poses, minutes), options))


@command(plan, "line")
def line(files: PlanFiles, *, options: LineOptions, region: Any = None) -> Answer:
    """Plan lines for a line device, driven there and back, preferably where the expected error is large.

    Example:
      truearm plan line --model ur5e --rig rig.toml --out lines.csv --rig-out lines.toml --program-out lines.script

    Options
    -------
    out : FILE
        File to write: the plan that record follows (.csv).
    lines : N
        Budget in lines. Give this or --minutes.
    rig_out : FILE
        Write the rig with these lines, for record and identify (.toml).
    details
        Print the position of each line, the unidentifiable combinations and the predicted sigma of every parameter.

    Expert options
    --------------
    measured : FILE
        Sessions and tables that are already measured (repeatable).
    target : NAME
        Target of the rig to measure. Default: its only one.
    length_mm : MM
        Length of the device.
    transverse_mm : MM
        Measuring range of the transverse sensors, from end to end.
    speed_mm_s : MM/S
        Speed on the lines.
    passes : N
        Drive each line there and back, N times.
    points : N
        Number of points per direction that the forecast assumes.
    region : X0:X1,Y0:Y1,Z0:Z1
        Box in which accuracy is wanted [mm, base frame]. Default: around the points of the candidate lines with the
        largest expected error.
    candidates : N
        Lines to choose from.
    """
    from truearm.workflows.plan import plan_line_files

    return _answer(plan_line_files(files, options, region))


@command(plan, "characterize")
def plan_characterize(files: PlanFiles, *, options: ApproachOptions) -> Answer:
    """Plan a short run that measures how well the robot repeats: a few poses, reached from both sides of every joint.

    Record it, then run truearm characterize on the session.

    Example:
      truearm plan characterize --model puma560 --rig rig.toml --out approaches.csv --program-out approaches.script

    Options
    -------
    out : FILE
        File to write: the plan that record follows (.csv).
    bar : NAME
        Which bar. Default: the rig's first.
    chuck : NAME
        Which chuck. Default: the rig's first.
    sphere : NAME
        Which sphere. Default: the rig's first.
    poses : N
        Number of poses; each is visited many times.
    rounds : N
        Number of rounds. In each, every pose is reached once from each of the planned combinations of joint directions
        (eight for four to seven joints), which together distinguish all joints.

    Expert options
    --------------
    long_dwell_s : S
        Duration of one long rest at each pose, which measures the noise.
    result
    """
    from truearm.workflows.plan import plan_approaches_files

    return _answer(plan_approaches_files(files, options))


class RecordCommand(ProjectCommand):
    """Takes plan, rig and robot from the session that it resumes, not from the project."""

    def invoke(self, ctx: Any) -> Any:
        """Run the command."""
        if ctx.params.get("resume") is not None:
            ctx.params.update({name: typed(ctx, name) for name in ("out", "plan", "rig", "address")})
        return super().invoke(ctx)


@command(cls=RecordCommand)
def record(request: RecordOptions) -> Answer:
    """Record a sensor box and a robot into a session file.

    Without --box, truearm uses the box that is plugged in. The recording ends with Ctrl-C, with q and Enter, after
    --duration-s, when the robot's program reports its end, or when a box or robot that was lost does not return within
    --patience-s. The file is complete in each case; the exit code is 4 if something that was asked for is missing.
    --force overwrites an earlier file only once the box has started. On a terminal you can type during the recording:
    Enter confirms what you are asked to mount, bar=NAME,chuck=NAME,sphere=NAME or line=NAME,target=NAME names another
    one, and note TEXT is stored.

    Example:
      truearm record --address tcp://127.0.0.1:7008 --rig rig.toml --plan plan.csv --out session.mcap
      truearm record --resume session.mcap

    Options
    -------
    out : FILE
        File to write: a session (.mcap); not with --resume.
    resume : FILE
        Continue this session in a further file beside it, with its plan, rig, rate and robot.
    address : URL
        Source of the robot's joint readings: {sources}. Without it, dwells are found from the sensor alone.
    rig : FILE
        Rig (.toml). It is stored in the session. Default with --resume: the rig of that session.
    mounted : LIST
        What is mounted at the start: bar=bar46,chuck=c1,sphere=s1 or line=l1,target=t1.
    rate : HZ
        Samples per second; the box's nearest rate is used. Default: 1000.

    Expert options
    --------------
    patience_s : S
        How long to wait for a box or robot whose link was lost; 0: do not wait.
    unchecked
        Record even if the box cannot measure what the plan or rig requires.
    """
    from truearm.findings import findings_of
    from truearm.workflows.record import record_request, recording_document

    request = replace(request, project_model=project_model(Path.cwd()))
    recorded = record_request(request, sys.stderr, lambda text: click.echo(text, err=True))
    document = recording_document(recorded)
    interrupted = recorded.summary.reason == "interrupted"
    end: ExitCode | IncompleteError = ExitCode.INTERRUPTED if interrupted else ExitCode.DONE
    if recorded.trouble:
        click.echo(recorded.trouble, err=True)
    if interrupted and not recorded.is_kept:
        click.echo("interrupted before the box had started; nothing was recorded", err=True)
    elif recorded.missing:
        data_place = f"; the received data are in {recorded.out}" if recorded.is_kept else "; nothing was recorded"
        named = recorded.is_kept and str(recorded.out) in document["missing"]
        end = IncompleteError(document["missing"] + ("" if named else data_place))
    printed = [finding for finding in findings_of(document) if finding not in recorded.missing]  # the error has them
    return Answer(document, findings=printed, end=end)


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

    The arm rests in the sockets in the order of the rows. Each rest fills the next row that has no joints. If there are
    more or fewer rests than such rows, they are listed and nothing is written.

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
    from truearm.workflows.session_files import joint_names
    from truearm.workflows.socket_project import fill_seats

    named = joints is not None or file_entry(source) is TABLE  # a table's columns are in order
    names = joint_names(joints, NO_ROBOT if named else robot)
    options = FileOptions(topic, names, allow_damaged, columns)
    finding = fill_seats(table, source, options, rest_s, DEG.to_si(rest_deg))
    return Answer({"findings": entries([finding]), "written": [str(table)]})


@command()
def inspect(session: Path, *, details: bool = False, json: bool = False, allow_damaged: bool = False) -> None:
    """Show whether a session is usable, what is in it, and what was lost.

    Example: truearm inspect session.mcap

    Options
    -------
    details
        Print rates, clocks and gaps, and tables of streams, dwells and lines.
    """
    from truearm.cli.details import session_tables
    from truearm.cli.output import show
    from truearm.report.session_findings import session_findings
    from truearm.session.session_file import open_session
    from truearm.workflows.inspect import describe
    from truearm.workflows.recorded_session import session_parts

    first, *further = [describe(open_session(path, allow_damaged)) for path in session_parts(session)]
    if json:
        print_json({**first, "parts": further})
        return
    for document in (first, *further):
        if document is not first:
            click.echo(f"\n{one_line(document['file'])} continues it:")
        show(session_findings(document), session_tables(document), details=details)


@command()
def characterize(
    files: CharacterizeFiles, *, within_mm: Annotated[tuple[float, ...], Within(0.0001, 100.0)] = ()
) -> Answer:
    """Measure how well a robot repeats: spread, backlash, settling time, noise of joints and sensor, each with its 95 %
    interval.

    The session is a recording of a plan of truearm plan characterize; files that continue it (truearm record
    --resume) are read with it. The nominal robot is sufficient. Give --plan if the session contains no plan.

    Example:
      truearm characterize approaches.mcap --model puma560 --out noise.toml

    Options
    -------
    within_mm : MM
        Count the arm as settled once the length stays within this distance of its final value (repeatable). Default:
        0.02, 0.05, 0.1.
    out : FILE
        File to write: the noise file for truearm identify --noise (.toml).
    details
        Print how the arm settles, the noise of joints and sensor, and a table of the joints. Difference: the mean
        reading of a joint that comes from below, minus from above. Scatter: the sigma of its readings from one side.
    """
    from truearm.workflows.characterize import characterize_files, joint_table

    bands = sorted({MM.to_si(mm) for mm in within_mm or BANDS_MM})
    document = characterize_files(files, bands)
    return Answer(document, tables=[joint_table(document)], written=[files.out])
