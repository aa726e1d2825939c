"""``truearm export``: write a calibrated robot for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from truearm.bounds import OneOf
from truearm.cli.command import command
from truearm.cli.options import payload_of
from truearm.cli.output import print_json
from truearm.export.formats import FORMATS, formats_help
from truearm.findings import entries


@command(formats=formats_help())
def export(
    result: Path,
    *,
    format: Annotated[str, OneOf(FORMATS)],
    out: Path,
    model: str | None = None,
    base: str | None = None,
    tip: str | None = None,
    own_frames: bool = False,
    payload: str | None = None,
    adjust: list[str] | None = None,
    over: Path | None = None,
    curves_out: Path | None = None,
    allow_unusable: bool = False,
    force: bool = False,
    json: bool = False,
) -> None:
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
    from truearm.cli.findings_text import show
    from truearm.files.robot_file import RobotChoice
    from truearm.workflows.export import ExportOptions, export_file

    options = ExportOptions(format, own_frames, tuple(adjust or ()), payload_of(payload))
    found = export_file(result, RobotChoice(model, base, tip), out, options, over, curves_out, force, allow_unusable)
    written = [path for path in (out, curves_out) if path is not None]
    if json:
        print_json({"format": format, "findings": entries(found.findings), "written": list(map(str, written))})
    else:
        show(found.findings, written=written, more="")
