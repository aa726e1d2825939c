"""A route as a table (CSV), for a controller whose language truearm does not write."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from truearm.plan.route_stops import Stop, Task
from truearm.units import MM_S


def text(stops: Sequence[Stop], task: Task) -> str:
    """Every stop a row, numbered as in the plan file.

    What is done there or on the way, the operator's part, seconds of the move (empty: of a line) and of the rest, a line's
    speed, joints [rad].
    """
    rows = [["pose", "move", "before", "there", "move_s", "dwell_s", "speed_mm_s"]]
    rows[0] += [f"q{i + 1}_rad" for i in range(len(stops[0].q))]
    for number, stop in enumerate(stops):
        rest = f"{task.dwell if stop.move == 'dwell' else 0.0:g}"
        pace = ("", rest, f"{MM_S.of(stop.speed):g}") if stop.move == "line" else (f"{stop.seconds:.3f}", rest, "")
        rows.append([str(number), stop.move, stop.before, stop.there, *pace, *map(repr, stop.q.tolist())])
    return csv_of(rows)


def csv_of(rows: Iterable[Iterable[str]]) -> str:
    """Cells without commas, quotes or line feeds, as all here are, as CSV."""
    return "".join(",".join(cells) + "\n" for cells in rows)
