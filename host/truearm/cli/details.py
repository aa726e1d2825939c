"""The tables of ``--details``: of a plan, a session and a correction, from the documents that ``--json`` prints.

So what is printed and what is stored cannot differ.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from truearm.findings import Reason, option
from truearm.report.result_tables import direction_text
from truearm.report.tables import Table
from truearm.text import counted, one_line
from truearm.types import BAR_MOUNTED, MOUNTING, rms_of_columns
from truearm.units import MM_S, ONE, UM, UNITS, URAD, Scale

Document = Mapping[str, Any]

PLANNED_LINES = ("line", "from/mm ", "to/mm ", "rotation_rad ", "expected error/mm")
HOLD_OUTS = ("can be held out", "poses", "rank of the fitted", "none left with ")
CURVES = ("error curve", "sigma/mrad", "in ranges/deg ", "not determined/deg ")


def plan_tables(document: Document) -> Iterator[Table | str]:
    """Return lines or pairings, what can be held out, the predicted sigmas, combinations, error curves."""
    if "parameters" not in document:  # a plan of approaches, which predicts none
        return
    if "lines" in document:
        yield Table(PLANNED_LINES, map(_planned_line, document["lines"]))
    else:
        pairings = (([row[key] for key in BAR_MOUNTED], row["poses"]) for row in document["pairings"])
        yield Table(("pairing", "poses"), ((" ".join(names), poses) for names, poses in pairings))
        if document["hold_outs"]:
            yield Table(HOLD_OUTS, map(_hold_out, document["hold_outs"]))
    yield Table(("parameter", "predicted sigma "), map(_sigma, document["parameters"]))
    if document["null_space"] or document["hardly_seen"]:
        yield "Combinations of parameters, with weights in m, rad and 1:"
    for key, words in (("null_space", "unidentifiable"), ("hardly_seen", "weakly identifiable")):
        yield from (f"{words}: {direction_text(direction.values(), direction)}" for direction in document[key])
    if document.get("curves"):
        yield Table(CURVES, map(_curve, document["curves"]))
        yield "Outside these ranges, corrections use geometry and sag alone. Curves and sag add to the other sigmas."


def _planned_line(row: Document) -> tuple[str, ...]:
    ends = [", ".join(f"{v:.0f}" for v in row[end]) for end in ("from_mm", "to_mm")]
    return row["line"], *ends, ", ".join(f"{v:.4f}" for v in row["rotation_rad"]), f"{row['a_priori_mm']:.1f}"


def _hold_out(row: Document) -> tuple[object, ...]:
    seed = f" --seed {row['seed']}" * (row["seed"] > 0)
    lost_names = [name for name in row["all_held_out"] if name != row["hold_out"]]
    return f"--hold-out {row['hold_out']}{seed}", row["poses"], row["rank"], ", ".join(lost_names) or "-"


def _sigma(parameter: Document) -> tuple[str, str]:
    name, unit, sigma = (parameter[key] for key in ("name", "unit", "sigma"))
    return name, "unidentifiable" if sigma is None else f"± {UNITS[unit].scale.text(sigma, '.2g')}"


def _curve(curve: Document) -> tuple[str, ...]:
    ranges = [
        f"{row['lower_deg']:.0f} to {row['upper_deg']:.0f} (± {row['sigma_mrad']:.2g})" for row in curve["ranges"]
    ]
    gaps = ", ".join(f"{low:.0f} to {high:.0f}" for low, high in curve["unseen_deg"])
    return curve["joint"], f"± {curve['sigma_mrad']:.2g}", ", ".join(ranges), gaps or "-"


Rows = Sequence[Mapping[str, Any]]

MOST_ROWS = 24  # of a table of dwells or passes
STREAMS = ("stream", "channels ", "samples", "nominal/Hz", "by box/Hz", "by host/Hz", "pieces")
DWELLS = ("dwell", "robot time/s", "settling/s", "used/s", "pose", "mounted ", "rejected ")
PASSES = ("pass", "robot time/s", "mm/s", "points", "noise x, y, z/µm", "joints/µrad", "line ", "rejected ")


def session_tables(document: Mapping[str, Any]) -> Iterator[Table | str]:
    """Return streams, the box's text, dwells and passes.

    Names from the file have their control characters made visible; console text has so already.
    """
    if document["streams"]:
        yield Table(STREAMS, map(_stream, document["streams"]))
    runs = document["console"]
    yield from (f"  | {line}" for run in runs for line in run.splitlines())
    if document["losses"]["console_runs"] > len(runs):
        yield f"  | … {document['losses']['console_runs'] - len(runs)} more"
    for titles, make, rows in (
        (DWELLS, _dwell, document["dwells"]["table"]),
        (PASSES, _pass, document["passes"]["table"]),
    ):
        shown = rows if len(rows) <= MOST_ROWS else [row for row in rows if row["reason"] not in ("", MOUNTING)]
        if shown:
            yield Table(titles, map(make, shown[:MOST_ROWS]))
        if len(shown) > MOST_ROWS:
            yield f"… {len(shown) - MOST_ROWS} more; --json has all"


def _stream(stream: Mapping[str, Any]) -> tuple[object, ...]:
    rates = (_number(stream[f"rate_{name}_hz"], ".4f") for name in ("nominal", "measured", "by_host"))
    name, channels = one_line(stream["name"]), one_line(", ".join(stream["channels"]))
    return name, channels, stream["samples"], *rates, stream["pieces"]


def _dwell(row: Mapping[str, Any]) -> tuple[object, ...]:
    mounted = " ".join(row[key] for key in BAR_MOUNTED).strip()
    times = f"{row['t_robot_s']:.1f}", f"{row['settling_s']:.2f}", f"{row['used_s']:.2f}"
    reason = f"{row['reason']}: {row['detail']}" if row["detail"] else row["reason"]
    return row["dwell"], *times, "-" if row["pose"] is None else row["pose"], one_line(mounted) or "-", one_line(reason)


def _pass(row: Mapping[str, Any]) -> tuple[object, ...]:
    noise = " ".join(_number(value, ".1f", UM) for value in row["noise_m"])
    joints = _number(max(row["joint_noise"], default=None), ".1f", URAD)
    direction = {1: ", y increases", -1: ", y decreases"}.get(row["direction"], "")
    dropped = (f"{counted(count, 'point')} not made: {reason}" for reason, count in row["dropped"].items())
    figures = f"{row['t_robot_s']:.1f}", _number(row["speed_m_s"], ".1f", MM_S), row["points"], noise, joints
    return row["pass"], *figures, one_line(row["line"]) + direction, ", ".join(filter(None, (row["reason"], *dropped)))


def _number(value: float | None, form: str, scale: Scale = ONE) -> str:
    return "-" if value is None else format(scale.of(value), form)


MOST_REFUSED = 30  # shown one by one


def correction_tables(document: Document) -> Iterator[Table | str]:
    """Return the errors of the first targets, and their RMS."""
    from truearm.workflows.correct import SHOWN

    targets = document["targets"]
    columns = [f"error_{time}_{unit}" for unit in ("mm", "deg") for time in ("before", "after")]
    errors = np.array([[target[column] for column in columns] for target in targets], dtype=float)
    rows = [(target["place"].partition(" ")[2], *row) for target, row in zip(targets, errors, strict=False)][:SHOWN]
    titles = ("target", "before [mm]", "after [mm]", "before [deg]", "after [deg]")
    yield Table(titles, map(_error_cells, [*rows, ("RMS", *rms_of_columns(errors))]))
    if len(targets) > SHOWN:
        yield f"RMS over these and {len(targets) - SHOWN} more"


def _error_cells(row: Sequence[Any]) -> tuple[str, ...]:
    place, *errors = row
    digits = ".4f", ".4f", ".5f", ".5f"
    return place, *("-" if math.isnan(error) else f"{error:{form}}" for error, form in zip(errors, digits, strict=True))


def refused_lines(refused: Sequence[Document]) -> list[str]:
    """Return the statements of a program that move or may move the robot and are not corrected, their number first."""
    if not refused:
        return []
    rows = [
        f"  {one_line(move['file'])} line {move['line']}: {one_line(move['statement'])}: "
        f"{Reason(move['reason'], move['values']).text(option)}"
        for move in refused[:MOST_REFUSED]
    ]
    hidden_moves = [f"  and {counted(len(refused) - MOST_REFUSED, 'more move')}"] * (len(refused) > MOST_REFUSED)
    return [f"{counted(len(refused), 'move')} not corrected:", *rows, *hidden_moves]
