"""What ``truearm correct`` prints."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from truearm.findings import option
from truearm.text import counted, one_line
from truearm.types import Floats, rms_of_columns
from truearm.units import DEG, MM
from truearm.workflows.correct import SHOWN, CorrectedFile
from truearm.workflows.correction_findings import Refused

MOST_REFUSED = 30  # shown one by one


def tables(done: CorrectedFile) -> Iterator[str]:
    """Return the errors of the first targets, and their RMS."""
    before, after = done.correction.before, done.correction.after
    yield f"{'target':<10}{'before [mm]':>14}{'after [mm]':>14}{'before [deg]':>14}{'after [deg]':>14}"
    rows = list(zip(done.places, before, after, strict=True))
    yield from (f"{place:<10}{_cells(*errors)}" for place, *errors in rows[:SHOWN])
    if len(rows) > SHOWN:
        yield f"and {len(rows) - SHOWN} more"
    yield f"{'RMS':<10}{_cells(*map(rms_of_columns, (before, after)))}"


def refused_lines(refused: Sequence[Refused]) -> list[str]:
    """Return the statements of a program that move the robot or may move it and are not corrected, their number first."""
    if not refused:
        return []
    rows = [
        f"  {one_line(move.file)} line {move.line}: {one_line(move.statement)}: {move.reason.text(option)}"
        for move in refused[:MOST_REFUSED]
    ]
    more = [f"  and {counted(len(refused) - MOST_REFUSED, 'more move')}"] * (len(refused) > MOST_REFUSED)
    return [f"{counted(len(refused), 'move')} not corrected:", *rows, *more]


def _cells(before: Floats, after: Floats) -> str:
    mm = [f"{MM.of(error[0]):>14.4f}" for error in (before, after)]
    deg = [f"{DEG.of(error[1]):>14.5f}" if math.isfinite(error[1]) else f"{'-':>14}" for error in (before, after)]
    return "".join(mm + deg)
