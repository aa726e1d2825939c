"""Tables of an identification: residuals by kind and rig, suspect rows, parameters, combinations, observability."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from truearm.estimate.kind_errors import KindErrors, errors_by_kind
from truearm.kinds.registry import kinds
from truearm.kinds.table import ObservationTable
from truearm.report.page_parts import sentences, table, table_of
from truearm.report.page_text import ABSENT, escape, figures, number
from truearm.report.residual_rows import row_name
from truearm.report.result_words import OBSERVABILITY, ParameterRow, direction_text, drawing, kind_name, residual_words
from truearm.results import Estimate, Figures, NullDirection
from truearm.text import counted
from truearm.units import shown, symbol, title, tolerances

MAX_ROWS = 40  # suspect rows that are listed


def residual_table(e: Estimate, table: ObservationTable) -> str:
    """Return a table per unit: RMS and largest residual of each kind, by rig if there are several, with definitions."""
    errors = errors_by_kind(e, table)
    units = dict.fromkeys(si for rows in errors for si in (*rows.after, *rows.judged))
    words = " ".join(residual_words(kind) for kind in kinds() if any(rows.kind == kind for rows in errors))
    return f"<p>{escape(words, 1200)}</p>" + "".join(_residuals_in(si, errors) for si in units)


def _residuals_in(si: str, errors: Sequence[KindErrors]) -> str:
    several, none = any(rows.rig for rows in errors), Figures.of(np.zeros(0))
    titles = ["observations", *["rig"] * several, "fitted rows", title("RMS before", si), title("RMS after", si)]
    titles += [title("largest after", si), "held-out rows", title("RMS held out", si)]
    cells = []
    for rows in errors:
        if si in rows.after or si in rows.judged:
            before, after, judged = (of.get(si, none) for of in (rows.before, rows.after, rows.judged))
            sizes = [figures(shown(value, si)) for value in (before.rms, after.rms, after.max, judged.rms)]
            names = [escape(kind_name(rows.kind)), *[escape(rows.rig) or ABSENT] * several]
            counts = [str(int(chosen.sum())) for chosen in (rows.fitted, rows.held_out)]
            cells.append([*names, counts[0], *sizes[:3], counts[1], sizes[3]])
    return table_of(titles, cells, f"residuals {symbol(si)}")


def suspect_table(e: Estimate, table: ObservationTable) -> str:
    """Return the fitted rows that are farther from the others than chance allows, the farthest first."""
    rows = np.flatnonzero(e.suspect)
    rows = rows[np.argsort(-e.distance[rows], kind="stable")]
    units = Figures.by_unit(e.residual, rows)
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
    return table_of(titles, cells, "rows far from the others") + more


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


MAX_DIRECTIONS = 40
MAX_TERMS = 6


def parameter_table(estimate: Estimate, which: range) -> str:
    """Return nominal, identified, change and σ of the parameters ``which``, in mm, deg or 1."""
    titles = ("parameter", "nominal", "identified", "change", "σ", "unit", "")
    sigma = np.where(estimate.free & estimate.identifiable, estimate.sigma, np.nan)
    columns = (estimate.parameter_names, estimate.units, estimate.free, estimate.nominal, estimate.value, sigma)
    rows = [ParameterRow.of(*row) for row in zip(*columns, strict=True)][which.start : which.stop]
    owners = [row.name.rpartition(".")[0] for row in rows]
    first = [k > 0 and owner != owners[k - 1] for k, owner in enumerate(owners)]
    return table(titles, "".join(map(_parameter_row, rows, first)), "parameters", "numbers")


def _parameter_row(row: ParameterRow, is_first: bool) -> str:
    """Return a row of HTML; ``is_first``: of another joint than the row above."""
    unit = row.unit
    cells = [number(row.nominal, unit.decimals), number(row.value, unit.decimals)]
    cells += [number(row.change, unit.decimals, sign=True), _sigma(row.sigma, unit.decimals)]
    unseen = ("unseen", "unidentifiable alone") if math.isnan(row.sigma) else ("", "")
    css, note = unseen if row.free else ("held", "held fixed")
    numbers = "".join(f"<td>{cell}</td>" for cell in cells)
    ends = f'<td class="unit">{unit.symbol or unit.si}</td><td class="note">{note}</td>'
    return f'<tr class="{css}{" first" * is_first}"><th scope="row">{escape(row.name)}</th>{numbers}{ends}</tr>'


def _sigma(sigma: float, decimals: int) -> str:
    """Return σ with the decimals of the value, or more if that would show zero."""
    return number(sigma, decimals) if not sigma < 5.0 * 10.0**-decimals else figures(sigma, 2)


def visibility(estimate: Estimate) -> str:
    """Return rank, null space and weakly identifiable combinations in words, as HTML."""
    free = int(estimate.free[: estimate.n_robot_parameters].sum())
    held = estimate.n_robot_parameters - free
    words = [
        f"The observations determine <strong>{estimate.rank} of {free}</strong> combinations of the robot's free parameters."
    ]
    if math.isfinite(estimate.rank_gap):
        gap = figures(estimate.rank_gap, 2)
        words.append(f"The weakest of these is a factor of {gap} above the unidentifiable ones.")
    if held:
        words.append(f"{counted(held, 'parameter is', 'parameters are')} held fixed at the nominal value.")
    timed = any(unit == "s" and is_free for unit, is_free in zip(estimate.units, estimate.free, strict=True))
    combinations = (
        (
            estimate.null_space,
            "Unidentifiable (weights in m, rad and 1). Changes along these combinations do not change any prediction, so the values are one choice of many.",
        ),
        (
            estimate.hardly_seen,
            f"Weakly identifiable: the observations alone determine these combinations less accurately than a manufacturer's drawing ({drawing(timed)}).",
        ),
    )
    listed = (f"<p>{text}</p>{_directions(directions)}" for directions, text in combinations if directions)
    return f"<p>{' '.join(words)}</p>{''.join(listed)}"


def _directions(directions: Sequence[NullDirection]) -> str:
    texts = [direction_text(of.weights, of.names, MAX_TERMS) for of in directions[:MAX_DIRECTIONS]]
    if len(directions) > MAX_DIRECTIONS:
        texts.append(f"and {len(directions) - MAX_DIRECTIONS} more")
    return sentences(texts, "directions")
