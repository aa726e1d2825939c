"""Compensation table (CSV): each joint's true rotation beyond offset and gain, by reading."""

from __future__ import annotations

from collections.abc import Sequence

from truearm.estimate.law_curves import SampledCurve
from truearm.text import one_line
from truearm.units import DEG, MRAD

HEADER = "joint,reading_deg,error_mrad,sigma_mrad,covered"


def curve_table(curves: Sequence[SampledCurve]) -> str:
    """Return the table's text: one row per joint and reading, ``covered`` 1 near a reading of the calibration, else 0."""
    lines = [HEADER]
    for curve in curves:
        name = one_line(curve.joint).replace(",", " ")
        rows = zip(DEG.of(curve.readings), MRAD.of(curve.error), MRAD.of(curve.sigma), curve.covered, strict=True)
        lines += [f"{name},{q:.4f},{error:.6f},{sigma:.6f},{int(inside)}" for q, error, sigma, inside in rows]
    return "\n".join(lines) + "\n"


def looks_like_curves(head: bytes) -> bool:
    """Return whether a file with this beginning is such a table, or empty."""
    return not head.strip() or head.startswith(HEADER.encode())
