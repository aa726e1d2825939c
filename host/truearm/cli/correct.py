"""``truearm correct``: correct a table of targets or a robot program."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from truearm.cli.options import (
    AllowUnusableOption,
    IdentifiedBaseOption,
    IdentifiedRobotOption,
    IdentifiedTipOption,
    JsonOption,
    OwnFramesOption,
    PayloadOption,
    ResultArgument,
    frame_of,
    joints_of,
    numbers_of,
    out_file,
    payload_of,
)
from truearm.cli.output import print_json, print_result
from truearm.correct.joint_moves import JointMoves
from truearm.correct.methods import Method, methods_help, with_steps
from truearm.errors import InputError
from truearm.exit_codes import ExitCode

if TYPE_CHECKING:
    from truearm.model.poses import Six

MOST_STEPS = 50


def correct(
    result: ResultArgument,
    targets: Annotated[
        Path,
        typer.Argument(
            metavar="TARGETS",
            help="Targets (.csv), a program or a folder of programs: RAPID (.mod, .prg, .sys …), URScript (.script), KRL (.src with .dat), Fanuc (.ls).",
        ),
    ],
    out: Annotated[Path, out_file("the corrected table or program; of a folder, a new folder with every program file")],
    robot: IdentifiedRobotOption = None,
    base: IdentifiedBaseOption = None,
    tip: IdentifiedTipOption = None,
    method: Annotated[Method, typer.Option(help=methods_help())] = Method.NEWTON,
    steps: Annotated[
        int, typer.Option(min=1, max=MOST_STEPS, metavar="N", help=f"Number of steps of {' or '.join(with_steps())}.")
    ] = 1,
    own_frames: OwnFramesOption = False,
    payload: PayloadOption = None,
    work: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[NAME=]X,Y,Z,RX,RY,RZ",
            help="Frame of the targets in the calibration's base frame [mm; rotation vector in deg]; for a program, the pose of the controller's base (RAPID: its world frame) in the calibration's base frame. NAME=…: a work object that the "
            "program does not declare. Repeatable.",
        ),
    ] = None,
    tool: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[NAME=]X,Y,Z,RX,RY,RZ",
            help="Pose of the tool in the end frame [mm; rotation vector in deg]; for a URScript, the tool that is in use until it sets one. NAME=…: a tool that a RAPID "
            "program does not declare. Repeatable.",
        ),
    ] = None,
    flange: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y,Z,RX,RY,RZ",
            help="The controller's flange in the end frame of the calibration [mm; rotation vector in deg]. Needed if truearm does not know that frame by its name, as it knows tool0.",
        ),
    ] = None,
    joint_moves: Annotated[
        JointMoves | None,
        typer.Option(
            help="Moves of a program to joint values: keep them or correct them too. Needed if the program has any."
        ),
    ] = None,
    partial: Annotated[
        bool,
        typer.Option(
            "--partial", help="Correct the other moves of a program if some cannot be corrected; the exit code is 4."
        ),
    ] = False,
    mark: Annotated[
        bool, typer.Option("--mark", help="With --partial: mark each move that is not corrected with a comment.")
    ] = False,
    strict: Annotated[
        bool,
        typer.Option(
            "--strict",
            help="Routines in none of the files may displace the program and change its data, so refuse what depends on that.",
        ),
    ] = False,
    unchanged: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="Tool, work object, target or other datum that nothing outside these files changes, or external axis (eax_a) that does not move the robot. Repeatable.",
        ),
    ] = None,
    split: Annotated[bool, typer.Option("--split", hidden=True)] = False,
    harmless: Annotated[list[str] | None, typer.Option(hidden=True)] = None,
    home: Annotated[
        str | None,
        typer.Option(
            metavar="Q1,Q2,...",
            help="Joints near those of the first target [deg, mm]. Needed if nothing else determines the configuration of the arm.",
        ),
    ] = None,
    residuals: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write the error of every target before and after as a table (.csv)."),
    ] = None,
    report: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write a report (.html): shifts, expected errors, margins, straight moves."),
    ] = None,
    allow_unusable: AllowUnusableOption = False,
    force: Annotated[
        bool,
        typer.Option(
            "--force", help="Overwrite a corrected table that truearm wrote. A corrected program never replaces a file."
        ),
    ] = False,
    as_json: JsonOption = False,
    margin: Annotated[
        float,
        typer.Option(
            min=1e-4,
            max=1.0,
            metavar="SIGMA",
            help="Refuse targets near a singularity, where the Jacobian's smallest singular value is below SIGMA (lengths in units of 0.5 m).",
        ),
    ] = 0.05,
) -> None:
    """Correct targets so that the real robot reaches them.

    In a program, only the numbers of targets change. Numbers change only if every use of every name that leads to them is the target of a corrected move; other moves get numbers of their own.
    If a move cannot be corrected with certainty, nothing is written, and each such move is listed with its line and the reason.

    \b
    Examples:
      truearm correct result.json program.mod --own-frames --out corrected.mod
      truearm correct result.json cell/ --own-frames --out corrected/
    """
    from truearm.cli.correct_text import lines, refused_lines
    from truearm.files.robot_file import RobotChoice
    from truearm.text import one_line
    from truearm.workflows.calibration import read_usable
    from truearm.workflows.correct import CorrectFiles, CorrectOptions, correct_file
    from truearm.workflows.correct_program import ProgramOptions, ProgramRefused
    from truearm.workflows.correction_findings import refusal_of

    if split:
        raise InputError("--split: moves that need different numbers of one target always get their own; leave it out")
    if harmless:
        raise InputError(
            "--harmless: routines in none of the files are taken to be harmless, unless --strict is given; for data or an axis that nothing outside changes, give --unchanged NAME"
        )
    if mark and not partial:
        raise InputError("--mark needs --partial: it marks what --partial leaves uncorrected")
    shown = numbers_of("--home", home)
    works, tools = _named("--work", work), _named("--tool", tool)
    own_work, own_tool = works.pop("", None), tools.pop("", None)
    program = ProgramOptions(
        joint_moves=joint_moves,
        strict=strict,
        partial=partial,
        mark=mark,
        base=own_work,
        flange=None if flange is None else frame_of("--flange", flange),
        tool=own_tool,
        tools=tools,
        works=works,
        unchanged=frozenset(unchanged or ()),
    )
    files = CorrectFiles(result, RobotChoice(robot, base, tip), targets, out, residuals, report, force)
    calibration = read_usable(files.result, files.robot, allow_unusable).carrying(*payload_of(payload))
    options = CorrectOptions(
        method=method,
        steps=steps,
        own_frames=own_frames,
        margin=margin,
        work=own_work or frame_of("--work", None),
        tool=own_tool or frame_of("--tool", None),
        home=joints_of("--home", shown, calibration.joint_units),
        program=program,
        document=as_json,
    )
    try:
        found = correct_file(calibration, files, options)
    except ProgramRefused as exc:
        if as_json:
            print_json(refusal_of(calibration, exc.refused))
        for line in refused_lines(exc.refused):
            typer.echo(line, err=True)
        raise
    further = [f"Written: {one_line(str(path))}" for path in (residuals, report) if path is not None]
    print_result(found.document, [*lines(found), *further], as_json)
    if found.refused:
        raise typer.Exit(ExitCode.INCOMPLETE)


def _named(option: str, given: list[str] | None) -> dict[str, Six]:
    """Return poses by name, "" for one without a name. Raises InputError."""
    found: dict[str, Six] = {}
    for text in given or ():
        name, equals, pose = text.rpartition("=")
        if equals and not name.isidentifier():
            raise InputError(
                f"{option} {text[:60]}: {name[:40]!r} is not a name of a tool or work object; use letters, digits and _"
            )
        if name.lower() in found:
            raise InputError(f"{option} {text[:60]}: is given twice; give it once")
        found[name.lower()] = frame_of(option, pose)
    return found
