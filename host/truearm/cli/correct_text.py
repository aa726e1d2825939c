"""What ``truearm correct`` prints."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from rich.table import Table

from truearm.cli.findings_text import table_of
from truearm.findings import option
from truearm.text import counted, one_line
from truearm.types import Floats, rms_of_columns
from truearm.units import number
from truearm.workflows.correct import SHOWN, CorrectedFile
from truearm.workflows.correction_findings import Refused

MOST_REFUSED = 30  # shown one by one


def tables(done: CorrectedFile) -> Iterator[Table | str]:
    """Return the errors of the first targets, and their RMS."""
    before, after = done.correction.before, done.correction.after
    names, errors = [*done.places[:SHOWN], "RMS"], [[*of[:SHOWN], rms_of_columns(of)] for of in (before, after)]
    cells = map(_cells, *errors)
    titles = ("target", "before [mm]", "after [mm]", "before [deg]", "after [deg]")
    yield table_of(titles, ((name, *row) for name, row in zip(names, cells, strict=True)))
    if len(done.places) > SHOWN:
        yield f"RMS over these and {len(done.places) - SHOWN} more"


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


def _cells(*errors: Floats) -> list[str]:
    """Return errors of position and orientation without and with the correction."""
    return [*(number(of[0], "m", 4) for of in errors), *(number(of[1], "rad", 5) for of in errors)]
