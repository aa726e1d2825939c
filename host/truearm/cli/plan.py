"""``truearm plan``: which poses to measure, in which order, and what they will determine."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from truearm import option_defaults
from truearm.bounds import CANDIDATES, CHECK_POSES, DWELL, MINUTES, POSES, TRAVEL, VISITS
from truearm.cli.options import (
    BaseOption,
    BranchOption,
    ForceOption,
    JsonOption,
    RigOption,
    RobotOption,
    SeedOption,
    TipOption,
    bounded,
    branch_given,
    choices,
    completed,
    one_of,
    out_file,
    spans_of,
)
from truearm.cli.output import command_group, print_result
from truearm.cli.project import ProjectCommand, typed
from truearm.errors import InputError
from truearm.plan.criteria import Criterion, criterion_summary
from truearm.plan.route_program import dialects_help
from truearm.units import MM, MM_S

if TYPE_CHECKING:
    from truearm.plan.region import Region

app = command_group(
    "plan",
    "Plan what to measure, and predict what the measurements will determine.",
    "\b\nExample:\n  truearm plan ballbar --model puma560 --rig rig.toml --minutes 40 --out plan.csv",
)

MinutesOption = Annotated[
    float | None,
    typer.Option(
        metavar="M",
        help="Budget in minutes of the operator's time.",
        **bounded(MINUTES),
    ),
]
CriterionOption = Annotated[
    str,
    typer.Option(
        metavar=choices(tuple(Criterion)),
        callback=one_of(tuple(Criterion)),
        autocompletion=completed(tuple(Criterion)),
        help="What to minimise. " + ". ".join(f"{name}: {criterion_summary(name)}" for name in Criterion) + ".",
    ),
]


def _region_option(default: str) -> Any:
    return typer.Option(
        metavar="X0:X1,Y0:Y1,Z0:Z1", help=f"Box in which accuracy is wanted [mm, base frame]. Default: {default}."
    )


ResultOption = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="Plan with the robot of an earlier result.json instead of the nominal one."),
]
MeasuredOption = Annotated[
    list[Path] | None,
    typer.Option(metavar="FILE", help="Sessions and tables that are already measured (repeatable)."),
]
OutOption = Annotated[Path | None, out_file("the plan that record follows (.csv)")]
ProgramOption = Annotated[
    list[Path] | None,
    typer.Option(metavar="FILE", help=f"Write the program: {dialects_help()} (repeatable)."),
]
InputOption = Annotated[
    int | None,
    typer.Option(
        min=0,
        metavar="N",
        help="Digital input of the controller on which another device acknowledges --output-line: the program waits up to 5 s for this input. The box does not acknowledge. Default: no waiting.",
    ),
]
OutputOption = Annotated[
    int,
    typer.Option(
        min=0, metavar="N", help="Digital output that is on while the robot rests at a pose or drives a line (UR)."
    ),
]
ReserveOption = Annotated[
    float | None,
    typer.Option(
        "--reserve-mm",
        metavar="MM",
        help=f"Travel reserved for errors of the model. Default: {MM.of(option_defaults.DESIGN_RESERVE):g}, "
        f"{MM.of(option_defaults.RESULT_RESERVE):g} with --result.",
        **bounded(TRAVEL, MM),
    ),
]


def _region_of(text: str | None) -> Region | None:
    """Return the box [m] of the option in mm, None if it was not given. Raises InputError."""
    import numpy as np

    from truearm.plan.region import Region

    if text is None:
        return None
    lower, upper = spans_of("--region", text, MM)
    if len(lower) != 3:
        raise InputError(f"--region {text[:60]!r}: needs LOW:HIGH in mm for x, y and z, separated by commas")
    return Region(np.array(lower), np.array(upper))


@app.command("ballbar", cls=ProjectCommand)
def ballbar(
    context: typer.Context,
    robot: RobotOption,
    rig: RigOption,
    base: BaseOption = None,
    tip: TipOption = None,
    poses: Annotated[
        int | None, typer.Option(metavar="N", help="Budget in poses. Give this or --minutes.", **bounded(POSES))
    ] = None,
    minutes: MinutesOption = None,
    criterion: CriterionOption = option_defaults.CRITERION,
    region: Annotated[str | None, _region_option("around the planned places of the spheres")] = None,
    bars: Annotated[
        list[str] | None, typer.Option("--bar", metavar="NAME", help="Use only this bar (repeatable).")
    ] = None,
    candidates: Annotated[
        int, typer.Option(metavar="N", help="Poses to choose from.", **bounded(CANDIDATES))
    ] = option_defaults.BAR_CANDIDATES,
    result: ResultOption = None,
    measured: MeasuredOption = None,
    branch: BranchOption = None,
    reserve: ReserveOption = None,
    spread: Annotated[
        float,
        typer.Option(
            "--spread-mm",
            metavar="MM",
            help="Vary the bar's length by up to this to either side of mid-travel, to determine its gain.",
            **bounded(TRAVEL, MM),
        ),
    ] = MM.of(option_defaults.SPREAD),
    dwell_s: Annotated[
        float, typer.Option(metavar="S", help="Duration of the rest at each pose.", **bounded(DWELL))
    ] = option_defaults.DWELL,
    visits: Annotated[
        int,
        typer.Option(
            metavar="N",
            help="Number of visits to every mount; with 2, drift and slip show.",
            **bounded(VISITS),
        ),
    ] = option_defaults.VISITS,
    check_poses: Annotated[
        int,
        typer.Option(
            metavar="N",
            help="Poses of the first mount to measure again half-way and at the end: at most one per 36 poses, none below "
            "108 poses or with --visits 2 or more.",
            **bounded(CHECK_POSES),
        ),
    ] = option_defaults.CHECK_POSES,
    joint_laws: Annotated[
        bool,
        typer.Option("--joint-laws", help="Also predict how well the poses will determine the joints' error curves."),
    ] = False,
    seed: SeedOption = option_defaults.SEED,
    out: OutOption = None,
    program: ProgramOption = None,
    output_line: OutputOption = 0,
    input_line: InputOption = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Plan ball-bar poses around the chucks.

    A pairing is one bar between one chuck (a magnetic cup on the table) and one sphere (a ball on the robot's end). With
    --minutes, only the pairings that are worth mounting are planned. Prints the rank, the unidentifiable combinations, the predicted sigma of every parameter, the expected error in the region,
    and the minutes.

    \b
    Example:
      truearm plan ballbar --model puma560 --rig rig.toml --minutes 40 --out plan.csv --program plan.script
    """
    from truearm.cli.plan_text import forecast_lines
    from truearm.files.robot_file import RobotChoice
    from truearm.plan.route_stops import Signals
    from truearm.workflows.plan import BallBarOptions, Budget, PlanFiles, plan_ball_bar_files

    files = PlanFiles(
        robot=RobotChoice(robot, base, tip),
        rig=rig,
        result=result,
        measured=tuple(measured or ()),
        branch=branch_given(branch),
        out=out,
        programs=tuple(program or ()),
        signals=Signals(output_line, input_line),
        force=force,
    )
    options = BallBarOptions(
        criterion=criterion,
        region=_region_of(region),
        candidates=candidates,
        bars=tuple(bars or ()),
        reserve=None if reserve is None else MM.to_si(reserve),
        spread=MM.to_si(spread),
        dwell=dwell_s,
        seed=seed,
        visits=visits,
        check_poses=check_poses,
        joint_laws=joint_laws,
    )
    document = plan_ball_bar_files(files, Budget(poses, minutes), options)
    print_result(document, forecast_lines(document, typed(context, "check_poses")), as_json)


