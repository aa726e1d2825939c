"""The pages of a result and of its validation, with their certificates (``truearm report``, ``validate --report``)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from truearm.disk import sha256, write_atomic
from truearm.errors import Argument, InputError, noting
from truearm.estimate.result_file import Result, read_result
from truearm.findings import entries, findings_of
from truearm.model.robot_file import load_robot
from truearm.progress import step
from truearm.report.page import Certificate, certificate_section, html_page, making, section, table
from truearm.report.validation_findings import error_tables
from truearm.workflows.calibration import Identification, frames_of, read_calibration
from truearm.workflows.calibration_report import write_page
from truearm.workflows.certificates import Issue, calibration_certificate, validation_certificate
from truearm.workflows.identify import IdentifyFiles, IdentifyOptions, identified
from truearm.workflows.inputs import check_files, hashed_inputs, read_sources
from truearm.workflows.project import folders_of
from truearm.workflows.project_file import find_project
from truearm.workflows.validate import Validation, validated

SAME = 1e-3  # of a parameter's σ: covers the arithmetic of another machine, but not another fit


@step("repeating the identification")
def report_files(result: Path, files: IdentifyFiles, out: Path, issue: Issue) -> Certificate:
    """Repeat the fit as recorded in the result, check that the outcome is the same, write the page ``out``, and return its certificate.

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

    If there is a page ``files.report``, write it, and add the findings of its certificate, the decision after the verdict.
    Raises InputError with a one-line message.
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


def validation_page(robot: str, certificate: Certificate, document: Mapping[str, Any], command: str) -> str:
    """Return the page of a validation as HTML text; ``document`` is what ``truearm validate --json`` prints."""
    blocks = section("Errors", *map(table, error_tables(document))), making(command)
    title, first = f"Validation of {robot}", certificate_section(certificate)
    return html_page("truearm validate", title, "", blocks, findings_of(document), certificate=first)


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
    """Raise InputError if the fit differs from the stored one; ``same_inputs``: nothing that was given can be the cause."""
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
