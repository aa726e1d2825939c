"""The systematic errors in result.json and in the document of a validation (docs/reference/result-format.md)."""

from __future__ import annotations

import math
import os
from typing import Any, assert_never

import numpy as np

from truearm.files.strict_json import number_or_null, shown_or_null
from truearm.results import DriftWith, SystematicError, SystematicErrors
from truearm.types import ObservationTable


def systematic_entries(found: SystematicErrors | None, table: ObservationTable) -> dict[str, Any]:
    """Return the fields ``systematic`` and ``without_systematic`` for systematic errors found in the table's rows."""
    if found is None:
        return {"systematic": [], "without_systematic": None}
    would_be = {
        "chi2_reduced": number_or_null(found.chi2_reduced),
        "tool_moves_mm": shown_or_null(found.moves, "m"),
        "held_out_ratio": number_or_null(found.held_out_ratio),
    }
    return {"systematic": [_systematic(one, table) for one in found.found], "without_systematic": would_be}


def _systematic(found: SystematicError, table: ObservationTable) -> dict[str, Any]:
    """Return one systematic error; rows count from 1, the last one included."""
    (first, last), effect = found.rows, found.effect
    return {
        "what": None if effect is None else effect.what,
        "form": found.form.value,
        "rows": [first + 1, last],
        "first_within": [row + 1 for row in found.within[0]],
        "last_within": list(found.within[1]),
        "from": source_name(table, first),
        "to": source_name(table, last - 1),
        "unit": found.unit or None,
        "size": number_or_null(found.size),
        "sigma": number_or_null(found.sigma),
        **_over(found, table),
        "off_by": [
            {**of._asdict(), "value": number_or_null(of.value), "sigma": number_or_null(of.sigma)}
            for of in found.off_by
        ],
        "chi2_drop": number_or_null(found.drop),
        "freedom": found.freedom,
        "chance": number_or_null(found.chance),
        "rivals": list(found.rivals),
        "apply": {"leave_out": f"{first + 1}:{last}"} if effect is None else {"allow": str(effect)},
    }


def _over(found: SystematicError, table: ObservationTable) -> dict[str, Any]:
    """Return the quantity in which a drift is linear and its change over the rows: ``over_s`` or ``over_degc``."""
    drift, rows = None if found.effect is None else found.effect.drifts_with, slice(*found.rows)
    match drift:
        case None | DriftWith.DIRECTION | DriftWith.MOVE:
            seconds, degrees = math.nan, math.nan
        case DriftWith.TIME:
            seconds, degrees = float(np.ptp(table.time[rows])), math.nan
        case DriftWith.TEMPERATURE:
            seconds, degrees = math.nan, float(np.ptp(table.temperature[rows]))
        case never:
            assert_never(never)
    return {
        "drifts_with": drift and drift.value,
        "over_s": number_or_null(seconds),
        "over_degc": number_or_null(degrees),
    }


def source_name(table: ObservationTable, row: int) -> str:
    """Return the source of a row, without the folder, as in ``input_of``."""
    return os.path.basename(str(table.source[row]))