@app.command("line", cls=ProjectCommand)
def line(
    robot: RobotOption,
    rig: RigOption,
    base: BaseOption = None,
    tip: TipOption = None,
    lines: Annotated[
        int | None, typer.Option(min=1, max=100, metavar="N", help="Budget in lines. Give this or --minutes.")
    ] = None,
    minutes: MinutesOption = None,
    length_mm: Annotated[float, typer.Option(min=10.0, max=5000.0, metavar="MM", help="Length of the device.")] = MM.of(
        option_defaults.LINE_LENGTH
    ),
    transverse_mm: Annotated[
        float,
        typer.Option(
            min=1.0, max=500.0, metavar="MM", help="Measuring range of the transverse sensors, from end to end."
        ),
    ] = MM.of(option_defaults.TRANSVERSE_RANGE),
    speed_mm_s: Annotated[
        float, typer.Option(min=1.0, max=1000.0, metavar="MM/S", help="Speed on the lines.")
    ] = MM_S.of(option_defaults.LINE_SPEED),
    passes: Annotated[
        int, typer.Option(min=1, max=20, metavar="N", help="Drive each line there and back, N times.")
    ] = option_defaults.PASSES,
    points: Annotated[
        int, typer.Option(min=3, max=500, metavar="N", help="Number of points per direction that the forecast assumes.")
    ] = option_defaults.LINE_POINTS,
    target: Annotated[
        str | None, typer.Option(metavar="NAME", help="Target of the rig to measure. Default: its only one.")
    ] = None,
    criterion: CriterionOption = option_defaults.CRITERION,
    region: Annotated[
        str | None, _region_option("around the points of the candidate lines with the largest expected error")
    ] = None,
    candidates: Annotated[
        int, typer.Option(min=1, max=5000, metavar="N", help="Lines to choose from.")
    ] = option_defaults.LINE_CANDIDATES,
    result: ResultOption = None,
    measured: MeasuredOption = None,
    branch: BranchOption = None,
    seed: SeedOption = option_defaults.SEED,
    out: OutOption = None,
    rig_out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write the rig with these lines, for record and identify (.toml)."),
    ] = None,
    program: ProgramOption = None,
    output_line: OutputOption = 0,
    input_line: InputOption = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Plan lines for a line device, driven there and back, preferably where the expected error is large.

    Prints the position of each line, the unidentifiable combinations, the predicted sigma of every parameter, the expected error,
    and the minutes.

    \b
    Example:
      truearm plan line --model ur5e --rig rig.toml --lines 6 --out lines.csv --rig-out lines.toml --program lines.script
    """
    from truearm.cli.plan_text import forecast_lines
    from truearm.files.robot_file import RobotChoice
    from truearm.plan.cartesian_lines import Shape
    from truearm.plan.route_stops import Signals
    from truearm.workflows.plan import Budget, LineOptions, PlanFiles, plan_line_files

    files = PlanFiles(
        robot=RobotChoice(robot, base, tip),
        rig=rig,
        result=result,
        measured=tuple(measured or ()),
        branch=branch_given(branch),
        out=out,
        rig_out=rig_out,
        programs=tuple(program or ()),
        signals=Signals(output_line, input_line),
        force=force,
    )
    options = LineOptions(
        shape=Shape(MM.to_si(length_mm), MM.to_si(transverse_mm), MM_S.to_si(speed_mm_s), points),
        passes=passes,
        target=target,
        criterion=criterion,
        region=_region_of(region),
        candidates=candidates,
        seed=seed,
    )
    document = plan_line_files(files, Budget(lines, minutes), options)
    print_result(document, forecast_lines(document), as_json)


@app.command("characterize", cls=ProjectCommand)
def characterize(
    robot: RobotOption,
    rig: RigOption,
    base: BaseOption = None,
    tip: TipOption = None,
    bar: Annotated[str | None, typer.Option(metavar="NAME", help="Which bar. Default: the rig's first.")] = None,
    chuck: Annotated[str | None, typer.Option(metavar="NAME", help="Which chuck. Default: the rig's first.")] = None,
    sphere: Annotated[str | None, typer.Option(metavar="NAME", help="Which sphere. Default: the rig's first.")] = None,
    poses: Annotated[
        int, typer.Option(min=1, max=50, metavar="N", help="Number of poses; each is visited many times.")
    ] = option_defaults.APPROACH_POSES,
    rounds: Annotated[
        int,
        typer.Option(
            min=2,
            max=100,
            metavar="N",
            help="Number of rounds. In each, every pose is reached once from each of the planned combinations of joint directions (eight for four to seven joints), which together distinguish all joints.",
        ),
    ] = option_defaults.ROUNDS,
    long_s: Annotated[
        float,
        typer.Option(
            min=2.0, max=60.0, metavar="S", help="Duration of one long rest at each pose, which measures the noise."
        ),
    ] = option_defaults.LONG_DWELL,
    result: ResultOption = None,
    branch: BranchOption = None,
    reserve: ReserveOption = None,
    dwell_s: Annotated[
        float, typer.Option(metavar="S", help="Duration of the rest at each pose.", **bounded(DWELL))
    ] = option_defaults.DWELL,
    seed: SeedOption = option_defaults.SEED,
    out: OutOption = None,
    program: ProgramOption = None,
    output_line: OutputOption = 0,
    input_line: InputOption = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Plan a short run that measures how well the robot repeats: a few poses, reached from both sides of every joint.

    Record it, then run truearm characterize on the session.

    \b
    Example:
      truearm plan characterize --model puma560 --rig rig.toml --out approaches.csv --program approaches.script
    """
    from truearm.cli.plan_text import approach_lines
    from truearm.files.robot_file import RobotChoice
    from truearm.plan.route_stops import Signals
    from truearm.workflows.plan import ApproachOptions, PlanFiles, plan_approaches_files

    files = PlanFiles(
        robot=RobotChoice(robot, base, tip),
        rig=rig,
        result=result,
        branch=branch_given(branch),
        out=out,
        programs=tuple(program or ()),
        signals=Signals(output_line, input_line),
        force=force,
    )
    options = ApproachOptions(
        bar=bar,
        chuck=chuck,
        sphere=sphere,
        poses=poses,
        rounds=rounds,
        long_dwell=long_s,
        dwell=dwell_s,
        reserve=None if reserve is None else MM.to_si(reserve),
        seed=seed,
    )
    document = plan_approaches_files(files, options)
    print_result(document, approach_lines(document), as_json)
