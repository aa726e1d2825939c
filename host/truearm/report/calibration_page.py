"""The HTML report of a calibration: the verdict, the pictures, the parameters, unidentifiable directions, how it was
made.

Names and notes may come from external files; all text passes through ``truearm.report.page_text.escape``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import assert_never

from truearm.estimate.law_curves import SampledCurve
from truearm.estimate.solvers import Loss, Prior, loss_summary
from truearm.findings import Finding
from truearm.kinds.table import ObservationTable
from truearm.report.calibration_tables import (
    observability_table,
    parameter_table,
    residual_table,
    suspect_table,
    visibility,
)
from truearm.report.certificate import Certificate, certificate_section
from truearm.report.figures import convergences, figures_of
from truearm.report.page_parts import (
    command_block,
    fact_list,
    finding_parts,
    html_page,
    picture,
    pictures,
    section,
    table_of,
    tiles,
)
from truearm.report.page_text import escape, figures, size
from truearm.report.parameter_figures import correlation, law_figures
from truearm.report.residual_rows import rows_by_kind
from truearm.report.result_words import before_words
from truearm.report.scene_view import Scene, script, view_section
from truearm.results import Estimate, PredictedError
from truearm.text import counted
from truearm.types import Floats
from truearm.units import symbol, tolerances


@dataclass(frozen=True)
class CalibrationPage:
    """The content of the page.

    ``estimate`` was made from ``table``, whose n rows include fitted and held-out ones. ``longitude`` (n,) [rad] is
    that of the sphere about its chuck, NaN for rows without one. ``facts`` are labels and values about the recording,
    ``command`` the command that makes the page again. ``prior`` is
    the name of the robot's prior, ``predicted`` the predicted error of the tool from the parameters' covariance.

    Raises ValueError if table, longitude and estimate have different numbers of rows.
    """

    title: str
    subtitle: str
    estimate: Estimate
    table: ObservationTable
    longitude: Floats  # (n,) rad
    facts: tuple[tuple[str, str], ...] = ()
    command: str = ""
    prior: str = "none"
    predicted: PredictedError | None = None
    law_steps: tuple[tuple[str, str, str, str], ...] = ()  # unit, fit, fitted RMS, held-out mean
    curves: tuple[SampledCurve, ...] = ()
    certificate: Certificate | None = None  # shown on page one
    findings: tuple[Finding, ...] = ()  # the verdict first
    scene: Scene | None = None

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
        view_section(page.scene),
        _notes(page),
        _pictures(page),
        _parameters(page.estimate),
        _laws(page),
        section("Identifiable and unidentifiable combinations", _sight(page.estimate)),
        section("The recording", fact_list(page.facts)) if page.facts else "",
        _making(page),
    )
    simulated = page.table.simulated
    title, watermark = page.title + " (simulated)" * simulated, "simulated" * simulated
    return html_page("truearm", title, page.subtitle, sections, watermark, script(page.scene))


def _verdict(page: CalibrationPage) -> str:
    e, judged = page.estimate, page.estimate.held_out
    n_used = counted(int(e.used.sum()), "fitted observation")
    entries = [("old", "RMS before", _sizes(e.rms_before), f"{n_used}, the nominal robot{before_words(e)}")]
    if not e.has_little_freedom:
        entries.append(("fit", "RMS after", _sizes(e.rms_after), "the same observations, identified parameters"))
    if judged:
        of_units = judged.figures.items()
        more = "; ".join(f"mean {size(error.mean, si, '')}, largest {size(error.max, si)}" for si, error in of_units)
        held_out = _sizes({si: error.rms for si, error in of_units})
        entries.append(("val", "RMS held out", held_out, f"{counted(judged.n, 'observation')} not used to fit; {more}"))
    if page.predicted:
        over = f"over {counted(page.predicted.n, 'pose')}; at most {size(page.predicted.largest, 'm')}"
        more = f"from the parameters, faults that the rows do not exclude and the arm's own scatter, {over}"
        entries.append(("old", "RMS of the tool, predicted", _sizes({"m": page.predicted.rms}), more))
    verdict, doubts, _ = finding_parts(page.findings) if page.findings else ("", "", "")
    return f"<section>{verdict}{tiles(entries)}{doubts}</section>\n"


def _sizes(errors: Mapping[str, float]) -> list[tuple[str, str]]:
    return [(size(value, si, ""), symbol(si)) for si, value in errors.items()]


def _notes(page: CalibrationPage) -> str:
    notes = finding_parts(page.findings)[2] if page.findings else ""
    return section("Notes", notes) if notes else ""


def _pictures(page: CalibrationPage) -> str:
    e, table = page.estimate, page.table
    kinds = rows_by_kind(e, table, page.longitude)
    shown = [picture(figure, rows.title if len(kinds) > 1 else "") for rows in kinds for figure in figures_of(rows)]
    several = len(e.rms_history) > 1
    shown += [picture(of, symbol(si) if several else "") for si, of in zip(e.rms_history, convergences(e), strict=True)]
    content = residual_table(e, table) + (suspect_table(e, table) if e.suspect.any() else "")
    return section("Residuals", content + pictures(shown))


def _sight(e: Estimate) -> str:
    return visibility(e) + observability_table(e)


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
    """Return the fits with joint laws, and the error curves; "" without any."""
    rows = [(escape(name), fitted, held, escape(unit)) for unit, name, fitted, held in page.law_steps]
    steps = table_of(("fit", "fitted, RMS", "held out, mean", "unit"), rows, "fits", "numbers") if rows else ""
    drawn = pictures(map(picture, law_figures(page.curves)))
    return section("Joint laws", steps + drawn) if steps or drawn else ""


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
    return section("How it was made", command_block(page.command) + fact_list(facts))
