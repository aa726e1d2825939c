"""What ``truearm identify`` prints about outliers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from truearm.estimate.outliers import MOST
from truearm.report.suspect_words import named_rows
from truearm.text import counted, one_line
from truearm.units import SUFFIXES, size

Document = Mapping[str, Any]


def suspects(document: Document) -> list[str]:
    """Return the outliers."""
    rows, fitted = document["suspect"], document["n_observations"]
    if not rows or document["without_bad_rows"] is not None:
        return []
    if len(rows) > MOST * fitted and all(row["weight"] == 1.0 for row in rows):
        return [
            f"{len(rows)} of {counted(fitted, 'row')} lie farther from the fit than their declared noise allows. These are too many to "
            "be outliers: the model is wrong, or the sigmas are too small."
        ]
    who = "1 row disagrees" if len(rows) == 1 else f"{len(rows)} rows disagree"
    out, kept = ([row for row in rows if (row["weight"] == 0.0) is gone] for gone in (True, False))
    if not out:
        lines = [f"{who} significantly with all others: {named_rows(kept)}."]
    else:
        lines = [f"{who} significantly with all others; {len(out)} left out of the fit: {named_rows(out)}."]
        if kept:
            usual = "the residuals of most rows exceed their declared noise"
            why = "they hardly change the fit" if _has_laws(document) else usual
            lines.append(
                f"Not left out, because {why}: {named_rows(kept)}. To leave out a row "
                f'yourself: --leave-out "{one_line(kept[0]["source"])}".'
            )
    every = document["with_outliers"]
    if every is not None:
        units = [SUFFIXES[suffix] for suffix in document["residual_units"]]
        rms = (size(every[f"rms_after_{u.suffix}"], u) for u in units)
        lines.append(
            f"{'Geometry alone, fitted' if _has_laws(document) else 'Fitted'} to all rows: RMS {' and '.join(rms)}, χ² per degree of "
            f"freedom {every['chi2_reduced']:.3g}."
        )
    return lines


def _has_laws(document: Document) -> bool:
    return any(law["kept"] for law in (document["joint_laws"] or {}).get("tried", ()))
