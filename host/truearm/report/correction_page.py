"""The HTML report of a correction: the shifts, the expected remaining error, and what to check before running the
program.

Like the other pages it is a single file without a script. Lengths are in mm and angles in mrad here, for display.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from truearm.findings import Finding
from truearm.report import svg
from truearm.report.figures import Figure, drawn
from truearm.report.page_parts import finding_parts, html_page, picture, pictures, section, table_of
from truearm.report.page_tables import fact_list
from truearm.report.page_text import ABSENT, escape, figures, number
from truearm.types import Floats, rms, thinned
from truearm.units import MM, MRAD

MOST_ROWS = 400  # of a table; the JSON document has all of them
MOST_ARROWS = 2000
ARROW = 0.06  # of the longer side of the picture: length at which a median shift is drawn


@dataclass(frozen=True)
class CorrectionPage:
    """The content of a page about n targets.

    ``asked`` and ``shift`` (n, 3) [m] are the targets' positions and the shifts of the command; ``sizes`` (n, 2) [m,
    rad] the sizes of the shifts. ``before`` (n,) [m] is the error of ``error_point`` without correction, ``expected`` (n, 2) [m, rad] the
    expanded uncertainty with it, NaN where unknown. ``limits`` are the margins to joint limits in words,
    ``singular_value`` is (n,). ``moves`` are rows of cells for straight moves: from, to, deviation, margins, and a
    remark. ``refused`` has line, statement, reason. ``simulated``: a watermark says that the calibration is.
    """

    title: str
    subtitle: str
    places: tuple[str, ...]
    asked: Floats
    shift: Floats
    sizes: Floats
    before: Floats
    error_point: str
    expected: Floats
    limits: tuple[str, ...]
    singular_value: Floats
    moves: tuple[tuple[str, ...], ...]
    refused: tuple[tuple[str, ...], ...]
    findings: Sequence[Finding]
    facts: tuple[tuple[str, str], ...]
    simulated: bool


def render(page: CorrectionPage) -> str:
    """Return the page as HTML text, to be written as UTF-8."""
    sections = [
        _summary(page),
        section("Not corrected", _rows(("line", "statement", "reason"), page.refused, "statements not corrected"))
        if page.refused
        else "",
        section("Shifts", pictures(map(picture, _pictures(page)))),
        section("Targets", _targets(page)),
        section("Straight moves", _rows(_MOVES, page.moves, "straight moves")) if page.moves else "",
        section("How it was made", fact_list(page.facts)),
    ]
    watermark = "simulated" * page.simulated
    return html_page("truearm correct", page.title, page.subtitle, sections, watermark=watermark)


_MOVES = ("to", "from", "deviation [mm]", "nearest joint limit", "singular value", "")


def _summary(page: CorrectionPage) -> str:
    tiles = [
        ("shift, median", MM.of(float(np.median(page.sizes[:, 0]))), "mm", "of the commanded position", "old"),
        ("error without correction, RMS", MM.of(rms(page.before)), "mm", f"of {page.error_point}, by the model", "val"),
        (
            "expected error, largest (k = 2)",
            MM.of(_largest(page.expected[:, 0])),
            "mm",
            f"of {page.error_point}, {_EXPECTED}",
            "fit",
        ),
    ]
    shown = "".join(
        f'<div class="tile {css}"><p class="name">{name}</p><p class="figure">{figures(value)}<span> {unit}</span></p>'
        f'<p class="small">{escape(note)}</p></div>'
        for name, value, unit, note, css in tiles
    )
    verdict, doubts, notes = finding_parts(page.findings)
    return f'<section>{verdict}<div class="tiles">{shown}</div>{doubts}{notes}</section>\n'


_EXPECTED = "by the parameters' covariance and by what the calibration leaves unexplained"


def _largest(values: Floats) -> float:
    return float(np.max(values)) if np.isfinite(values).all() else float("nan")


def _targets(page: CorrectionPage) -> str:
    titles = ("", "x", "y", "z [mm]", "shift [mm]", "[mrad]", "error before [mm]", "expected [mm]", "[mrad]", "nearest joint limit", "singular value")  # fmt: skip
    rows = []
    for i, place in enumerate(page.places[:MOST_ROWS]):
        lengths = [*(number(v, 2) for v in MM.of(page.asked[i])), number(MM.of(page.sizes[i, 0]), 3)]
        angle, before = number(MRAD.of(page.sizes[i, 1]), 3), number(MM.of(page.before[i]), 3)
        due = number(MM.of(page.expected[i, 0]), 3), number(MRAD.of(page.expected[i, 1]), 3)
        rows.append((place, *lengths, angle, before, *due, page.limits[i], figures(page.singular_value[i], 2)))
    return _rows(titles, rows, "targets", len(page.places)) + f"<p>{escape(_TARGETS.format(page.error_point), 600)}</p>"


_TARGETS = (
    "Positions are those of the file; errors are those of {}. Shift: how far the command moved. Expected: the expanded uncertainty (k = 2, about 95 %) after the correction. "
    "Singular value: the smallest one of the Jacobian (lengths in units of 0.5 m); near 0 the robot is near a singularity."
)


def _rows(titles: Sequence[str], rows: Sequence[Sequence[str]], label: str, total: int = 0) -> str:
    """Return a table of plain cells, cut at MOST_ROWS."""
    total = total or len(rows)
    more = f"<p>and {total - MOST_ROWS} more; the JSON document has all</p>" if total > MOST_ROWS else ""
    cells = ([escape(cell) for cell in row] for row in rows[:MOST_ROWS])
    return table_of([escape(title) for title in titles], cells, label) + more


def _pictures(page: CorrectionPage) -> list[Figure]:
    chosen = thinned(len(page.places), MOST_ARROWS)
    views = [("Shifts from above", (0, 1)), ("Shifts from the side", (0, 2))]
    return [*(_arrows(page, chosen, title, axes) for title, axes in views), _errors(page, chosen)]


def _arrows(page: CorrectionPage, chosen: Sequence[int] | np.ndarray, title: str, axes: tuple[int, int]) -> Figure:
    """Return positions in two axes of the file's frame with their shifts, enlarged by a round factor."""
    at, by = (MM.of(values[chosen][:, axes]) for values in (page.asked, page.shift))
    span = max(float(np.ptp(at, axis=0).max()), 100.0)
    median = float(np.median(np.linalg.norm(by, axis=1)))
    factor = svg.round_step(ARROW * span / median) if median > 1e-6 else 1.0
    ends = at + factor * by
    low, high = np.minimum(at, ends).min(axis=0), np.maximum(at, ends).max(axis=0)
    middle, half = 0.5 * (low + high), 0.55 * max(float((high - low).max()), 100.0)
    names = [f"{'xyz'[axis]} [mm]" for axis in axes]
    x, y = (svg.linear_axis(name, m - half, m + half) for name, m in zip(names, middle, strict=True))
    plot = svg.Plot(x, y, height=420.0)
    lines = zip(plot.px(at[:, 0]), plot.py(at[:, 1]), plot.px(ends[:, 0]), plot.py(ends[:, 1]), strict=True)
    path = "".join(f"M{svg.num(a)} {svg.num(b)}L{svg.num(c)} {svg.num(d)}" for a, b, c, d in lines)
    parts = [svg.axes(plot), f'<path class="fit" fill="none" d="{path}"/>', svg.dots(plot, at[:, 0], at[:, 1], "old")]
    parts.append(svg.legend(plot, [("old", "target"), ("fit line", f"its shift, × {factor:g}")]))
    caption = f"Each line runs from a target to where the command moved it, drawn {factor:g} times as long."
    return drawn(plot, title, caption, parts)


def _errors(page: CorrectionPage, chosen: Sequence[int] | np.ndarray) -> Figure:
    """Return the errors without correction and the expected errors with it, in the order of the file."""
    order = np.asarray(chosen, dtype=float) + 1.0
    before, due = MM.of(page.before[chosen]), MM.of(page.expected[chosen, 0])
    known = np.isfinite(due)
    plot = svg.Plot(
        svg.linear_axis("target", 1.0, float(len(page.places))),
        svg.log_axis("error [mm]", np.concatenate([before, due[known]])),
    )
    parts = [svg.axes(plot), svg.dots(plot, order, before, "val"), svg.dots(plot, order[known], due[known], "fit")]
    parts.append(svg.legend(plot, [("val", "without correction"), ("fit", "expected with it, k = 2")]))
    caption = f"Error of {page.error_point} without the correction, and the bound expected with it (about 95 %)."
    if not known.all():
        caption += f" Where it is not known ({ABSENT} in the table) there is no point."
    return drawn(plot, "Errors", caption, parts)
