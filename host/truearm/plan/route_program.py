"""A route as a program: CSV for any controller, URScript (``urscript``), RAPID (``rapid``).

Every move but the first, which starts anywhere and is slow, is straight in joint space and takes the seconds of the route, so
that neither a joint nor the bar goes faster than planned. At a pose the program says "at rest" on an output, waits for the
dwell, and takes the word back before it moves on. A line is driven straight in space, at the speed planned, with the output on
from its one end to the other. With an ``input`` it also waits until the box has answered, at most TIMEOUT, and until the
answer is gone. Before it leaves a pairing or a line it stops until the bar or the device is off, and at the next one until it is on.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

from truearm.errors import PlanError
from truearm.plan.route_rapid import rapid
from truearm.plan.route_urscript import urscript
from truearm.plan.stops import Stop, Task
from truearm.units import MM_S

N_AXES = 6
DIALECTS = {".csv": "stops", ".script": "URScript", ".mod": "RAPID"}


def program(stops: Sequence[Stop], suffix: str, task: Task) -> str:
    """The text for a file's suffix, one of DIALECTS. Raises PlanError for another one, and for an arm of other than six joints."""
    check_suffix(suffix)
    if suffix != ".csv" and len(stops[0].q) != N_AXES:
        raise PlanError(f"{DIALECTS[suffix]} programs have six joints, the robot has {len(stops[0].q)}; use .csv")
    makers: dict[str, Callable[[Sequence[Stop], Task], str]] = {".csv": csv_text, ".script": urscript, ".mod": rapid}
    return makers[suffix](stops, task)


def check_suffix(suffix: str) -> None:
    """Raise PlanError for a suffix that is none of DIALECTS."""
    if suffix not in DIALECTS:
        known = ", ".join(f"{end} ({what})" for end, what in DIALECTS.items())
        raise PlanError(f"no program is written as {suffix or 'a file without suffix'!r}; use {known}")


def csv_text(stops: Sequence[Stop], task: Task) -> str:
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
