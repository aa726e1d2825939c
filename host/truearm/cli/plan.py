"""``truearm plan``: which poses to measure, in which order, and what they will determine."""

from __future__ import annotations

from typing import Annotated, Any

from truearm.bounds import MINUTES, POSES
from truearm.cli.command import Answer, command
from truearm.cli.project import CommandGroup
from truearm.plan.options import ApproachOptions, Budget, LineOptions, PoseOptions
from truearm.workflows.requests import PlanFiles

app = CommandGroup(
    "plan",
    help="Plan what to measure, and predict what the measurements will determine.",
    epilog="\b\nExample:\n  truearm plan ballbar --model puma560 --rig rig.toml --minutes 40 --out plan.csv",
)


def _answer(document: dict[str, Any]) -> Answer:
    from truearm.cli.details import plan_tables

    return Answer(document, tables=plan_tables(document))


@command(app, "ballbar")
def ballbar(
    files: PlanFiles,
    *,
    poses: Annotated[int | None, POSES] = None,
    minutes: Annotated[float | None, MINUTES] = None,
    chosen: PoseOptions,
    region: Any = None,
) -> Answer:
    """Plan ball-bar poses around the chucks.

    A pairing is one bar between one chuck (a magnetic cup on the table) and one sphere (a ball on the robot's end). With
    --minutes, only the pairings that are worth mounting are planned.

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
        Print the pairings, what can be held out, the unidentifiable combinations and the predicted sigma of every parameter.

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


@command(app, "line")
def line(files: PlanFiles, *, options: LineOptions, region: Any = None) -> Answer:
    """Plan lines for a line device, driven there and back, preferably where the expected error is large.

    Example:
      truearm plan line --model ur5e --rig rig.toml --lines 6 --out lines.csv --rig-out lines.toml --program-out lines.script

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


@command(app, "characterize")
def characterize(files: PlanFiles, *, options: ApproachOptions) -> Answer:
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
