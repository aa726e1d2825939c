"""The findings of an identification other than the parameters, as tables and sentences.

These are the residuals of each kind and rig, χ², suspect rows, the identifiability of the parameters, suggested further
measurements, and the predicted error of the tool.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from truearm.estimate.outliers import MOST
from truearm.kinds.registry import kinds
from truearm.report.page_parts import table_of
from truearm.report.page_text import ABSENT, escape, figures, number, size
from truearm.report.residual_rows import Summary, row_name
from truearm.report.result_words import OBSERVABILITY, gain_words, kind_name, residual_words
from truearm.results import EXACT_FIT, Addition, Estimate, Figures, PredictedError, chi2_text
from truearm.text import counted
from truearm.types import ObservationTable
from truearm.units import shown, symbol, title, tolerances

MAX_ROWS = 40  # suspect rows that are listed
MAX_NAMES = 12


def residual_table(found: Sequence[Summary]) -> str:
    """Return a table per unit: RMS and largest residual of each kind, by rig if there are several, with definitions."""
    tables = [_residuals_in(si, [s for s in found if s.si == si]) for si in dict.fromkeys(s.si for s in found)]
    words = " ".join(residual_words(kind) for kind in kinds() if any(s.kind == kind for s in found))
    return f"<p>{escape(words, 1200)}</p>" + "".join(tables)


def _residuals_in(si: str, found: Sequence[Summary]) -> str:
    several = any(s.rig for s in found)
    titles = ["observations", *["rig"] * several, "fitted rows", title("RMS before", si), title("RMS after", si)]
    titles += [title("largest after", si), "held-out rows", title("RMS held out", si)]
    rows = [
        [
            escape(kind_name(s.kind)),
            *[escape(s.rig) or ABSENT] * several,
            str(s.fitted),
            *(figures(shown(value, si)) for value in (s.before, s.after, s.largest)),
            str(s.held_out),
            figures(shown(s.validation, si)),
        ]
        for s in found
    ]
    return table_of(titles, rows, f"residuals {symbol(si)}")


def chi2_words(e: Estimate) -> str:
    """Return a sentence that compares χ² with its range; "" where there is none."""
    low, high = e.chi2_band
    if not math.isfinite(e.chi2_reduced):
        return ""
    reduced = figures(e.chi2_reduced) if e.chi2_reduced >= EXACT_FIT else chi2_text(e.chi2_reduced)
    text = f"χ² per degree of freedom is {reduced}"
    if not math.isfinite(low + high):
        return text + "."
    text += f"; if the declared σ and the model are right, it is between {figures(low)} and {figures(high)} (95 %). "
    if e.without_bad_rows is not None:
        return text + f"It is above this range: {counted(e.without_bad_rows.n, 'row')} are bad."
    if e.chi2_reduced > high:
        return (
            text
            + "It is above this range: the robot has errors that these parameters do not model, or the σ are too small."
        )
    if e.chi2_reduced < low:
        return text + "It is below this range: the declared σ are larger than the noise."
    return text + "It is within this range."


def suspect_table(e: Estimate, table: ObservationTable) -> str:
    """Return the fitted rows that are farther from the others than chance allows, the farthest first."""
    rows = np.flatnonzero(e.suspect)
    if not rows.size:
        return "<p>No fitted row is an outlier. By chance, one in a million rows without a fault would be called an outlier.</p>"
    rows = rows[np.argsort(-e.distance[rows], kind="stable")]
    left_out = int(np.sum(e.weight[rows] == 0.0))
    units = Figures.by_unit(e.residual, rows)
    if rows.size > MOST * np.sum(e.fitted) and not left_out:
        words = f"{rows.size} of {counted(int(np.sum(e.fitted)), 'fitted row')} lie farther from the fit than their declared noise allows. "
        words += "These are too many to be outliers, and none is left out of the fit."
    else:
        verb = "is an outlier" if rows.size == 1 else "are outliers"
        words = f"{counted(rows.size, 'fitted row')} {verb} (by chance, one in a million rows without a fault would be called an outlier)"
        words += f"; {left_out} left out of the fit." if left_out else "; none is left out of the fit."
    cells = [
        [
            escape(row_name(table.source[row])),
            escape(kind_name(str(table.kind[row]))),
            number(float(e.distance[row]), 1),
            *(figures(shown(float(e.residual[si][row]), si)) for si in units),
            figures(float(e.weight[row]), 2),
        ]
        for row in rows[:MAX_ROWS]
    ]
    sizes = [title("residual", si) for si in units]
    titles = ["row", "observation", "distance from the others [σ]", *sizes, "weight in the fit [1]"]
    more = f"<p>and {rows.size - MAX_ROWS} more (suspect in result.json)</p>" if rows.size > MAX_ROWS else ""
    return f"<p>{words}</p>" + table_of(titles, cells, "rows far from the others") + more


def observability_table(e: Estimate) -> str:
    """Return the four indices of the suggested free set; "" if they were not computed."""
    if e.observability is None or not e.suggested_free.any():
        return ""
    names = [name for name, is_in in zip(e.parameter_names, e.suggested_free, strict=False) if is_in]
    values = e.observability._asdict()
    rows = [(key.upper(), figures(values[key]), unit, escape(words)) for key, (words, unit) in OBSERVABILITY.items()]
    length, angle, gain = tolerances("weak")
    text = (
        f"How well the observations alone determine the largest set of parameters that they can distinguish ({len(names)}). A step is {length}, "
        f"{angle} or {gain}. Larger is better. Compare sets of poses of the same robot only."
    )
    table = table_of(("index", "value", "unit", "what it says"), rows, "observability", "plain words")
    return f"<p>{escape(text, 600)}</p>{table}" + _suggested(e, names)


def _suggested(e: Estimate, names: Sequence[str]) -> str:
    """Return the distinguishable set, if more parameters were free."""
    if len(names) == int(e.free[: e.n_robot_parameters].sum()):
        return ""
    listed = escape(", ".join(names), 4000)
    return f"<details><summary>the {counted(len(names), 'parameter')} that can be distinguished</summary><p>{listed}</p></details>"


def addition_list(additions: Sequence[Addition], full_rank: bool) -> str:
    """Return the suggested further measurements, the most useful first; "" if nothing is missing."""
    if not additions:
        return ""
    items = []
    for a in additions:
        names = ", ".join(a.parameters[:MAX_NAMES])
        more = f" and {counted(len(a.parameters) - MAX_NAMES, 'other')}" if len(a.parameters) > MAX_NAMES else ""
        words = f"{a.text[0].upper()}{a.text[1:]} {gain_words(len(a.parameters), full_rank)}: {names}{more}."
        items.append(f"<li>{escape(words, 900)}</li>")
    return f'<h3>What to measure next</h3><ul class="directions">{"".join(items)}</ul>'


def predicted_words(predicted: PredictedError) -> str:
    """Return the predicted error of the tool as a sentence of plain text."""
    where = (
        "relative to all poses together, because the pose of the base is not measured"
        if predicted.relative
        else "in the base frame"
    )
    return (
        f"The covariance of the parameters predicts an error of {size(predicted.rms, 'm')} RMS at the measured point of the tool "
        f"over {counted(predicted.n, 'pose')}, {where}; the largest is {size(predicted.largest, 'm')} at {row_name(predicted.source)}. "
        "This assumes that the model is right; errors that the parameters do not model are not included."
    )
