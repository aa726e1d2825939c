"""The HTML report of a correction: the shifts, the expected error, and what to check before the program runs.

It shows the document of the correction (docs/reference/target-format.md), and the targets in a 3-D view.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from truearm.findings import Reason, findings_of, option
from truearm.report import page, svg
from truearm.report.page import Scene
from truearm.report.tables import Table
from truearm.text import counted, one_line
from truearm.types import Floats, rms, thinned
from truearm.units import MM

Document = Mapping[str, Any]

MOST_ROWS = 400  # of a table; the JSON document has all of them
MOST_ARROWS = 2000
ARROW = 0.06  # of the longer side of the picture: length at which a median shift is drawn
STRAIGHT = 1e-4  # m: a larger deviation from a straight move is a bend
_REFUSED = ("line", "statement", "reason")
_MOVES = ("to", "from", "deviation [mm]", "nearest joint limit", "singular value", "")
_EXPECTED = "by the parameters' covariance and by what the calibration leaves unexplained"


def render(document: Document, scene: Scene | None = None) -> str:
    """Return the page as HTML text, to be written as UTF-8."""
    refused = [
        (f"{move['file']}:{move['line']}", move["statement"], Reason(move["reason"], move["values"]).text(option))
        for move in document["refused"]
    ]
    moves, words = _moves(document), _TARGETS.format(document["error_point"])
    blocks = (
        page.section("Not corrected", page.table(Table(_REFUSED, refused, "statements not corrected")))
        if refused
        else "",
        page.section("Shifts", page.pictures(_pictures(document))),
        page.section("Targets", page.table(_targets(document)), page.paragraph(words)),
        page.section("Straight moves", page.table(Table(_MOVES, moves[:MOST_ROWS], "straight moves", total=len(moves))))
        if moves
        else "",
        page.making("", _facts(document)),
    )
    title, subtitle = f"{one_line(document['file'])} corrected", f"written to {one_line(document['out'])}"
    shown = page.tiles(_tiles(document))
    return page.html_page("truearm correct", title, subtitle, blocks, findings_of(document), figures=shown, scene=scene)


def _facts(document: Document) -> tuple[tuple[str, str], ...]:
    frames = " and ".join(document["expected_relative_to"])
    relative = f", relative to {frames}, whose pose the calibration does not determine" * bool(frames)
    angle = document["unexplained_mrad"]
    unexplained = f"{angle:.3f} mrad" if angle else "no orientation was measured"
    return (
        ("targets", counted(len(document["targets"]), "target")),
        ("robot", f"{document['robot']}, {document['end_frame']} in {document['base_frame']}"),
        ("calibration", one_line(document["result"])),
        ("unexplained by the calibration", f"{document['unexplained_mm']:.3f} mm, {unexplained} (standard deviation)"),
        ("expected error", f"k = 2, covariance and unexplained part{relative}"),
    )


def _column(document: Document, key: str, rows: str = "targets") -> Floats:
    """Return a number of each target, or move; NaN where it is null."""
    return np.array([row[key] for row in document[rows]], dtype=float)


def _places(document: Document, pose_key: str) -> Floats:
    """Return the positions (n, 3) [mm] of the targets, "before" or "after" the correction."""
    return np.array([[row[pose_key][f"{axis}_mm"] for axis in "xyz"] for row in document["targets"]])


def _limit(row: Document) -> str:
    """Return the joint nearest to its limit, and the distance."""
    if row["limit_joint"] is None:
        return "none"
    value, unit = (row["limit_deg"], "deg") if "limit_deg" in row else (row["limit_mm"], "mm")
    return f"joint {row['limit_joint']}: {value:.1f} {unit}"


def _moves(document: Document) -> list[tuple[str, ...]]:
    """Return rows of cells, beginning with the move that cannot be followed, or deviates most from a straight line."""
    rows: list[tuple[str, ...]] = []
    deviation, singular = (_column(document, key, "moves") for key in ("deviation_mm", "singular_value"))
    for i in np.argsort(-np.nan_to_num(deviation, nan=np.inf), kind="stable"):
        move = document["moves"][i]
        bent = "bends" if deviation[i] > MM.of(STRAIGHT) else ""
        blocked = "cannot be followed" if np.isnan(deviation[i]) else "may not be drivable"
        margins = page.number(deviation[i], 3), _limit(move), page.number(singular[i], 3)
        rows.append((move["place"], move["from"], *margins, bent if move["drivable"] else blocked))
    return rows


def _tiles(document: Document) -> Iterator[page.Tile]:
    point, due = document["error_point"], _column(document, "expected_mm")
    error_before, shift = _column(document, "error_before_mm"), _column(document, "shift_mm")
    largest = float(due.max()) if np.isfinite(due).all() else float("nan")
    for css, name, value, note in (
        ("old", "shift, median", float(np.median(shift)), "of the commanded position"),
        ("val", "error without correction, RMS", rms(error_before), f"of {point}, by the model"),
        ("fit", "expected error, largest (k = 2)", largest, f"of {point}, {_EXPECTED}"),
    ):
        yield css, name, {"mm": value}, note


def _targets(document: Document) -> Table:
    titles = ("", "x", "y", "z [mm]", "shift [mm]", "[mrad]", "error before [mm]", "expected [mm]", "[mrad]", "nearest joint limit", "singular value")  # fmt: skip
    keys = ("shift_mm", "shift_mrad", "error_before_mm", "expected_mm", "expected_mrad")
    columns = [_column(document, key) for key in keys]
    rows = []
    for i, row in enumerate(document["targets"][:MOST_ROWS]):
        position = [page.number(row["before"][f"{axis}_mm"], 2) for axis in "xyz"]
        errors = [page.number(column[i], 3) for column in columns]
        rows.append((row["place"], *position, *errors, _limit(row), page.figures(row["singular_value"], 2)))
    return Table(titles, rows, "targets", total=len(document["targets"]))


_TARGETS = (
    "Positions are those of the file; errors are those of {}. Shift: how far the command moved. Expected: the expanded uncertainty (k = 2, about 95 %) after the correction. "
    "Singular value: the smallest one of the Jacobian (lengths in units of 0.5 m); near 0 the robot is near a singularity."
)


def _pictures(document: Document) -> list[page.Figure]:
    chosen = thinned(len(document["targets"]), MOST_ARROWS)
    requested, commanded = (_places(document, pose_key)[chosen] for pose_key in ("before", "after"))
    names = [document["targets"][i]["place"] for i in chosen]
    views = [("Shifts from above", [0, 1]), ("Shifts from the side", [0, 2])]
    arrows = [
        _arrows(title, axes, requested[:, axes], (commanded - requested)[:, axes], names) for title, axes in views
    ]
    return [*arrows, _errors(document, chosen, names)]


def _arrows(title: str, axes: Sequence[int], start: Floats, by: Floats, names: Sequence[str]) -> page.Figure:
    """Return positions in two axes of the file's frame [mm] with their shifts, enlarged by a round factor."""
    span = max(float(np.ptp(start, axis=0).max()), 100.0)
    median = float(np.median(np.linalg.norm(by, axis=1)))
    factor = svg.round_step(ARROW * span / median) if median > 1e-6 else 1.0
    ends = start + factor * by
    low, high = np.minimum(start, ends).min(axis=0), np.maximum(start, ends).max(axis=0)
    middle, half = 0.5 * (low + high), 0.55 * max(float((high - low).max()), 100.0)
    titles = [f"{'xyz'[axis]} [mm]" for axis in axes]
    x, y = (svg.linear_axis(name, m - half, m + half) for name, m in zip(titles, middle, strict=True))
    plot = svg.Plot(x, y, height=420.0)
    lines = zip(plot.px(start[:, 0]), plot.py(start[:, 1]), plot.px(ends[:, 0]), plot.py(ends[:, 1]), strict=True)
    path = "".join(f"M{svg.num(a)} {svg.num(b)}L{svg.num(c)} {svg.num(d)}" for a, b, c, d in lines)
    plot.scatter(start[:, 0], start[:, 1], "old", names, "target")
    plot.draw(f'<path class="fit" fill="none" d="{path}"/>', "fit line", f"its shift, × {factor:g}")
    caption = f"Each line runs from a target to where the command moved it, drawn {factor:g} times as long."
    return plot.figure(title, caption)


def _errors(document: Document, chosen: Sequence[int] | np.ndarray, names: Sequence[str]) -> page.Figure:
    """Return the errors without correction and the expected errors with it, in the order of the file."""
    order = np.asarray(chosen, dtype=float) + 1.0
    error_before, due = (_column(document, key)[chosen] for key in ("error_before_mm", "expected_mm"))
    last = max(float(len(document["targets"])), 2.0)
    plot = svg.Plot(
        svg.linear_axis("target", 1.0, last, max(svg.round_step(last / 6.0), 1.0)),
        svg.log_axis("error [mm]", np.concatenate([error_before, due[np.isfinite(due)]])),
    )
    for css, name, values in (("val", "without correction", error_before), ("fit", "expected with it, k = 2", due)):
        rows = np.flatnonzero(np.isfinite(values)).tolist()
        plot.scatter(order[rows], values[rows], css, [f"{names[i]}: {page.figures(values[i])} mm" for i in rows], name)
    caption = f"Error of {document['error_point']} without the correction, and the bound expected with it (about 95 %)."
    if not np.isfinite(due).all():
        caption += f" Where it is not known ({page.ABSENT} in the table) there is no point."
    return plot.figure("Errors", caption)
