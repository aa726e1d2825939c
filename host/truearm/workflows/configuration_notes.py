"""Findings about the arm's configurations at the targets of a corrected program: what to check before it is run."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from truearm.findings import Finding
from truearm.types import Floats
from truearm.units import DEG

MOST_NAMED = 6  # quarter turns


def _other_quarters(lines: Sequence[str], q: Floats, quarters: Floats, wrong: NDArray[np.bool_]) -> list[str]:
    """Return "line 2: cf4 is 0, axis 4 at -95° needs -2" for the first wrong quarter turns (n, j)."""
    found = np.argwhere(wrong)
    said = [
        f"line {lines[i]}: cf{j + 1} is {quarters[i, j]:.0f}, axis {j + 1} at {_in_its_quarter(DEG.of(q[i, j]))}° needs {np.floor(q[i, j] / (0.5 * np.pi)):.0f}"
        for i, j in found[:MOST_NAMED].tolist()
    ]
    return said + [f"and {len(found) - MOST_NAMED} more"] * (len(found) > MOST_NAMED)


def _in_its_quarter(angle: float) -> str:
    """Return an angle [deg] with as many digits as show its quarter turn: -95, but -0.03."""
    shown = (f"{angle:.{digits}f}" for digits in range(6))
    return next((text for text in shown if float(text) // 90.0 == angle // 90.0), f"{angle:.3g}")


def configuration_notes(
    q: Floats, quarters: Floats, determined: NDArray[np.bool_], lines: Sequence[str]
) -> Iterator[Finding]:
    """Yield the arm configurations to check: those that only ``home`` determines, and those that contradict the
    program's own data.

    ``determined`` (n,): the program determines the configuration.
    """
    if not determined.all():
        places = [line for line, is_determined in zip(lines, determined, strict=False) if not is_determined]
        yield Finding("home-decides", {"lines": places})
    wrong = (np.floor(q / (0.5 * np.pi)) != quarters) & ~np.isnan(quarters)
    if wrong.any():
        details = "; ".join(_other_quarters(lines, q, quarters, wrong))
        yield Finding("configuration-data", {"n": int(wrong.any(axis=1).sum()), "details": details})
