"""The HTML report of a calibration: the verdict, the pictures, the parameters, unidentifiable directions, how it was
made.

Names and notes may come from external files; blocks escape all text.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from truearm.estimate.kind_errors import KindErrors, errors_by_kind
from truearm.estimate.law_curves import SampledCurve
from truearm.findings import Finding
from truearm.kinds.registry import kinds
from truearm.kinds.table import ObservationTable
from truearm.report.certificate import Certificate, certificate_section
from truearm.report.figures import figures_of, law_figures
from truearm.report.page_parts import (
    fact_list,
    folded,
    html_page,
    making,
    paragraph,
    pictures,
    section,
    sentences,
    table,
    tiles,
)
from truearm.report.page_text import ABSENT, figures, number, size
from truearm.report.residual_rows import row_name, rows_by_kind
from truearm.report.result_words import (
    before_words,
    direction_text,
    drawing,
    kind_name,
    parameter_table,
    residual_words,
)
from truearm.report.scene_view import Scene
from truearm.report.tables import Table
from truearm.results import Estimate, Figures, PredictedError
from truearm.text import counted
from truearm.types import Floats
from truearm.units import shown, symbol, title

MAX_ROWS = 40  # suspect rows that are listed
MAX_DIRECTIONS = 40
MAX_TERMS = 6
PARAMETER = ("name", "unit", "nominal", "value", "sigma", "free")


@dataclass(frozen=True)
class CalibrationPage:
    """The content of the page.

    ``estimate`` was made from ``table``, whose n rows include fitted and held-out ones. ``longitude`` (n,) [rad] is
    that of the sphere about its chuck, NaN for rows without one. ``facts`` are labels and values about the recording,
    ``command`` the command that makes the page again. ``predicted`` is
    the predicted error of the tool from the parameters' covariance.
    """

    title: str
    subtitle: str
    estimate: Estimate
    table: ObservationTable
    longitude: Floats  # (n,) rad
    facts: tuple[tuple[str, str], ...] = ()
    command: str = ""
    predicted: PredictedError | None = None
    law_steps: tuple[Table, ...] = ()  # fits with joint laws, by unit
    curves: tuple[SampledCurve, ...] = ()
    certificate: Certificate | None = None  # shown on page one
    findings: tuple[Finding, ...] = ()  # the verdict first
    scene: Scene | None = None


def render(page: CalibrationPage) -> str:
    """Return the page as HTML text, to be written as UTF-8."""
    e = page.estimate
    blocks = (
        section("Residuals", *_residuals(page)),
        section("Parameters", *_parameters(e)),
        section("Joint laws", *map(table, page.law_steps), pictures(law_figures(page.curves))),
        section("Identifiable and unidentifiable combinations", *visibility(e)),
        section("The recording", fact_list(page.facts)),
        making(page.command, _facts(page)),
    )
    first = certificate_section(page.certificate) if page.certificate else ""
    head = "truearm", page.title, page.subtitle
    return html_page(*head, blocks, page.findings, figures=tiles(_tiles(page)), certificate=first, scene=page.scene)


def _tiles(page: CalibrationPage) -> Iterator[tuple[str, str, list[tuple[str, str]], str]]:
    e, judged = page.estimate, page.estimate.held_out
    fitted_rows = counted(int(e.used.sum()), "fitted observation")
    yield "old", "RMS before", _sizes(e.rms_before), f"{fitted_rows}, the nominal robot{before_words(e)}"
    if not e.has_little_freedom:
        yield "fit", "RMS after", _sizes(e.rms_after), "the same observations, identified parameters"
    if judged:
        by_unit = judged.figures.items()
        remark = "; ".join(f"mean {size(error.mean, si, '')}, largest {size(error.max, si)}" for si, error in by_unit)
        held_out = _sizes({si: error.rms for si, error in by_unit})
        yield "val", "RMS held out", held_out, f"{counted(judged.n, 'observation')} not used to fit; {remark}"
    if page.predicted:
        over = f"over {counted(page.predicted.n, 'pose')}; at most {size(page.predicted.largest, 'm')}"
        remark = f"from the parameters, faults that the rows do not exclude and the arm's own scatter, {over}"
        yield "old", "RMS of the tool, predicted", _sizes({"m": page.predicted.rms}), remark


def _sizes(errors: Mapping[str, float]) -> list[tuple[str, str]]:
    return [(size(value, si, ""), symbol(si)) for si, value in errors.items()]


def _residuals(page: CalibrationPage) -> Iterator[str]:
    e, rows = page.estimate, page.table
    by_kind = rows_by_kind(e, rows, page.longitude)
    yield from residual_tables(e, rows)
    if e.suspect.any():
        yield table(suspect_table(e, rows))
    figures = [
        figure._replace(title=f"{figure.title} · {rows_of_kind.title}") if len(by_kind) > 1 else figure
        for rows_of_kind in by_kind
        for figure in figures_of(rows_of_kind)
    ]
    yield pictures(figures)


def _parameters(e: Estimate) -> Iterator[str]:
    sigma = np.where(e.free & e.identifiable, e.sigma, np.nan)
    columns = (e.parameter_names, e.units, e.nominal, e.value, sigma, e.free)
    rows = [dict(zip(PARAMETER, row, strict=True)) for row in zip(*columns, strict=True)]
    robot, rig = rows[: e.law_parameters.start], rows[e.n_robot_parameters :]
    yield paragraph(
        "A single parameter may differ from the drawing because of how the fixtures are mounted, or because it "
        "takes over the error of a parameter that is held fixed; judge the arm by its predictions."
    )
    yield table(parameter_table(robot), "numbers")
    if rig:
        yield folded(f"{counted(len(rig), 'parameter')} of the rig", table(parameter_table(rig), "numbers"))


def _facts(page: CalibrationPage) -> tuple[tuple[str, str], ...]:
    e = page.estimate
    return (
        ("iterations", str(e.iterations)),
        ("χ² per degree of freedom", figures(e.chi2_reduced)),
        ("status", f"{e.status}: {e.message}" if e.message else e.status),
        ("solver's time", f"{figures(e.seconds, 2)} s"),
    )


# tables


def residual_tables(e: Estimate, rows: ObservationTable) -> Iterator[str]:
    """Return definitions, and a table per unit: RMS and largest residual of each kind, by rig if there are several."""
    errors = errors_by_kind(e, rows)
    yield paragraph(" ".join(residual_words(kind) for kind in kinds() if any(rows.kind == kind for rows in errors)))
    for si in dict.fromkeys(si for rows in errors for si in (*rows.after, *rows.judged)):
        yield table(_residuals_in(si, errors))


def _residuals_in(si: str, errors: Sequence[KindErrors]) -> Table:
    has_rigs, none = any(rows.rig for rows in errors), Figures.of(np.zeros(0))
    titles = ["observations", *["rig"] * has_rigs, "fitted rows", title("RMS before", si), title("RMS after", si)]
    titles += [title("largest after", si), "held-out rows", title("RMS held out", si)]
    cells = []
    for rows in errors:
        if si in rows.after or si in rows.judged:
            error_before, error_after, judged = (
                by_unit.get(si, none) for by_unit in (rows.before, rows.after, rows.judged)
            )
            sizes = [
                figures(shown(value, si)) for value in (error_before.rms, error_after.rms, error_after.max, judged.rms)
            ]
            counts = [int(chosen.sum()) for chosen in (rows.fitted, rows.held_out)]
            names = [kind_name(rows.kind), *[rows.rig or ABSENT] * has_rigs]
            cells.append([*names, counts[0], *sizes[:3], counts[1], sizes[3]])
    return Table(titles, cells, f"residuals {symbol(si)}")


def suspect_table(e: Estimate, table: ObservationTable) -> Table:
    """Return the fitted rows that are farther from the others than chance allows, the farthest first."""
    rows = np.flatnonzero(e.suspect)
    rows = rows[np.argsort(-e.distance[rows], kind="stable")]
    units = Figures.by_unit(e.residual, rows)
    cells = [
        [
            row_name(table.source[row]),
            kind_name(str(table.kind[row])),
            number(float(e.distance[row]), 1),
            *(figures(shown(float(e.residual[si][row]), si)) for si in units),
            figures(float(e.weight[row]), 2),
        ]
        for row in rows[:MAX_ROWS]
    ]
    sizes = [title("residual", si) for si in units]
    titles = ["row", "observation", "distance from the others [σ]", *sizes, "weight in the fit [1]"]
    hidden = f"and {rows.size - MAX_ROWS} more (suspect in result.json)" if rows.size > MAX_ROWS else ""
    return Table(titles, cells, "rows far from the others", hidden)


def visibility(estimate: Estimate) -> Iterator[str]:
    """Return rank, null space and weakly identifiable combinations in words."""
    free = int(estimate.free[: estimate.n_robot_parameters].sum())
    held = estimate.n_robot_parameters - free
    words = [f"The observations determine {estimate.rank} of {free} combinations of the robot's free parameters."]
    if math.isfinite(estimate.rank_gap):
        gap = figures(estimate.rank_gap, 2)
        words.append(f"The weakest of these is a factor of {gap} above the unidentifiable ones.")
    if held:
        words.append(f"{counted(held, 'parameter is', 'parameters are')} held fixed at the nominal value.")
    yield paragraph(" ".join(words))
    timed = any(unit == "s" and is_free for unit, is_free in zip(estimate.units, estimate.free, strict=True))
    for directions, text in (
        (
            estimate.null_space,
            "Unidentifiable (weights in m, rad and 1). Changes along these combinations do not change any prediction, so the values are one choice of many.",
        ),
        (
            estimate.hardly_seen,
            f"Weakly identifiable: the observations alone determine these combinations less accurately than a manufacturer's drawing ({drawing(timed)}).",
        ),
    ):
        if directions:
            texts = [direction_text(d.weights, d.names, MAX_TERMS) for d in directions[:MAX_DIRECTIONS]]
            texts += [f"and {len(directions) - MAX_DIRECTIONS} more"] * (len(directions) > MAX_DIRECTIONS)
            yield paragraph(text) + sentences(texts, "directions")
