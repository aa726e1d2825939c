"""Write the page about an identification (``truearm identify --report``)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from truearm.disk import write_atomic
from truearm.estimate.law_curves import SampledCurve, sampled_curves
from truearm.kinds.registry import kinds
from truearm.kinds.table import ObservationTable
from truearm.model.chain import Chain
from truearm.results import Estimate, PredictedError
from truearm.types import Floats, Rigs, rigs_by_name

if TYPE_CHECKING:
    from truearm.report.certificate import Certificate, Recording
    from truearm.workflows.calibration import Identification


def write_page(
    path: Path,
    identification: Identification,
    command: str = "",
    recordings: Sequence[Recording] = (),
    certificate: Certificate | None = None,
) -> None:
    """Write the page, completely or not at all; ``recordings`` are the sessions read. Raises InputError if it cannot be
    written.
    """
    from truearm.report.calibration_page import CalibrationPage, render
    from truearm.report.certificate import facts_of
    from truearm.report.law_findings import law_steps
    from truearm.report.residual_rows import row_name
    from truearm.workflows.scene import calibration_scene

    table, estimate, predicted = identification.table, identification.estimate, identification.predicted
    document = identification.document
    files = dict.fromkeys(row_name(source).rsplit(" ", 2)[0] for source in table.source)  # "poses.csv row 17"
    page = CalibrationPage(
        title=f"Calibration of {identification.chain.name}",
        subtitle=", ".join(files),
        estimate=estimate,
        table=table,
        longitude=longitudes(identification.chain, identification.rig, table, estimate),
        command=command,
        predicted=predicted if predicted and _leads(predicted, estimate) else None,
        law_steps=tuple(step for suffix in document["residual_units"] for step in law_steps(document, suffix)),
        curves=_curves(identification),
        facts=(*facts_of(recordings), *_facts(table)),
        certificate=certificate,
        findings=identification.findings,
        scene=None if identification.estimate.unusable else calibration_scene(identification),
    )
    write_atomic(path, render(page))


def _curves(identification: Identification) -> tuple[SampledCurve, ...]:
    laws = identification.estimate.joint_laws.kept if identification.estimate.joint_laws else ()
    return sampled_curves(identification.chain, laws, identification.identified, identification.covariance)


def _facts(table: ObservationTable) -> tuple[tuple[str, str], ...]:
    """Return label and value of the facts about the rows of each kind."""
    rows_of_kinds = ((kind, table.select(table.kind == name)) for name, kind in kinds().items())
    return tuple(fact for kind, rows in rows_of_kinds if kind.facts and len(rows) for fact in kind.facts(rows))


def _leads(predicted: PredictedError, estimate: Estimate) -> bool:
    """Return whether the error of the tool to expect follows from the parameters."""
    if estimate.without_bad_rows is not None:
        return False
    return not estimate.unexplained or predicted.exceeds(estimate.unexplained)


def longitudes(chain: Chain, rig: Rigs, table: ObservationTable, estimate: Estimate) -> Floats:
    """Return the longitude (n,) [rad] of the rows of each kind that has one, with the identified robot; else NaN.

    For a sphere it is measured about its chuck.
    """
    out, params = np.full(len(table), np.nan), estimate.value[: estimate.n_robot_parameters]
    for name, kind in kinds().items():
        for rig_name, entries in rigs_by_name(rig).items():
            rows = np.flatnonzero((table.kind == name) & (table.rig == rig_name))
            if kind.longitude and rows.size:
                out[rows] = kind.longitude(chain, params, entries, table.select(rows))
    return out
