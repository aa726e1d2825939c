"""``truearm identify --report``: the page about an identification."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from truearm.estimate.problem import Rigs
from truearm.files.disk import write_atomic
from truearm.model.chain import Chain, point_forward
from truearm.types import Estimate, Floats, ObservationTable, Rig

if TYPE_CHECKING:
    from truearm.workflows.identify import Identification

UNPREDICTED = (
    "How far the tool may be off at a pose is not determined: changes of the parameters that these observations do not see, or hardly, "
    "would move it. The residuals say how well the observations are predicted."
)


def write_page(path: Path, found: Identification, command: str = "") -> None:
    """Write the page whole or not at all. Raises InputError when the place cannot be written."""
    from truearm.report.calibration_page import CalibrationPage, render
    from truearm.report.residual_rows import row_name

    table, estimate = found.table, found.estimate
    files = dict.fromkeys(row_name(source).rsplit(" ", 2)[0] for source in table.source)  # "poses.csv row 17"
    page = CalibrationPage(
        title=f"Calibration of {found.chain.name}",
        subtitle=", ".join(files),
        estimate=estimate,
        table=table,
        longitude=longitudes(found.chain, found.rig, table, estimate),
        command=command,
        prior=found.prior,
        predicted=found.predicted,
        facts=_driven(table),
        notes=(*_timing(estimate), *(() if found.predicted else (UNPREDICTED,))),
    )
    write_atomic(path, render(page))


def _driven(table: ObservationTable) -> tuple[tuple[str, str], ...]:
    """What was measured in motion, as label and value; nothing without lines."""
    lines = table.kind == "line"
    moving = lines & np.isfinite(table.q_rate).all(axis=1)
    if not moving.any():
        return ()
    ways = {(name, group) for name, group in zip(table.line[moving], table.shell[moving], strict=True)}
    names = sorted({str(name) for name, _ in ways})
    both = sum(sum(name == one for name, _ in ways) > 1 for one in names)
    return (
        ("lines driven", f"{', '.join(names[:20])}; {both} of {len(names)} there and back"),
        ("points on lines", f"{int(moving.sum())} in motion, {int((lines & ~moving).sum())} at rest"),
    )


def _timing(estimate: Estimate) -> list[str]:
    """How late the joint readings are, a sentence for each rig that has a time offset."""
    from truearm.report.words import time_offset

    sigma = np.where(np.isfinite(estimate.sigma), estimate.sigma, np.nan)
    return [
        time_offset(
            estimate.parameter_names[i], float(estimate.value[i]), None if np.isnan(sigma[i]) else float(sigma[i])
        )
        for i in np.flatnonzero(estimate.free & (np.array(estimate.units) == "s"))
    ]


def longitudes(chain: Chain, rig: Rigs, table: ObservationTable, estimate: Estimate) -> Floats:
    """(n,) [rad] longitude of the sphere about its chuck with the identified robot; NaN where a row has none."""
    rigs: Mapping[str, Rig] = {"": rig} if isinstance(rig, Rig) else rig
    out = np.full(len(table), np.nan)
    bars = np.flatnonzero(table.kind == "ball_bar")
    if bars.size:
        of = [rigs[str(name)] for name in table.rig[bars]]
        spheres = np.array([one.spheres[str(name)].xyz for one, name in zip(of, table.sphere[bars], strict=True)])
        chucks = np.array([one.chucks[str(name)].xyz for one, name in zip(of, table.chuck[bars], strict=True)])
        apart = point_forward(chain, estimate.value[: estimate.n_robot_parameters], table.q[bars], spheres) - chucks
        out[bars] = np.arctan2(apart[:, 1], apart[:, 0])
    return out
