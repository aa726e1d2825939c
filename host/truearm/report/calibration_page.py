"""The HTML report of a calibration: the verdict, the pictures, the parameters, unidentifiable directions, how it was
made.

Names and notes may come from external files; all text passes through ``truearm.report.page_text.escape``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import assert_never

import numpy as np

from truearm.estimate.gain import gain_of
from truearm.estimate.law_curves import SampledCurve
from truearm.estimate.solvers import Loss, Prior, loss_summary
from truearm.report.calibration_findings import (
    addition_list,
    chi2_words,
    observability_table,
    predicted_words,
    residual_table,
    suspect_table,
)
from truearm.report.certificate import Certificate, certificate_section
from truearm.report.correlation import correlation
from truearm.report.figures import convergences, figures_of
from truearm.report.law_figures import law_figures
from truearm.report.page_parts import command_block, html_page, picture, pictures, section, sentences, table_of
from truearm.report.page_tables import fact_list, parameter_table, step_table, visibility
from truearm.report.page_text import escape, figures, size
from truearm.report.residual_rows import rows_by_kind, summaries
from truearm.report.result_words import CHI2_DOUBTFUL, before_words, kind_name, parts_words, pose_error_words
from truearm.report.usability_words import few_freedom, freedom_words
from truearm.results import Estimate, Gain, HeldOut, PredictedError
from truearm.text import counted
from truearm.types import Floats, ObservationTable
from truearm.units import symbol, tolerances

HELD_OUT_DOUBTFUL = 1.5  # held-out RMS over fitted RMS


@dataclass(frozen=True)
class CalibrationPage:
    """The content of the page.

    ``estimate`` was made from ``table``, whose n rows include fitted and held-out ones. ``longitude`` (n,) [rad] is
    that of the sphere about its chuck, NaN for rows without one. ``facts`` are labels and values about the recording,
    ``steps`` names and seconds, ``command`` the command that makes the page again. ``notes`` are sentences for the reader. ``prior`` is
    the name of the robot's prior, ``predicted`` the predicted error of the tool from the parameters' covariance.

    Raises ValueError if table, longitude and estimate have different numbers of rows.
    """

    title: str
    subtitle: str
    estimate: Estimate
    table: ObservationTable
    longitude: Floats  # (n,) rad
    facts: tuple[tuple[str, str], ...] = ()
    steps: tuple[tuple[str, float], ...] = ()
    command: str = ""
    notes: tuple[str, ...] = ()
    prior: str = "none"
    predicted: PredictedError | None = None
    systematic: tuple[str, ...] = ()  # sentences
    laws: tuple[str, ...] = ()  # sentences
    law_steps: tuple[tuple[str, str, str, str], ...] = ()  # unit, fit, fitted RMS, held-out mean
    curves: tuple[SampledCurve, ...] = ()
    certificate: Certificate | None = None  # shown on page one
    usability: tuple[str, ...] = ()  # sentences: why the fit is not usable, what would explain the observations

    def __post_init__(self) -> None:
        n = len(self.table)
        residuals = (residual.shape for residual in self.estimate.residual.values())
        shapes = (self.longitude.shape, self.estimate.fitted.shape, *residuals)
        if any(shape != (n,) for shape in shapes):
            raise ValueError(f"longitude, fitted and residual must be ({n},) like the table, are {shapes}")


def render(page: CalibrationPage) -> str:
    """Return the page as HTML text, to be written as UTF-8."""
    sections = (
        certificate_section(page.certificate) if page.certificate else "",
        _verdict(page),
        _pictures(page),
        _parameters(page.estimate),
        _laws(page),
        section("Identifiable and unidentifiable combinations", _sight(page.estimate)),
        section("The recording", fact_list(page.facts)) if page.facts else "",
        _making(page),
    )
    if page.table.simulated:
        return html_page("truearm", f"{page.title} (simulated)", page.subtitle, sections, watermark="simulated")
    return html_page("truearm", page.title, page.subtitle, sections)


def _verdict(page: CalibrationPage) -> str:
    e, judged = page.estimate, page.estimate.held_out
    tiles = [
        _tile(
            "before",
            e.rms_before,
            f"{counted(int(e.used.sum()), 'fitted observation')}, the nominal robot{before_words(e)}",
            "old",
        ),
    ]
    if not few_freedom(e.chi2_freedom, e.rank):
        tiles.append(_tile("after", e.rms_after, "the same observations, identified parameters", "fit"))
    if judged:
        of_units = judged.figures.items()
        more = "; ".join(f"mean {size(error.mean, si, '')}, largest {size(error.max, si)}" for si, error in of_units)
        rms = {si: error.rms for si, error in of_units}
        tiles.append(_tile("held out", rms, f"{counted(judged.n, 'observation')} not used to fit; {more}", "val"))
    if page.predicted:
        more = f"by the parameters' σ, over {counted(page.predicted.n, 'pose')}; at most {size(page.predicted.largest, 'm')}"
        tiles.append(_tile("of the tool, predicted", {"m": page.predicted.rms}, more, "old"))
    remarks = sentences(caveats(page), "remarks doubts") + sentences(page.notes, "remarks")
    line = f'<h2 class="verdict">{escape(verdict(page), 400)}</h2>'
    return f'<section>{line}<div class="tiles">{"".join(tiles)}</div>{remarks}</section>\n'


def verdict(page: CalibrationPage) -> str:
    """Return the result in one line of plain text, with a sentence for each unit of the residuals.

    For a fit that is not usable, or not significantly better than the nominal robot, the line states this.
    """
    e = page.estimate
    if _usability_first(e):
        return page.usability[0] if page.usability else "This fit is not usable."
    if few_freedom(e.chi2_freedom, e.rank):
        judged = page.estimate.held_out.figures.items() if page.estimate.held_out else ()
        held = "".join(f" The error is {size(of.rms, si)} on observations not used to fit." for si, of in judged)
        return freedom_words(e.chi2_freedom, e.rank, len(e.value) > e.n_robot_parameters) + held
    return " ".join(
        f"The {_kinds(page, si)}error is {_change(page.estimate, page.estimate.held_out, si)}."
        for si in page.estimate.rms_before
    )


def _usability_first(e: Estimate) -> bool:
    """Return whether the verdict is the first sentence about usability."""
    return e.unusable is not None or gain_of(e.mean_change) is Gain.NONE


def _kinds(page: CalibrationPage, si: str) -> str:
    """Return the kinds of observation with residuals in a unit, followed by a space; "" if no row has one."""
    rows = ~np.isnan(page.estimate.residual[si])
    names = [kind_name(str(kind)) for kind in np.unique(page.table.kind[rows])]
    if not names:
        return ""
    *several, last = names
    return f"{', '.join(several)} and {last} " if several else f"{last} "


def _change(e: Estimate, judged: HeldOut | None, si: str) -> str:
    """Return how the error changed in one unit."""
    before, after = e.rms_before[si], e.rms_after[si]
    factor = before / after if after > 0.0 else math.inf
    better = f"{figures(factor, 2)} times smaller" if factor >= 1.0 and math.isfinite(factor) else "changed"
    line = f"{better}: {size(before, si)} RMS before, {size(after, si)} after"
    held_out = judged.figures.get(si) if judged else None
    return line + (f", {size(held_out.rms, si)} on observations not used to fit" if held_out else "")


def caveats(page: CalibrationPage) -> list[str]:
    """Return the reasons to distrust the figures, one sentence each."""
    e, judged = page.estimate, page.estimate.held_out
    found = [*(page.usability[1:] if _usability_first(e) else page.usability), *page.systematic]
    if e.status != "converged" and not e.unusable:
        found.append(f"The fit did not converge: {e.message}.")
    if judged is None:
        found.append(
            "Nothing was held out: the error after the fit does not show how accurate the arm is at other poses."
        )
    elif (worst := _held_out_ratio(e, judged)) > HELD_OUT_DOUBTFUL:
        ratio = figures(worst, 2) if math.isfinite(worst) else "many"
        found.append(
            f"The held-out error is {ratio} times the fitted one: too few observations for so many parameters, or "
            "errors that the parameters do not model."
        )
    if e.chi2_reduced > CHI2_DOUBTFUL:
        alone = "" if e.pose_error else "; the σ of the parameters are based on the declared noise alone"
        found.append(
            f"Residuals are {figures(math.sqrt(e.chi2_reduced), 2)} times what the declared sigmas allow{alone}."
        )
    return found


def _held_out_ratio(e: Estimate, judged: HeldOut) -> float:
    """Return the ratio of held-out to fitted RMS, in the unit where it is worst."""
    rms = [(error.rms, e.rms_after[si]) for si, error in judged.figures.items() if si in e.rms_after]
    return max(
        (held / fitted if fitted > 0.0 else math.inf if held > 0.0 else 0.0 for held, fitted in rms), default=0.0
    )


def _tile(name: str, rms: Mapping[str, float], note: str, css: str) -> str:
    """Return a tile with one figure per SI unit."""
    sizes = "".join(
        f'<p class="figure">{size(value, si, "")}<span> {symbol(si)}</span></p>' for si, value in rms.items()
    )
    return f'<div class="tile {css}"><p class="name">RMS {name}</p>{sizes}<p class="small">{escape(note)}</p></div>'


def _pictures(page: CalibrationPage) -> str:
    e, table = page.estimate, page.table
    kinds = rows_by_kind(e, table, page.longitude)
    shown = [picture(figure, rows.title if len(kinds) > 1 else "") for rows in kinds for figure in figures_of(rows)]
    several = len(e.rms_history) > 1
    shown += [picture(of, symbol(si) if several else "") for si, of in zip(e.rms_history, convergences(e), strict=True)]
    words = [
        chi2_words(e),
        "" if few_freedom(e.chi2_freedom, e.rank) else parts_words(e.parts, e.chi2_reduced <= e.chi2_band[1], e.loss),
        pose_error_words(e.pose_error) if e.pose_error else "",
        predicted_words(page.predicted) if page.predicted else "",
    ]
    content = residual_table(summaries(e, table)) + "".join(f"<p>{escape(w, 600)}</p>" for w in words if w)
    return section("Residuals", content + (suspect_table(e, table) if e.suspect.size else "") + pictures(shown))


def _sight(e: Estimate) -> str:
    full_rank = e.rank == int(e.free[: e.n_robot_parameters].sum())
    return visibility(e) + observability_table(e) + addition_list(e.additions, full_rank)


def _parameters(e: Estimate) -> str:
    robot, rig = range(e.law_parameters.start), range(e.n_robot_parameters, len(e.parameter_names))
    parts = [
        "<p>A single parameter may differ from the drawing because of how the fixtures are mounted, or because it "
        "takes over the error of a parameter that is held fixed; judge the arm by its predictions.</p>",
        parameter_table(e, robot),
    ]
    if rig:
        summary = f"{counted(len(rig), 'parameter')} of the rig"
        parts.append(f"<details><summary>{summary}</summary>{parameter_table(e, rig)}</details>")
    drawn = correlation(e)
    return section("Parameters", "".join(parts) + (picture(drawn) if drawn else ""))


def _laws(page: CalibrationPage) -> str:
    """Return error curves and sag; "" if they were not requested."""
    if not page.laws:
        return ""
    rows = [(escape(name), fitted, held, escape(unit)) for unit, name, fitted, held in page.law_steps]
    steps = table_of(("fit", "fitted, RMS", "held out, mean", "unit"), rows, "fits", "numbers") if rows else ""
    return section(
        "Joint laws", sentences(page.laws, "remarks") + steps + pictures(map(picture, law_figures(page.curves)))
    )


def _prior(name: str) -> str:
    match Prior(name):
        case Prior.NONE:
            return "none"
        case Prior.WHERE_NEEDED:
            return f"where needed: nominal ± {', '.join(tolerances('weak'))}, for what the observations determine less accurately"
        case Prior.WEAK | Prior.WIDE as of_all:
            return f"{of_all}: nominal ± {', '.join(tolerances(of_all))}"
        case never:
            assert_never(never)


def _making(page: CalibrationPage) -> str:
    e = page.estimate
    facts = [
        ("solver", e.solver),
        ("loss", f"{e.loss}: {loss_summary(Loss(e.loss))}"),
        ("prior of the robot", _prior(page.prior)),
        ("iterations", str(e.iterations)),
        ("status", f"{e.status}: {e.message}" if e.message else e.status),
        ("χ² per degree of freedom", figures(e.chi2_reduced)),
        ("solver's time", f"{figures(e.seconds, 2)} s"),
    ]
    steps = step_table(page.steps) if page.steps else ""
    return section("How it was made", command_block(page.command) + fact_list(facts) + steps)
