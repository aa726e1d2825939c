"""What is said about bad rows that are too many to be left out, from the content of result.json."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from truearm.estimate.outliers import MOST
from truearm.estimate.solvers import Loss
from truearm.results import chi2_text
from truearm.text import counted, one_line
from truearm.units import SUFFIXES, size

MAX_ROWS = 6


def bad_row_sentences(document: Mapping[str, Any], argument: Callable[[str], str] = str) -> list[str]:
    """Return which rows are bad, if they are too many to be left out but explain χ²; empty if there are none.

    ``argument`` is the format of the arguments of an identification.
    """
    others = document["without_bad_rows"]
    if others is None:
        return []
    n, fitted = others["n"], document["n_observations"]
    return [
        f"{n} of {counted(fitted, 'row')} are bad: they disagree significantly with all others, which the declared noise "
        f"explains (without the bad rows: RMS {_rms(document, others)}, χ² per degree of freedom {chi2_text(others['chi2_reduced'])}).",
        f"Bad rows: {named_rows(document['suspect'])}.",
        f"They are more than {MOST:.0%} of the rows, so they are still in the fit, and everything below is for all rows. "
        f"Find their cause, then leave them out, or give {argument('loss')} {Loss.CAUCHY}.",
    ]


def named_rows(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the first MAX_ROWS rows with their distances, and how many more there are."""
    named = ", ".join(f"{one_line(row['source'])} ({row['distance']:.1f} σ)" for row in rows[:MAX_ROWS])
    return named + (f" and {len(rows) - MAX_ROWS} more (suspect in the JSON result)" if len(rows) > MAX_ROWS else "")


def _rms(document: Mapping[str, Any], fit: Mapping[str, Any]) -> str:
    """Return the RMS of another fit in each unit."""
    units = (SUFFIXES[suffix] for suffix in document["residual_units"])
    return " and ".join(size(fit[f"rms_after_{unit.suffix}"], unit) for unit in units)
