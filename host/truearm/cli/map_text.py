"""What ``truearm map`` prints."""

from __future__ import annotations

from typing import Any

import numpy as np

from truearm.correct.error_map import BestRectangle, ErrorMap
from truearm.results import Figures
from truearm.text import counted
from truearm.units import MM
from truearm.workflows.map import Mapped, axis


def lines(mapped: Mapped, cell: float, task: str | None, within: bool = False) -> list[str]:
    """Return the errors over the section, and the best place for a task (the option's text), sought in all of it or
    ``within`` a part; ``cell`` [m]."""
    found = mapped.map
    error = MM.of(found.error[~np.isnan(found.error)])
    rms = Figures.of(error).rms
    sigma = MM.of(found.sigma[np.isfinite(found.sigma)])
    frames = f", relative to {' and '.join(mapped.relative_to)}" if mapped.relative_to else ""
    after = f"; with it {sigma.min():.3f} to {sigma.max():.3f} mm (standard deviation{frames})" if sigma.size else ""
    text = [
        f"{counted(error.size, 'cell')} of {MM.text(cell)}: error without calibration {error.min():.3f} to "
        f"{error.max():.3f} mm, RMS {rms:.3f} mm{after}."
    ]
    if sigma.size < error.size:
        which = "all" if not sigma.size else f"{error.size - sigma.size} of {error.size}"
        text += [f"Error with calibration: unknown in {which} cells.", *mapped.undetermined]
    if outside := _outside(found):
        text.append(
            f"In {counted(outside, 'cell')} a joint is outside the readings that the calibration was identified from "
            '("covered" is 0 in the table; pale in the picture).'
        )
        if mapped.outside:
            text.append(
                f"Outside in every cell: {' and '.join(mapped.outside)}. Give other readings with --at, or the other --elbow, or neither."
            )
    if mapped.payload:
        text.append(mapped.payload)
    if task:
        text.append(_task_line(found, mapped.region, task, within))
    return text


def _outside(found: ErrorMap) -> int | None:
    """Return the number of reachable cells outside the fitted readings, None if unknown."""
    return None if found.outside is None else int((found.outside & ~np.isnan(found.error)).sum())


def _task_line(found: ErrorMap, region: BestRectangle | None, task: str, within: bool) -> str:
    if region is None:
        larger = "or a larger --within" if within else "or another section with --at"
        return f"A task of {task} mm fits nowhere in the part of this section that the arm reaches: give a smaller task, {larger}."
    u, v = (tuple(round(MM.of(value)) for value in span) for span in (region.u, region.v))
    names = [axis(direction) for direction in found.axes]
    return (
        f"Best place for a task of {task} mm: {names[0]} {u[0]} to {u[1]}, {names[1]} {v[0]} to {v[1]} mm; error at most "
        f"{MM.text(region.largest, '.3f')}, RMS {MM.text(region.rms, '.3f')}."
    )


def document(mapped: Mapped, cell: float) -> dict[str, Any]:
    """The same as JSON; ``cell`` [m]. ``sigma_unknown_cells``: where combinations of parameters that were not seen move the end."""
    found = mapped.map
    error, sigma = MM.of(found.error[~np.isnan(found.error)]), MM.of(found.sigma[np.isfinite(found.sigma)])
    region = mapped.region
    return {
        "cell_mm": MM.of(cell),
        "axes": [axis(direction) for direction in found.axes],
        "cells": error.size,
        "error_min_mm": error.min(),
        "error_max_mm": error.max(),
        "error_rms_mm": Figures.of(error).rms,
        "sigma_min_mm": sigma.min() if sigma.size else None,
        "sigma_max_mm": sigma.max() if sigma.size else None,
        "sigma_unknown_cells": error.size - sigma.size,
        "outside_cells": _outside(found),
        "payload": mapped.payload or None,
        "best_region": None
        if region is None
        else {
            "u_mm": [MM.of(end) for end in region.u],
            "v_mm": [MM.of(end) for end in region.v],
            "error_max_mm": MM.of(region.largest),
            "error_rms_mm": MM.of(region.rms),
        },
    }
