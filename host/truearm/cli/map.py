"""``truearm map``: map the robot's error over its workspace."""

from __future__ import annotations

import re
from typing import Annotated

from truearm.bounds import CELL
from truearm.cli.command import Answer, command
from truearm.cli.options import joints_of, numbers_of, payload_of, spans_of
from truearm.errors import InputError
from truearm.findings import entries
from truearm.units import MM
from truearm.workflows.requests import MapFiles


@command()
def map_(
    files: MapFiles,
    *,
    vary: str = "2,3",
    at: str | None = None,
    cell_mm: Annotated[float, CELL, MM] = 25.0,
    task: str | None = None,
    within: str | None = None,
    own_frames: bool = False,
    payload: str | None = None,
    allow_unusable: bool = False,
) -> Answer:
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
        The two joints that span the section; their axes must be parallel.
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
    from truearm.workflows.map import MapTask, Section, axis, map_files, map_findings, write_map_page

    if task is None and within is not None:
        raise InputError("needs-option", place="--within", needed="--task WxH")
    varied, shown = _joints_of(vary), numbers_of("--at", at)
    map_task = None if task is None else MapTask(_size_of(task), None if within is None else _span_of(within))
    calibration = read_usable(files.result, files.robot, allow_unusable).carrying(*payload_of(payload))
    stand = joints_of("--at", shown, calibration.chain)
    section = Section(varied, stand, MM.to_si(cell_mm), own_frames)
    mapped = map_files(calibration, files, section, map_task)
    findings = map_findings(mapped, section.cell, task, calibration.simulated)
    if files.report is not None:
        write_map_page(files.report, findings, mapped, calibration, own_frames)
    written = [path for path in (files.out, files.picture_out, files.report) if path is not None]
    spans = {} if mapped.region is None else {"u_mm": mapped.region.u, "v_mm": mapped.region.v}
    region = {name: [MM.of(end) for end in span] for name, span in spans.items()} or None
    axes = [axis(direction) for direction in mapped.map.axes]
    document = {"axes": axes, "best_region": region, "findings": entries(findings)}
    return Answer({**document, "written": list(map(str, written))}, written=written)


def _joints_of(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"([1-9][0-9]?),([1-9][0-9]?)", text)
    if match is None:
        raise InputError("wrong-value", place="--vary", value=text[:40], form="two joints, such as 2,3")
    return int(match[1]), int(match[2])


def _span_of(text: str) -> tuple[float, float, float, float]:
    """u0, u1, v0, v1 [m]"""
    lower, upper = spans_of("--within", text, MM, 2)
    return lower[0], upper[0], lower[1], upper[1]


def _size_of(text: str) -> tuple[float, float]:
    match = re.fullmatch(r"([0-9]{1,6}(?:\.[0-9]{1,6})?)x([0-9]{1,6}(?:\.[0-9]{1,6})?)", text)
    if match is None or min(float(match[1]), float(match[2])) <= 0.0:
        raise InputError("wrong-value", place="--task", value=text[:40], form="width and height in mm, such as 300x200")
    return MM.to_si(float(match[1])), MM.to_si(float(match[2]))


map_.__name__ = "map"  # the command's name; map itself is a Python builtin
