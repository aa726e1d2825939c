"""Map the error over a section of the workspace (``truearm map``): table, picture and best region."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from truearm.correct.correction import ModelPair
from truearm.correct.error_map import BestRectangle, ErrorMap, best_region, error_map
from truearm.disk import check_outputs, write_atomic
from truearm.errors import Argument, InputError
from truearm.findings import Finding, entries, ordered
from truearm.kinds.csv_cells import csv_text
from truearm.progress import step
from truearm.report.page import html_page, scrolled
from truearm.report.page import section as page_section
from truearm.report.svg import Cells, map_picture
from truearm.results import Figures
from truearm.text import one_line
from truearm.types import CurveKnots, Floats
from truearm.units import MM, key, number
from truearm.workflows.calibration import Calibration, check_joints, chosen_mountings, undetermined, unseen_within
from truearm.workflows.requests import MapFiles, Section
from truearm.workflows.scene import map_scene

SOME = 12  # cells at which the reason for an unknown error is sought


@step("mapping the errors")
def map_files(calibration: Calibration, files: MapFiles, section: Section) -> dict[str, Any]:
    """Make a map by the calibration of ``files.result``, write the requested files, and return its axes and findings.

    Raises InputError with a one-line message.
    """
    outputs = [("map", files.out), ("picture", files.picture_out), ("page", files.report)]
    check_outputs(outputs, files.force, [files.result, *files.robot.files])
    grid = mapped(calibration, section)
    region = None if section.task is None else best_region(grid, *section.task, section.within)
    findings = map_findings(calibration, section, grid, region)
    if files.out is not None:
        write_atomic(files.out, _table(grid, calibration))
    if files.picture_out is not None:
        write_atomic(files.picture_out, _picture(grid, region, calibration))
    if files.report is not None:
        write_atomic(files.report, _page(calibration, section, grid, region, findings))
    best_place = region and {
        name: [MM.of(end) for end in span] for name, span in (("u_mm", region.u), ("v_mm", region.v))
    }
    written = [str(path) for _, path in outputs if path is not None]
    axes = [axis(direction) for direction in grid.axes]
    return {"axes": axes, "best_region": best_place, "findings": entries(findings), "written": written}


def _pair(calibration: Calibration, own_frames: bool) -> ModelPair:
    mountings = chosen_mountings(calibration, own_frames)
    return ModelPair(calibration.chain, calibration.nominal, calibration.identified, mountings)


def mapped(calibration: Calibration, section: Section) -> ErrorMap:
    """Return the map of a section. Raises InputError for joints that the robot does not have or cannot reach."""
    pair, chain = _pair(calibration, section.own_frames), calibration.chain
    q, readings = check_joints("at", section.at, calibration.chain), calibration.stored.joint_range
    a, b = section.joints
    if q is None:
        q = np.zeros(len(chain.joints)) if readings is None else np.mean([readings.lower, readings.upper], axis=0)
        for law in calibration.stored.laws:
            if isinstance(law, CurveKnots) and readings is not None:  # of the readings, the middle may be a gap
                tried = np.linspace(readings.lower[law.joint], readings.upper[law.joint], 721)
                seen = tried[law.covers(tried)]
                q[law.joint] = seen[np.argmin(np.abs(seen - q[law.joint]))] if seen.size else q[law.joint]
        q[min(a, b) : max(a, b) - 1] = 0.0  # between the two: elsewhere their axes may not be parallel
    if min(a, b) < 1 or max(a, b) > q.size or a == b:
        raise InputError(Argument("joints"), f" {a},{b}: must be two joints between 1 and {q.size}")
    varied = a - 1, b - 1
    for i, joint in enumerate(chain.joints):
        if section.at and i not in varied and not joint.lower <= q[i] <= joint.upper:
            raise InputError(Argument("at"), f": joint {i + 1} would be outside its limits; give a reading within them")
    unseen = unseen_within(calibration)[0]
    grid = error_map(pair, q, varied, section.cell, calibration.covariance, unseen)
    outside = calibration.outside(grid.q.reshape(-1, q.size))
    if outside is None:
        return grid
    grid = replace(grid, outside=np.any(outside, axis=1).reshape(*grid.error.shape))
    return _within_readings(grid) if section.at is None else grid


def _within_readings(grid: ErrorMap) -> ErrorMap:
    """Return the part of a map whose cells are within the fitted readings; all of it if none is."""
    covered = ~np.isnan(grid.error) & ~np.asarray(grid.outside)
    if not covered.any():
        return grid
    rows, columns = (slice(lines.min(), lines.max() + 1) for lines in np.nonzero(covered))
    cells = {name: getattr(grid, name)[rows, columns] for name in ("q", "point", "error", "sigma", "outside")}
    for name in ("q", "point", "error", "sigma"):
        cells[name][~covered[rows, columns]] = np.nan
    return replace(grid, u=grid.u[columns], v=grid.v[rows], **cells)


def _page(
    calibration: Calibration,
    section: Section,
    grid: ErrorMap,
    region: BestRectangle | None,
    findings: Sequence[Finding],
) -> str:
    """Return the page of a map: its findings, the arm with the cells in 3-D, the picture."""
    scene = map_scene(calibration, _pair(calibration, section.own_frames), grid)
    picture = scrolled(_picture(grid, region, calibration, styled=False), "map")
    blocks = [page_section("The section", f'<figure class="map">{picture}</figure>')]
    title = f"Error of {calibration.chain.name} without calibration"
    return html_page("truearm map", title, "over a section of the workspace", blocks, findings, scene=scene)


def _table(grid: ErrorMap, calibration: Calibration) -> str:
    """Return one row per reachable cell; u, v are the cell's centre, x, y, z the nominal end position.

    ``covered`` is 1 if all joints are near fitted readings, else 0, and empty if the result does not tell. A table of a
    simulated calibration has a column ``simulated``, as a table of observations.
    """
    units = calibration.joint_units
    mark = {"simulated": "yes"} if calibration.simulated else {}
    joints = [key(f"q{i}", unit) for i, unit in enumerate(units, start=1)]
    titles: list[object] = ["u_mm", "v_mm", "x_mm", "y_mm", "z_mm", *joints, "error_mm", "sigma_mm", "covered", *mark]
    rows = [titles]
    for i, j in zip(*np.nonzero(~np.isnan(grid.error)), strict=True):
        place = MM.of(np.array([grid.u[j], grid.v[i], *grid.point[i, j]]))
        q = (number(value, unit, 5) for value, unit in zip(grid.q[i, j], units, strict=True))
        sigma = number(grid.sigma[i, j], "m", 5) if np.isfinite(grid.sigma[i, j]) else ""
        covered = "" if grid.outside is None else int(not grid.outside[i, j])
        error = number(grid.error[i, j], "m", 5)
        rows.append([*(f"{value:.3f}" for value in place), *q, error, sigma, covered, *mark.values()])
    return csv_text(rows)


def _picture(grid: ErrorMap, region: BestRectangle | None, calibration: Calibration, styled: bool = True) -> str:
    task = None if region is None else MM.of(np.array([*region.u, *region.v])).tolist()
    labels = [f"{axis(direction)} [mm]" for direction in grid.axes]
    name = one_line(calibration.chain.name)[:40]
    title = "Simulated: " * calibration.simulated + f"Error of {name} without calibration"
    outside = np.zeros(grid.error.shape, dtype=bool) if grid.outside is None else grid.outside
    cells = Cells(MM.of(grid.u), MM.of(grid.v), MM.of(grid.error), MM.of(grid.sigma), outside)
    return map_picture(cells, title, task, labels, styled)


def axis(direction: Floats) -> str:
    """Return x, y, z for the axes of the base frame, else the direction's components."""
    for i, name in enumerate("xyz"):
        if abs(direction[i]) > 1.0 - 1e-6:
            return ("-" if direction[i] < 0.0 else "") + name
    return "along (" + ", ".join(f"{round(value, 2) + 0.0:.2f}" for value in direction) + ")"


