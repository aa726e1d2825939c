"""The findings of ``truearm map``."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from truearm.correct.error_map import BestRectangle, ErrorMap
from truearm.findings import Finding, ordered
from truearm.results import Figures
from truearm.types import Floats
from truearm.units import MM
from truearm.workflows.map import Mapped, axis


def map_findings(mapped: Mapped, cell: float, task: str | None, simulated: bool = False) -> list[Finding]:
    """Return the errors over the section, what limits them, and the best place for a task (the option's text); ``cell`` [m]."""
    grid = mapped.map
    error, sigma = _known(grid)
    values = {"least": _mm(error.min()), "most": _mm(error.max()), "rms": _mm(Figures.of(error).rms)}
    findings = [Finding("map-error", {**values, "cells": error.size, "cell": _mm(cell)})]
    if task:
        findings.append(_task(grid, mapped.region, task))
    if sigma.size:
        ends = {"least": _mm(sigma.min()), "most": _mm(sigma.max())}
        findings.append(Finding("map-sigma", {**ends, "relative_to": list(mapped.relative_to)}))
    if sigma.size < error.size:
        findings.append(Finding("map-sigma-unknown", {"n": error.size - sigma.size, "cells": error.size}))
    findings += [*mapped.undetermined, *_outside_findings(mapped), *mapped.payload]
    return ordered(findings, simulated)


def _outside_findings(mapped: Mapped) -> Iterator[Finding]:
    if outside := _outside(mapped.map):
        yield Finding("joints-outside", {"n": outside})
    if mapped.outside:
        yield Finding("joints-outside", {"joints": list(mapped.outside)})


def _outside(grid: ErrorMap) -> int | None:
    """Return the number of reachable cells outside the fitted readings, None if unknown."""
    return None if grid.outside is None else int((grid.outside & ~np.isnan(grid.error)).sum())


def _known(grid: ErrorMap) -> tuple[Floats, Floats]:
    """Return the errors of the reachable cells, and the standard deviations that are known [m]."""
    return grid.error[~np.isnan(grid.error)], grid.sigma[np.isfinite(grid.sigma)]


def _task(grid: ErrorMap, region: BestRectangle | None, task: str) -> Finding:
    if region is None:
        return Finding("task-nowhere", {"task": task})
    names = [axis(direction) for direction in grid.axes]
    spans = [tuple(round(MM.of(end)) for end in span) for span in (region.u, region.v)]
    place = [f"{name} {low} to {high} mm" for name, (low, high) in zip(names, spans, strict=True)]
    return Finding("task-place", {"task": task, "place": place, "most": _mm(region.largest), "rms": _mm(region.rms)})


def _mm(length: float) -> dict[str, float]:
    return {"mm": float(MM.of(length))}
