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
from truearm.results import Estimate
from truearm.types import Floats, Rigs, rigs_by_name

if TYPE_CHECKING:
    from truearm.report.page import Certificate, Recording
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
    from truearm.report.calibration_page import render
    from truearm.report.figures import rows_by_kind
    from truearm.report.page import facts_of
    from truearm.workflows.scene import calibration_scene

    table, estimate = identification.table, identification.estimate
    rows = rows_by_kind(estimate, table, longitudes(identification.chain, identification.rig, table, estimate))
    facts = (*facts_of(recordings), *_facts(table))
    scene = None if estimate.unusable else calibration_scene(identification)
    page = render(identification.document, rows, _curves(identification), facts, command, certificate, scene)
    write_atomic(path, page)


def _curves(identification: Identification) -> tuple[SampledCurve, ...]:
    laws = identification.estimate.joint_laws.kept if identification.estimate.joint_laws else ()
    return sampled_curves(identification.chain, laws, identification.identified, identification.covariance)


def _facts(table: ObservationTable) -> tuple[tuple[str, str], ...]:
    """Return label and value of the facts about the rows of each kind."""
    rows_of_kinds = ((kind, table.select(table.kind == name)) for name, kind in kinds().items())
    return tuple(fact for kind, rows in rows_of_kinds if kind.facts and len(rows) for fact in kind.facts(rows))


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
