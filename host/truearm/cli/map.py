"""``truearm map``: map the robot's error over its workspace."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from truearm.cli.command import Answer, command
from truearm.cli.options import joints_of
from truearm.errors import InputError
from truearm.workflows.requests import MapFiles, Section

if TYPE_CHECKING:
    from truearm.types import Payload


@command(title="map")
def map_(files: MapFiles, *, section: Section, payload: Payload | None = None, allow_unusable: bool = False) -> Answer:
    """Map the error of the uncalibrated robot over a section of its workspace, with the uncertainty of the map.

    Example:
      truearm map result.json --picture-out map.svg --task 300x200 --within 300:900,0:800

    Options
    -------
    out : FILE
        File to write: the cells as a table (.csv).
    picture_out : FILE
        Write the map as a picture (.svg).
    report : FILE
        Write a report (.html): the errors, the picture, and the arm with the cells in 3-D.
    vary : I,J
        The two joints that span the section; their axes must be parallel. Default: 2,3.
    at : Q1,Q2,...
        Values of all joints [deg, mm]; of those of --vary, only the configuration of the elbow matters. Default: the middle of the
        measured readings, and the map ends where these end.
    cell_mm : MM
        Size of a cell.
    task : WxH
        Find the best place for a task of this size [mm].

    Expert options
    --------------
    within : U0:U1,V0:V1
        Range of the search for --task, along the section's axes [mm]. Default: the whole section.
    """
    from truearm.workflows.calibration import read_usable
    from truearm.workflows.map import map_files

    if section.task is None and section.within is not None:
        raise InputError("needs-option", place="--within", needed="--task WxH")
    calibration = read_usable(files.result, files.robot, allow_unusable, payload)
    return Answer(map_files(calibration, files, replace(section, at=joints_of(section.at, calibration.chain))))
