"""The HTML report of a calibration: what result.json says, with pictures of the residuals and the joint laws.

Names and notes may come from external files; blocks escape all text.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from truearm.estimate.law_curves import SampledCurve
from truearm.findings import findings_of
from truearm.report import page, result_tables
from truearm.report.figures import ResidualRows, figures_of, law_figures
from truearm.report.page import ABSENT, Certificate, Facts, Scene, certificate_section, figures
from truearm.report.result_findings import sizes
from truearm.text import counted
from truearm.units import SUFFIXES

Document = Mapping[str, Any]

MAX_DIRECTIONS = 40
MAX_TERMS = 6
LEADING = ("tool-error", "tool-error-by-sigmas")  # findings that expect the predicted error of the tool


def render(
    document: Document,
    rows: Sequence[ResidualRows],
    curves: Sequence[SampledCurve] = (),
    facts: Facts = (),
    command: str = "",
    certificate: Certificate | None = None,
    scene: Scene | None = None,
) -> str:
    """Return the page as HTML text, to be written as UTF-8.

    ``document`` is the content of result.json, ``rows`` are its observations by kind. ``facts`` are labels and values
    about the recording, ``command`` is the command that makes the page again, ``certificate`` is page one.
    """
    steps = (step for suffix in document["residual_units"] for step in result_tables.law_steps(document, suffix))
    blocks = (
        page.section("Residuals", *_residuals(document, rows)),
        page.section("Parameters", *_parameters(document["parameters"])),
        page.section("Joint laws", *map(page.table, steps), page.pictures(law_figures(curves))),
        page.section("Unidentifiable and weakly identifiable combinations", *_combinations(document)),
        page.section("The recording", page.fact_list(facts)),
        page.making(command, _facts(document)),
    )
    files = dict.fromkeys(entry["name"] for entry in document["inputs"] if entry["role"] == "observations")
    return page.html_page(
        "truearm",
        f"Calibration of {document['robot']['name']}",
        ", ".join(files),
        blocks,
        findings_of(document),
        figures=page.tiles(_tiles(document)),
        certificate=certificate_section(certificate) if certificate else "",
        scene=scene,
    )


def _tiles(document: Document) -> Iterator[page.Tile]:
    n_fitted = sum(entry["fitted"] for entry in document["observations"])
    error_before, raw = (sizes(document, name) for name in ("rms_before", "rms_raw"))
    placed = " with base and tool fitted" * (error_before != raw)
    yield "old", "RMS before", error_before, f"{counted(n_fitted, 'fitted observation')}, the nominal robot{placed}"
    if not result_tables.has_little_freedom(document):
        yield "fit", "RMS after", sizes(document, "rms_after"), "the same observations, identified parameters"
    if judged := document["held_out"]:
        largest = sizes(judged, "max")
        remark = "; ".join(
            f"mean {figures(mean)}, largest {figures(largest[suffix])} {SUFFIXES[suffix].symbol}".rstrip()
            for suffix, mean in sizes(judged, "mean").items()
        )
        note = f"{counted(judged['n'], 'observation')} not used to fit; {remark}"
        yield "val", "RMS held out", sizes(judged, "rms"), note
    predicted = document["predicted_error"]
    if predicted and any(finding.code in LEADING for finding in findings_of(document)):
        over = f"over {counted(predicted['n'], 'pose')}; at most {figures(predicted['max_mm'])} mm"
        remark = f"from the parameters, faults that the rows do not exclude and the arm's own scatter, {over}"
        yield "old", "RMS of the tool, predicted", {"mm": predicted["rms_mm"]}, remark


def _residuals(document: Document, rows: Sequence[ResidualRows]) -> Iterator[str]:
    kinds = dict.fromkeys(entry["kind"] for entry in document["observations"])
    yield page.paragraph(" ".join(map(result_tables.residual_words, kinds)))
    yield from (page.table(result_tables.errors_of_fit(document, suffix)) for suffix in document["residual_units"])
    if outliers := document["suspect"]:
        yield page.table(result_tables.outlier_table(outliers))
    yield page.pictures(
        figure._replace(title=f"{figure.title} · {rows_of_kind.title}") if len(rows) > 1 else figure
        for rows_of_kind in rows
        for figure in figures_of(rows_of_kind)
    )


def _parameters(entries: Sequence[Document]) -> Iterator[str]:
    robot = [entry for entry in entries if entry["of"] == "robot" and not entry.get("law")]
    rig = [entry for entry in entries if entry["of"] == "rig"]
    yield page.paragraph(
        "A single parameter may differ from the drawing because of how the fixtures are mounted, or because it "
        "takes over the error of a parameter that is held fixed; judge the arm by its predictions."
    )
    yield page.table(result_tables.parameter_table(robot), "numbers")
    if rig:
        yield page.folded(
            f"{counted(len(rig), 'parameter')} of the rig", page.table(result_tables.parameter_table(rig), "numbers")
        )


def _combinations(document: Document) -> Iterator[str]:
    for heading, remark, texts in result_tables.combinations(document, MAX_DIRECTIONS, MAX_TERMS):
        yield page.paragraph(heading) + page.sentences(texts, "directions") + page.paragraph(remark)


def _facts(document: Document) -> Facts:
    status, message, chi2 = (document[name] for name in ("status", "message", "chi2_reduced"))
    return (
        ("iterations", str(document["iterations"])),
        ("χ² per degree of freedom", ABSENT if chi2 is None else figures(chi2)),
        ("status", f"{status}: {message}" if message else status),
    )
