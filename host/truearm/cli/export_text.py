"""The JSON of ``truearm export``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from truearm.findings import entries
from truearm.results import Figures
from truearm.units import DEG, MM
from truearm.workflows.export import ExportedRobot


def document(found: ExportedRobot, written: Sequence[Path]) -> dict[str, Any]:
    """Return the export as JSON: what the format has no place for, whether the rest was refitted, and the errors of position and orientation that are left [mm, deg]."""
    fitted = found.fitted
    left, dropped = (Figures.of(MM.of(error)) for error in (fitted.left, fitted.dropped))
    left_turn, dropped_turn = (Figures.of(DEG.of(error)) for error in (fitted.left_turn, fitted.dropped_turn))
    return {
        "format": found.form,
        "findings": entries(found.findings),
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
