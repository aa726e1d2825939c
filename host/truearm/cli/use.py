"""Use: corrected targets and programs, and the robot for other programs."""

from __future__ import annotations

from dataclasses import replace

import click

from truearm.cli.command import Answer, command
from truearm.cli.options import joints_of
from truearm.cli.output import print_lines
from truearm.correct.methods import methods_help, with_steps
from truearm.errors import ExitCode, InputError
from truearm.export.formats import formats_help
from truearm.findings import entries
from truearm.workflows.requests import CorrectFiles, CorrectOptions, ExportFiles


@command(methods=methods_help(), stepped=" or ".join(with_steps()))
def correct(files: CorrectFiles, *, options: CorrectOptions, details: bool = False, json: bool = False) -> Answer:
    """Correct targets so that the real robot reaches them.

    In a program, only the numbers of targets change. Numbers change only if every use of every name that leads to them
    is the target of a corrected move; other moves get numbers of their own. If a move cannot be corrected with
    certainty, nothing is written, and each such move is listed with its line and the reason.

    Examples:
      truearm correct result.json program.mod --own-frames --out corrected.mod
      truearm correct result.json cell/ --own-frames --out corrected/

    Arguments
    ---------
    targets : TARGETS
        Targets (.csv), a program or a folder of programs: RAPID (.mod, .prg, .sys …), URScript (.script), KRL (.src
        with .dat), Fanuc (.ls).

    Options
    -------
    out : FILE
        File to write: the corrected table or program; of a folder, a new folder with every program file.
    work : [NAME=]X,Y,Z,RX,RY,RZ
        Frame of the targets in the calibration's base frame [mm; rotation vector in deg]; for a program, the pose of
        the controller's base (RAPID: its world frame) in the calibration's base frame. NAME=…: a work object that the
        program does not declare. Repeatable.
    tool : [NAME=]X,Y,Z,RX,RY,RZ
        Pose of the tool in the end frame [mm; rotation vector in deg]; for a URScript, the tool that is in use until it
        sets one. NAME=…: a tool that a RAPID program does not declare. Repeatable.
    joint_moves
        Moves of a program to joint values: keep them or correct them too. Needed if the program has any.
    partial
        Correct the other moves of a program if some cannot be corrected; the exit code is 4.
    report : FILE
        Write a report (.html): shifts, expected errors, margins, straight moves.
    details
        Print every note and the errors of the first targets.

    Expert options
    --------------
    method
        {methods}
    steps : N
        Number of steps of {stepped}.
    flange : X,Y,Z,RX,RY,RZ
        The controller's flange in the end frame of the calibration [mm; rotation vector in deg]. Needed if truearm does
        not know that frame by its name, as it knows tool0.
    mark
        With --partial: mark each move that is not corrected with a comment.
    strict
        Routines in none of the files may displace the program and change its data, so refuse what depends on that.
    unchanged : NAME
        Tool, work object, target or other datum that nothing outside these files changes, or external axis (eax_a) that
        does not move the robot. Repeatable. It does not revoke --strict.
    home : Q1,Q2,...
        Joints near those of the first target [deg, mm]. Needed if nothing else determines the configuration of the arm.
    force
        Overwrite a corrected table that truearm wrote. A corrected program never replaces a file.
    margin : SIGMA
        Refuse targets near a singularity, where the Jacobian's smallest singular value is below SIGMA (lengths in units
        of 0.5 m).
    """
    from truearm.cli.details import correction_tables, refused_lines
    from truearm.workflows.calibration import read_usable
    from truearm.workflows.correct import correct_file

    if options.program.mark and not options.program.partial:
        raise InputError("needs-option", place="--mark", needed="--partial")
    calibration = read_usable(files)
    home = joints_of(options.home, calibration.chain)
    try:
        document = correct_file(calibration, files, replace(options, home=home, document=details or json))
    except InputError as exc:
        for line in refused_lines(exc.finding.values.get("refused", ())):
            click.echo(line, err=True)
        raise
    if not json:
        print_lines(refused_lines(document["refused"]))
    end = ExitCode.INCOMPLETE if document["refused"] else ExitCode.DONE
    return Answer(
        document, tables=correction_tables(document) if details else (), written=(files.out, files.report), end=end
    )


@command(formats=formats_help())
def export(files: ExportFiles) -> Answer:
    """Write a calibrated robot for other programs.

    If the format has no place for a parameter, or --adjust excludes it, the other parameters are refitted to
    compensate. The remaining error is printed.

    Example:
      truearm export result.json --format urdf --model panda.urdf --out calibrated.urdf

    Options
    -------
    format
        {formats}
    out : FILE
        File to write: the robot.
    adjust : PATTERN
        Change only parameters that match, such as 'joint*.offset'; all others stay nominal (repeatable).
    curves_out : FILE
        Write the joints' error curves too (.csv): reading, error, sigma, and whether the calibration covered the
        reading.

    Expert options
    --------------
    over : FILE
        Poses over which to refit: a table or a plan (.csv). Default: random poses within the joint limits, or within
        the fitted readings if the result has joint laws.
    """
    from truearm.workflows.export import export_file

    exported = export_file(files)
    written = [path for path in (files.out, files.curves_out) if path is not None]
    document = {"format": files.format, "findings": entries(exported.findings), "written": list(map(str, written))}
    return Answer(document)
