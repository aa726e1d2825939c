"""What ``truearm export`` prints."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from truearm.results import Figures
from truearm.text import one_line
from truearm.units import DEG, MM
from truearm.workflows.export import ExportedRobot, cost_lines

REMEDY = "For the best fit where you work, give --over FILE, a plan or a table of poses there."


def lines(found: ExportedRobot, written: Sequence[Path], over: Path | None) -> list[str]:
    """The mountings, the error that the refit leaves, and the files; ``over``: what it was refitted over."""
    remedy = [REMEDY] if found.fitted.refitted and over is None else []
    return [*found.mountings, *cost_lines(found), *remedy, *(f"Written: {one_line(str(path))}" for path in written)]


def document(found: ExportedRobot, written: Sequence[Path]) -> dict[str, Any]:
    """The same as JSON: what the format has no place for, whether the rest was refitted, and the errors of position and orientation that are left [mm, deg]."""
    fitted = found.fitted
    left, dropped = (Figures.of(MM.of(error)) for error in (fitted.left, fitted.dropped))
    left_turn, dropped_turn = (Figures.of(DEG.of(error)) for error in (fitted.left_turn, fitted.dropped_turn))
    return {
        "format": found.form,
        "mountings": found.mountings,
        "missing": found.missing,
        "exact": found.exact,
        "refitted": fitted.refitted,
        "poses": fitted.left.size,
        "left_rms_mm": left.rms,
        "left_max_mm": left.max,
        "left_rms_deg": left_turn.rms,
        "left_max_deg": left_turn.max,
        "dropped_rms_mm": dropped.rms,
        "dropped_rms_deg": dropped_turn.rms,
        "written": [str(path) for path in written],
    }
