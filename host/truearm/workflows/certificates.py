"""The certificates of a calibration and of its validation: what is on page one, as facts and sentences."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np

from truearm.estimate.mean_error import gain_of
from truearm.estimate.prediction import nominal_error, predicted_point_error
from truearm.estimate.result_file import Input
from truearm.findings import Finding
from truearm.kinds.registry import kinds
from truearm.kinds.table import ObservationTable
from truearm.report.page import Certificate, Facts, Recording, conditions, recorded, sensor_facts, shortened, size
from truearm.results import Figures, Gain
from truearm.text import counted
from truearm.types import Rigs, rigs_by_name, rms
from truearm.units import MM, PPM
from truearm.version import VERSION
from truearm.workflows.calibration import Calibration, Identification, masses_of
from truearm.workflows.correction_findings import COVERAGE, unexplained_error
from truearm.workflows.inputs import Observed
from truearm.workflows.project_file import Project
from truearm.workflows.validate import Validation

NOT_GIVEN = "not given"
FEWEST = 10  # rows whose error before is given
STEEL, ALUMINIUM = 12e-6, 23e-6  # 1/K
ALWAYS_EXCLUDED = (
    Finding("excludes-conditions", {"steel": PPM.of(STEEL), "aluminium": PPM.of(ALUMINIUM)}),
    Finding("excludes-repeatability"),
)


@dataclass(frozen=True)
class Issue:
    """Whom a certificate is for. ``tolerance`` [m] decides between pass and fail, None if none was given."""

    project: Project
    number: str = ""
    tolerance: float | None = None


def calibration_certificate(identification: Identification, issue: Issue, observed: Observed) -> Certificate:
    """Return page one of the report on an identification."""
    e, tool, recordings = identification.estimate, _tool_error(identification), observed.recordings
    nominal = nominal_error(identification.chain, identification.rig, identification.table, e)
    described = f"{size(rms(nominal), 'm')} RMS, {size(nominal.max(), 'm')} at most"
    unknown = f"not determined by {counted(len(nominal), 'row')}"  # which the placing of base and tool fits
    errors = (
        ("before: the nominal robot, base and tool placed", unknown if len(nominal) < FEWEST else described),
        (f"after: expanded uncertainty (k = {COVERAGE:g})", "not determined" if tool is None else size(tool, "m")),
        ("measured region", _region(identification, identification.table)),
    )
    n_fitted = int(e.used.sum())
    rows = [("left out as outliers", str(e.n_observations - n_fitted))] * (e.n_observations > n_fitted)
    for si, rms_after in e.rms_after.items():
        rows.append((f"{n_fitted} fitted, RMS", f"{size(e.rms_before[si], si)} before, {size(rms_after, si)} after"))
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
    return Certificate(
        f"Certificate of {'a simulated ' * identification.table.simulated}calibration",
        (
            ("What", _subject(identification, issue, recordings, "result")),
            ("Error of the tool in the measured region", errors),
            ("Observations and independent validation", tuple(rows)),
            ("Reference", _reference(identification.rig, identification.table, recordings)),
            ("Conditions", conditions(recordings)),
            ("Files read", _files(observed.inputs)),
        ),
        (
            _decision(issue.tolerance, judged, problem, held_out=held_out["m"].n if "m" in held_out else None),
            *_excluded(identification),
        ),
    )


def validation_certificate(
    calibration: Calibration, observed: Observed, validation: Validation, issue: Issue
) -> Certificate:
    """Return page one of the report on a validation."""
    rig, table, _, recordings, _, inputs = observed
    errors: list[tuple[str, str]] = []
    for si, figures in validation.after.items():
        errors.append(("without the calibration", _figures_text(validation.before[si], si)))
        errors.append(("with it", _figures_text(figures, si)))
        if si in validation.expected:
            errors.append(("expected from noise and calibration", f"{size(validation.expected[si], si)} RMS"))
    error = COVERAGE * validation.after["m"].rms if "m" in validation.after else None
    reused, simulated = bool(validation.document["identified_from"]), bool(validation.document["simulated"])
    no_help = any(finding.code == "validation-no-help" for finding in validation.findings)
    problem = calibration.stored.unusable_because or ("it does not help here" if no_help else None)
    decision = _decision(issue.tolerance, {"error": error}, problem, reused, rows=validation.n)
    lengths = any(kinds()[kind].components.count("m") < 3 for kind in np.unique(table.kind).tolist())
    return Certificate(
        f"Certificate of {'a simulated ' * simulated}validation",
        (
            ("What", _subject(calibration, issue, recordings, "validated result")),
            (
                f"Errors of {counted(validation.n, 'independent ' * (not reused) + 'measurement')}",
                (*errors, ("measured region", _region(calibration, table))),
            ),
            ("Reference", _reference(rig, table, recordings)),
            ("Conditions", conditions(recordings)),
            ("Files read", _files(inputs)),
        ),
        (
            decision,
            *[Finding("simulated")] * simulated,
            *[Finding("excludes-directions")] * lengths,
            *ALWAYS_EXCLUDED,
        ),
    )


def _subject(calibration: Calibration, issue: Issue, recordings: Sequence[Recording], result: str) -> Facts:
    project, checksum = issue.project, str(calibration.document.get("checksum", ""))[:12]
    version = calibration.document.get("truearm_version", "of unknown version")
    payloads = calibration.stored.payloads
    masses = ", ".join(masses_of(payloads)) if any(payload.mass for payload in payloads) else ""
    return (
        ("certificate", issue.number or NOT_GIVEN),
        ("issued", f"{datetime.now(UTC):%Y-%m-%d}"),
        ("measured", recorded(recordings)),
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
    """Return the expanded uncertainty [m] of the measured point, from covariance and unexplained error; None if unknown."""
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
    """Return whether the ``error`` [m] among the ``judged`` is within the tolerance; the others are what it is the larger of."""
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
    return f"{size(figures.rms, si)} RMS, {size(figures.max, si)} at most"


def _reference(rigs: Rigs, table: ObservationTable, recordings: Sequence[Recording]) -> Facts:
    """Return the sensors and the parts of the rig that the rows were measured against, with their declared uncertainties."""
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
    return shortened(tuple(facts)) + sensor_facts(recordings)


def _length(length: float, sigma: float) -> str:
    uncertainty = f"± {MM.of(COVERAGE * sigma):.3f} mm (k = {COVERAGE:g})" if sigma else "mm, taken as exact"
    return f"{MM.of(length):.3f} {uncertainty}"


def _files(inputs: Sequence[Input]) -> Facts:
    return shortened(tuple((f"{file.role}: {file.name}", f"SHA-256 {file.sha256}") for file in inputs))


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
