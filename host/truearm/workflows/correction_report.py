"""Format the findings of a correction as a page."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from truearm.findings import Finding
from truearm.report.correction_page import CorrectionPage
from truearm.text import counted, one_line
from truearm.types import Floats
from truearm.units import MM, MRAD, shown, symbol
from truearm.workflows.calibration import Calibration
from truearm.workflows.correction_findings import STRAIGHT, Findings, Refused


def page_of(
    found: Findings,
    calibration: Calibration,
    names: tuple[str, str, str],
    stated: Sequence[Finding],
    refused: Sequence[Refused],
) -> CorrectionPage:
    """Return the page; ``names`` are those of the targets' file, of the corrected file, and of the result."""
    of, units = found.targets, calibration.joint_units
    given, written, result = map(one_line, names)
    of_position = MM.text(found.unexplained[0], ".3f")
    of_rotation = MRAD.text(found.unexplained[1], ".3f") if found.unexplained[1] else "no orientation was measured"
    frames = " and ".join(found.relative_to)
    relative = f", relative to {frames}, whose pose the calibration does not determine" * bool(frames)
    facts = (
        ("targets", counted(len(of.places), "target")),
        ("robot", f"{calibration.chain.name}, {calibration.chain.end_frame} in {calibration.chain.base_frame}"),
        ("calibration", result),
        ("unexplained by the calibration", f"{of_position}, {of_rotation} (standard deviation)"),
        ("expected error", f"k = 2, covariance and unexplained part{relative}"),
    )
    return CorrectionPage(
        title=f"{given} corrected",
        subtitle=f"written to {written}",
        places=of.places,
        asked=of.asked[:, :3, 3],
        shift=of.told[:, :3, 3] - of.asked[:, :3, 3],
        sizes=found.shift,
        before=of.correction.before[:, 0],
        error_point=of.error_point(calibration.chain.end_frame),
        expected=found.expected,
        limits=tuple(_limit(row, units) for row in found.limits),
        singular_value=found.singular_value,
        moves=_moves(found, units),
        refused=tuple((f"{move.file}:{move.line}", move.statement, move.reason.text()) for move in refused),
        findings=stated,
        facts=facts,
        simulated=calibration.simulated,
    )


def _limit(limits: Floats, units: Sequence[str]) -> str:
    """Return the joint nearest to its limit, and the distance."""
    nearest = int(np.argmin(limits))
    if not math.isfinite(limits[nearest]):
        return "none"
    value = float(shown(limits[nearest], units[nearest]))
    return f"joint {nearest + 1}: {value:.1f} {symbol(units[nearest])}"


def _moves(found: Findings, units: Sequence[str]) -> tuple[tuple[str, ...], ...]:
    """Return rows of cells, beginning with the move that deviates most from a straight line."""
    drive = found.moves.found
    if drive is None:
        return ()
    rows = []
    for i in np.argsort(-drive.deviation, kind="stable"):
        bent = "bends" if drive.deviation[i] > STRAIGHT else ""
        remark = bent if drive.drivable[i] else "may not be drivable"
        cells = (f"{MM.of(drive.deviation[i]):.3f}", _limit(drive.limits[i], units), f"{drive.singular_value[i]:.3f}")
        rows.append((found.moves.places[i], found.moves.starts[i], *cells, remark))
    return tuple(rows)
