"""``truearm export``: write a calibrated robot for other programs."""

from __future__ import annotations

from truearm.cli.command import Answer, command
from truearm.export.formats import formats_help
from truearm.findings import entries
from truearm.workflows.requests import ExportFiles


@command(formats=formats_help())
def export(files: ExportFiles) -> Answer:
    """Write a calibrated robot for other programs.

    If the format has no place for a parameter, or --adjust excludes it, the other parameters are refitted to compensate. The
    remaining error is printed.

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