def map_findings(
    calibration: Calibration, section: Section, grid: ErrorMap, region: BestRectangle | None = None
) -> list[Finding]:
    """Return the errors over the section, what limits them, and the best place for a task."""
    reached = ~np.isnan(grid.error)
    error, sigma = grid.error[reached], grid.sigma[np.isfinite(grid.sigma)]
    n_outside = 0 if grid.outside is None else int((grid.outside & reached).sum())
    values = {"least": _mm(error.min()), "most": _mm(error.max()), "rms": _mm(Figures.of(error).rms)}
    findings = [Finding("map-error", {**values, "cells": error.size, "cell": _mm(section.cell)})]
    if section.task is not None:
        findings.append(_task(grid, region, section.task))
    if sigma.size:
        ends = {"least": _mm(sigma.min()), "most": _mm(sigma.max())}
        findings.append(Finding("map-sigma", {**ends, "relative_to": list(unseen_within(calibration)[1])}))
    if sigma.size < error.size:
        findings.append(Finding("map-sigma-unknown", {"n": error.size - sigma.size, "cells": error.size}))
        findings += undetermined(calibration, grid.q[np.isnan(grid.sigma) & reached][:SOME], section.own_frames)
    findings += [Finding("joints-outside", {"n": n_outside})] if n_outside else []
    outside = calibration.outside(grid.q[reached])
    everywhere = np.flatnonzero([] if outside is None else outside.all(axis=0)).tolist()
    if joints := [calibration.chain.joints[joint].name for joint in everywhere]:
        findings.append(Finding("joints-outside", {"joints": joints, "given": section.at is not None}))
    return ordered([*findings, *calibration.payload_findings()], calibration.simulated)


def _task(grid: ErrorMap, region: BestRectangle | None, task: tuple[float, float]) -> Finding:
    size = "x".join(f"{MM.of(side):g}" for side in task)
    if region is None:
        return Finding("task-nowhere", {"task": size})
    names = [axis(direction) for direction in grid.axes]
    spans = [tuple(round(MM.of(end)) for end in span) for span in (region.u, region.v)]
    place = [f"{name} {low} to {high} mm" for name, (low, high) in zip(names, spans, strict=True)]
    return Finding("task-place", {"task": size, "place": place, "most": _mm(region.largest), "rms": _mm(region.rms)})


def _mm(length: float) -> dict[str, float]:
    return {"mm": float(MM.of(length))}
