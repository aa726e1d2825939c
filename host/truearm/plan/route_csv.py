"""A route as a table (CSV), for a controller whose language truearm does not support."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import assert_never

from truearm.plan.route_stops import Stop, Task
from truearm.types import Move
from truearm.units import MM_S


def text(stops: Sequence[Stop], task: Task) -> str:
    """Return every stop as a row, numbered as in the plan file.

    The columns are the action there or on the way, the operator's task, the seconds of the move (empty for a line) and
    of the dwell, the speed of a line, and the joints [rad].
    """
    rows = [["pose", "move", "before", "there", "move_s", "dwell_s", "speed_mm_s"]]
    rows[0] += [f"q{i + 1}_rad" for i in range(len(stops[0].q))]
    for number, stop in enumerate(stops):
        rows.append([str(number), stop.move, stop.before, stop.there, *_pace(stop, task), *map(repr, stop.q.tolist())])
    return csv_of(rows)


def _pace(stop: Stop, task: Task) -> tuple[str, str, str]:
    """Return the seconds of the move, the seconds of the dwell, and the speed of a line [mm/s]."""
    match stop.move:
        case Move.DWELL:
            return f"{stop.seconds:.3f}", f"{task.dwell:g}", ""
        case Move.VIA:
            return f"{stop.seconds:.3f}", "0", ""
        case Move.LINE:
            return "", "0", f"{MM_S.of(stop.speed):g}"
        case _:
            assert_never(stop.move)


def csv_of(rows: Iterable[Iterable[str]]) -> str:
    """Return CSV of cells without commas, quotes or line feeds, as all cells here are."""
    return "".join(",".join(cells) + "\n" for cells in rows)
