"""Joint laws as text: covered intervals, and the fits with and without laws."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

from truearm.text import counted

Document = Mapping[str, Any]
MOST_GAPS = 4  # named

STEPS = {"geometry": "geometry", "sag": "with sag", "curves": "with curves", "laws": "with joint laws"}


def intervals_text(intervals: Sequence[Sequence[float]]) -> str:
    """Return ascending intervals [deg] as their whole range and its widest gaps."""
    if not intervals:
        return "nowhere"
    text = f"{intervals[0][0]:.0f} to {intervals[-1][1]:.0f} deg"
    gaps = [(a[1], b[0]) for a, b in pairwise(intervals)]
    named = sorted(sorted(gaps, key=lambda gap: gap[0] - gap[1])[:MOST_GAPS])
    if not named:
        return text
    listed = ", ".join(f"{low:.0f} to {high:.0f}" for low, high in named)
    more = f" and {counted(len(gaps) - len(named), 'smaller gap')}" * (len(gaps) > len(named))
    return f"{text} except {listed} deg{more}"


def law_steps(document: Document, suffix: str) -> list[tuple[str, str, str]]:
    """Return each fit's name, fitted RMS and held-out mean in a suffix's unit; empty if only geometry was fitted."""
    found = document["joint_laws"]
    steps = found["steps"] if found else []
    rows = []
    for step in steps:
        held = (step["held_out"] or {}).get(f"mean_{suffix}")
        rows.append((STEPS[step["name"]], _number(step.get(f"rms_after_{suffix}")), _number(held)))
    return rows if len(rows) > 1 else []


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4f}"
