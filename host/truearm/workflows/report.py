"""The pages of a result and of its validation, with their certificates (``truearm report``, ``validate --report``)."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from truearm.disk import sha256, write_atomic
from truearm.errors import Argument, InputError, noting
from truearm.estimate.prediction import nominal_error, predicted_point_error
from truearm.estimate.result_file import Input, Result, read_result
from truearm.estimate.validation import gain_of
from truearm.findings import Finding, entries, findings_of
from truearm.kinds.registry import kinds
from truearm.kinds.table import ObservationTable
from truearm.model.robot_file import load_robot
from truearm.progress import step
from truearm.report import page
from truearm.report.validation_findings import error_tables
from truearm.results import Figures, Gain
from truearm.text import counted
from truearm.types import Rigs, rigs_by_name, rms
from truearm.units import MM, PPM
from truearm.version import VERSION
from truearm.workflows.calibration import Calibration, Identification, frames_of, masses_of, read_calibration
from truearm.workflows.correction_findings import COVERAGE, unexplained_error
from truearm.workflows.identify import IdentifyFiles, IdentifyOptions, identified, write_page
from truearm.workflows.inputs import Observed, check_files, hashed_inputs, read_sources
from truearm.workflows.project import folders_of
from truearm.workflows.project_file import Project, find_project
from truearm.workflows.validate import Validation, validated

SAME = 1e-3  # of a parameter's σ: covers the arithmetic of another machine, but not another fit
NOT_GIVEN = "not given"
FEWEST = 10  # rows whose error before is given
STEEL, ALUMINIUM = 12e-6, 23e-6  # 1/K
ALWAYS_EXCLUDED = (
    Finding("excludes-conditions", {"steel": PPM.of(STEEL), "aluminium": PPM.of(ALUMINIUM)}),
    Finding("excludes-repeatability"),
)


@step("repeating the identification")
def report_files(result: Path, files: IdentifyFiles, out: Path, issue: Issue) -> page.Certificate:
    """Repeat a result's fit, write the page ``out`` if the outcome is the same, and return its certificate.

    Of the given sessions and tables, only those used for the result are read; without any, they are looked for near the
    result and in the project. Raises InputError if the result does not record how it was made, or if the files are not
    the original ones or give another result.
    """
    stored = read_result(result)
    options, hold_out = _options(result, stored.made_with)
    typed = files.sources
    measured = {entry.sha256 for entry in stored.inputs if entry.role == "observations"}
    named = tuple(path for path in typed.inputs if sha256(path) in measured)
    rigs = _nearby(result, stored, "rig") if not typed.rigs else []
    sources = replace(
        typed,
        inputs=named or typed.inputs or tuple(_nearby(result, stored, "observations")),
        rigs={"": rigs[0]} if len(rigs) == 1 else typed.rigs,
        noise=next(iter(_nearby(result, stored, "noise")), None),
    )
    choice = files.robot
    check_files(sources, choice, [("page", out)], files.force)
    inputs = hashed_inputs(sources, choice)
    _check_inputs(result, stored, {file.sha256 for file in inputs})
    name = choice.robot or stored.robot.name
    robot = load_robot(name, *frames_of(name, choice.base, choice.tip, stored))
    observed = read_sources(sources, robot.chain, robot)._replace(inputs=inputs)
    with noting(observed.findings):
        identification = identified(robot, observed, hold_out, options)
    same_files = {file.sha256 for file in inputs} == {file.sha256 for file in stored.inputs}
    same_robot = bool(choice.files) or choice.robot in (None, stored.robot.name)
    lines = any(count["lines"] for count in observed.counts)
    _check_same(result, stored.column("value"), identification, same_files and same_robot and not lines)
    certificate = calibration_certificate(identification, issue, observed)
    with step("drawing the report"):
        write_page(out, identification, files.command, observed.recordings, certificate)
    return certificate


def _nearby(result: Path, stored: Result, role: str) -> list[Path]:
    """Return the files that a result was made from in a role, from its folder, the working folder and the project."""
    project = find_project(Path.cwd())
    folders = [result.parent, Path.cwd(), *([] if project is None else folders_of(project.parent))]
    entries = [entry for entry in stored.inputs if entry.role == role]
    places = ((entry.sha256, folder / entry.name) for entry in entries for folder in folders)
    return list({digest: path for digest, path in places if path.is_file() and sha256(path) == digest}.values())


@step("validating")
def validate_files(result: Path, files: IdentifyFiles, issue: Issue, keep_rig: bool = False) -> Validation:
    """Judge a result by independent observations; ``keep_rig`` as in ``validated``.

    If there is a page ``files.report``, write it, and add the findings of its certificate, the decision after the
    verdict. Raises InputError with a one-line message.
    """
    calibration, sources = read_calibration(result, files.robot), files.sources
    check_files(sources, files.robot, [("page", files.report)], files.force)
    observed = read_sources(sources, calibration.chain)._replace(inputs=hashed_inputs(sources, files.robot))
    with noting(observed.findings):
        validation = validated(calibration, observed, keep_rig)
    if files.report is not None:
        certificate = validation_certificate(calibration, observed, validation, issue)
        name = calibration.chain.name
        write_atomic(files.report, validation_page(name, certificate, validation.document, files.command))
        decision, *excluded = entries(finding for finding in certificate.findings if finding.code != "simulated")
        stated, place = validation.document["findings"], 1 + validation.document["simulated"]
        is_stated = decision["code"] in (entry["code"] for entry in stated)
        findings = [*stated[:place], *[decision] * (not is_stated), *stated[place:], *excluded]
        return replace(validation, document={**validation.document, "findings": findings})
    return validation


def validation_page(robot: str, certificate: page.Certificate, document: Mapping[str, Any], command: str) -> str:
    """Return the page of a validation as HTML text; ``document`` is what ``truearm validate --json`` prints."""
    blocks = page.section("Errors", *map(page.table, error_tables(document))), page.making(command)
    title, first = f"Validation of {robot}", page.certificate_section(certificate)
    return page.html_page("truearm validate", title, "", blocks, findings_of(document), certificate=first)


def _options(path: Path, made_with: Mapping[str, Any] | None) -> tuple[IdentifyOptions, tuple[str, ...]]:
    """Return the options recorded in the result. Raises InputError."""
    if made_with is None:
        raise InputError(
            f"{path}: does not say how it was made (truearm demo or an earlier truearm wrote it); identify again with truearm identify"
        )
    try:
        options = IdentifyOptions(**{name: value for name, value in made_with.items() if name != "hold_out"})
        return options, msgspec.convert(made_with.get("hold_out", ()), tuple[str, ...])
    except (TypeError, InputError, msgspec.ValidationError) as exc:
        raise InputError(
            f"{path}: made_with: {exc}; identify again, or update truearm if a later one wrote it"
        ) from None


def _check_inputs(path: Path, stored: Result, hashes: set[str]) -> None:
    """Raise InputError if a file used for the result is not among those given."""
    for entry in stored.inputs:
        if entry.sha256 not in hashes:
            raise InputError(
                f"{path}: was made from {entry.role} {entry.name}, which is not among the files given, or was changed since; give that file unchanged, or identify again"
            )


def _check_same(
    path: Path, value: np.ndarray[Any, np.dtype[np.float64]], identification: Identification, same_inputs: bool
) -> None:
    """Raise InputError if the fit differs from the stored one.

    ``same_inputs``: nothing that was given can be the cause.
    """
    e, n = identification.estimate, min(len(value), len(identification.estimate.value))
    tolerance = SAME * np.where(np.isfinite(e.sigma), e.sigma, np.inf)[:n]
    differs = (np.abs(e.value[:n] - value[:n]) > tolerance) & (e.free & e.identifiable)[:n]
    if differs.any() or len(e.value) != len(value):
        name = e.parameter_names[int(np.argmax(differs))]
        text = f"{path}: the files given lead to another result (first difference: {name}); "
        if same_inputs:
            raise InputError(
                f"{text}they are those that it was made with, by another version of truearm: identify again"
            )
        raise InputError(f"{text}give only the files that it was made with, and the same ", Argument("line_points"))


@dataclass(frozen=True)
class Issue:
    """Whom a certificate is for. ``tolerance`` [m] decides between pass and fail, None if none was given."""

    project: Project
    number: str = ""
    tolerance: float | None = None


def calibration_certificate(identification: Identification, issue: Issue, observed: Observed) -> page.Certificate:
    """Return page one of the report on an identification."""
    e, tool, recordings = identification.estimate, _tool_error(identification), observed.recordings
    nominal = nominal_error(identification.chain, identification.rig, identification.table, e)
    described = f"{page.size(rms(nominal), 'm')} RMS, {page.size(nominal.max(), 'm')} at most"
    unknown = f"not determined by {counted(len(nominal), 'row')}"  # which the placing of base and tool fits
    errors = (
        ("before: the nominal robot, base and tool placed", unknown if len(nominal) < FEWEST else described),
        (f"after: expanded uncertainty (k = {COVERAGE:g})", "not determined" if tool is None else page.size(tool, "m")),
        ("measured region", _region(identification, identification.table)),
    )
    n_fitted = int(e.used.sum())
    rows = [("left out as outliers", str(e.n_observations - n_fitted))] * (e.n_observations > n_fitted)
    for si, rms_after in e.rms_after.items():
        rows.append(
            (f"{n_fitted} fitted, RMS", f"{page.size(e.rms_before[si], si)} before, {page.size(rms_after, si)} after")
        )
    held_out, groups = (
        {} if e.held_out is None else e.held_out.figures,
        ", ".join(identification.document["held_out_by"]),
    )
    rows += [(f"{figures.n} held out ({groups})", _figures_text(figures, si)) for si, figures in held_out.items()]
    rows += [("independent validation", "none")] * (not held_out)
    judged = {"error": tool}
    if tool is not None and "m" in held_out:
        twice = COVERAGE * held_out["m"].rms
        judged = {"error": max(tool, twice), "uncertainty": tool, "twice": twice}
    gain = gain_of(e.mean_change) is Gain.NONE
    problem = "it is no better than the nominal robot" if gain else identification.stored.unusable_because
    return page.Certificate(
        f"Certificate of {'a simulated ' * identification.table.simulated}calibration",
        (
            ("What", _subject(identification, issue, recordings, "result")),
            ("Error of the tool in the measured region", errors),
            ("Observations and independent validation", tuple(rows)),
            ("Reference", _reference(identification.rig, identification.table, recordings)),
            ("Conditions", page.conditions(recordings)),
            ("Files read", _files(observed.inputs)),
        ),
        (
            _decision(issue.tolerance, judged, problem, held_out=held_out["m"].n if "m" in held_out else None),
            *_excluded(identification),
        ),
    )


def validation_certificate(
    calibration: Calibration, observed: Observed, validation: Validation, issue: Issue
) -> page.Certificate:
    """Return page one of the report on a validation."""
    rig, table, _, recordings, _, inputs = observed
    errors: list[tuple[str, str]] = []
    for si, figures in validation.after.items():
        errors.append(("without the calibration", _figures_text(validation.before[si], si)))
        errors.append(("with it", _figures_text(figures, si)))
        if si in validation.expected:
            errors.append(("expected from noise and calibration", f"{page.size(validation.expected[si], si)} RMS"))
    error = COVERAGE * validation.after["m"].rms if "m" in validation.after else None
    reused, simulated = bool(validation.document["identified_from"]), bool(validation.document["simulated"])
    no_help = any(finding.code == "validation-no-help" for finding in validation.findings)
    problem = calibration.stored.unusable_because or ("it does not help here" if no_help else None)
    decision = _decision(issue.tolerance, {"error": error}, problem, reused, rows=validation.n)
    lengths = any(kinds()[kind].components.count("m") < 3 for kind in np.unique(table.kind).tolist())
    return page.Certificate(
        f"Certificate of {'a simulated ' * simulated}validation",
        (
            ("What", _subject(calibration, issue, recordings, "validated result")),
            (
                f"Errors of {counted(validation.n, 'independent ' * (not reused) + 'measurement')}",
                (*errors, ("measured region", _region(calibration, table))),
            ),
            ("Reference", _reference(rig, table, recordings)),
            ("Conditions", page.conditions(recordings)),
            ("Files read", _files(inputs)),
        ),
        (decision, *[Finding("simulated")] * simulated, *[Finding("excludes-directions")] * lengths, *ALWAYS_EXCLUDED),
    )


def _subject(calibration: Calibration, issue: Issue, recordings: Sequence[page.Recording], result: str) -> page.Facts:
    project, checksum = issue.project, str(calibration.document.get("checksum", ""))[:12]
    version = calibration.document.get("truearm_version", "of unknown version")
    payloads = calibration.stored.payloads
    masses = ", ".join(masses_of(payloads)) if any(payload.mass for payload in payloads) else ""
    return (
        ("certificate", issue.number or NOT_GIVEN),
        ("issued", f"{datetime.now(UTC):%Y-%m-%d}"),
        ("measured", page.recorded(recordings)),
        ("customer", project.customer or NOT_GIVEN),
        ("arm", project.name or calibration.chain.name),
        ("model", calibration.chain.name),
        ("serial number", project.serial or NOT_GIVEN),
        ("controller", project.controller or NOT_GIVEN),
        ("payload", f"{masses} kg" if masses else "none declared: as mounted during the measurement"),
        ("operator", project.operator or NOT_GIVEN),
        ("software", f"truearm {VERSION}"),
        (result, f"{checksum or 'without checksum'}, by truearm {version}"),
    )


def _tool_error(identification: Identification) -> float | None:
    """Return the expanded uncertainty [m] of the measured point, from covariance and unexplained error.

    None if unknown.
    """
    e = identification.estimate
    if e.status != "converged" or e.unusable:
        return None
    any_base = bool(identification.document["defaults"]["base"])
    predicted = identification.predicted or predicted_point_error(
        identification.chain, identification.rig, identification.table, e, any_base
    )
    unexplained = unexplained_error(identification.document)[0]
    return None if predicted is None else COVERAGE * math.hypot(predicted.rms, unexplained)


def _decision(
    tolerance: float | None, judged: Mapping[str, float | None], problem: str | None, reused: bool = False, **rows: Any
) -> Finding:
    """Return the decision: whether the ``error`` [m] among the ``judged`` is within the tolerance, if that is decided.

    The error is the larger of the others.
    """
    if problem:
        return Finding("calibration-unusable", {"because": problem})
    error = judged["error"]
    if error is None or reused:
        return Finding("not-decided", {"reused": reused})
    limit = None if tolerance is None else {"mm": MM.of(tolerance)}
    values = {name: None if value is None else {"mm": MM.of(value)} for name, value in judged.items()}
    return Finding(
        "tolerance-exceeded" if tolerance is not None and error > tolerance else "certified",
        {**values, "tolerance": limit, **rows},
    )


def _region(calibration: Calibration, table: ObservationTable) -> str:
    points = MM.of(calibration.forward(table.q)[:, :3, 3])
    spans = zip("xyz", points.min(axis=0), points.max(axis=0), strict=True)
    axes = ", ".join(f"{axis} {low:.0f} to {high:.0f}" for axis, low, high in spans)
    return f"{len(table)} rows, {calibration.chain.end_frame} at {axes} mm in {calibration.chain.base_frame}"


def _figures_text(figures: Figures, si: str) -> str:
    return f"{page.size(figures.rms, si)} RMS, {page.size(figures.max, si)} at most"


def _reference(rigs: Rigs, table: ObservationTable, recordings: Sequence[page.Recording]) -> page.Facts:
    """Return the sensors and parts of the rig that the rows were measured with, and their declared uncertainties."""
    facts: list[tuple[str, str]] = []
    for rig in rigs_by_name(rigs).values():
        bars = [rig.bars[name] for name in rig.bars if name in table.bar]
        trackers = [rig.trackers[name] for name in rig.trackers if name in table.tracker]
        facts += [(f"ball-bar {bar.name}", _length(bar.zero, bar.zero_sigma)) for bar in bars]
        facts += [
            (f"sockets {' and '.join(d.sockets)} apart", _length(d.distance, d.sigma)) for d in rig.socket_distances
        ]
        facts += [(f"tracker {t.name}", f"σ {MM.text(math.sqrt(np.trace(t.sensor_cov)), '.3f')}") for t in trackers]
        if (table.kind == "seat").any():
            facts.append(("seats in sockets", f"σ {MM.text(rig.seat_sigma)} along each axis"))
    return page.shortened(tuple(facts)) + page.sensor_facts(recordings)


def _length(length: float, sigma: float) -> str:
    uncertainty = f"± {MM.of(COVERAGE * sigma):.3f} mm (k = {COVERAGE:g})" if sigma else "mm, taken as exact"
    return f"{MM.of(length):.3f} {uncertainty}"


def _files(inputs: Sequence[Input]) -> page.Facts:
    return page.shortened(tuple((f"{file.role}: {file.name}", f"SHA-256 {file.sha256}") for file in inputs))


def _excluded(identification: Identification) -> Iterator[Finding]:
    """Return what the error of the tool does not include."""
    if identification.simulated:
        yield Finding("simulated")
    if identification.predicted and identification.predicted.relative:
        yield Finding("excludes-displacement")
    rigs = rigs_by_name(identification.rig).values()
    exact = {name for rig in rigs for name, bar in rig.bars.items() if not bar.zero_sigma}
    if names := sorted(exact & set(identification.table.bar.tolist())):
        yield Finding("excludes-lengths", {"bars": names})
    if identification.estimate.held_out is None:
        yield Finding("excludes-other-poses")
    yield from ALWAYS_EXCLUDED
