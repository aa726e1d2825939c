"""What ``truearm export`` prints."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from truearm.export.writing import named
from truearm.text import one_line
from truearm.types import Floats
from truearm.units import MM
from truearm.workflows.export import Exported


def lines(found: Exported, out: Path, over: Path | None) -> list[str]:
    """The mountings, the error that the refit leaves, and the file; ``over``: what it was refitted over."""
    return [*found.mountings, *_cost_lines(found, over), f"Written: {one_line(str(out))}"]


def _cost_lines(found: Exported, over: Path | None) -> list[str]:
    """What the file does not hold, and how far it errs by that."""
    fitted = found.fitted
    lines = [f"--format {found.form} has no place for {named(fitted.missing)}."] if fitted.missing else []
    if fitted.refitted:
        return [
            *lines,
            f"Refitted over {fitted.left.size} poses: what the file cannot hold or you do not adjust costs {_of(fitted.dropped)}",
            f"where it is simply left out, and {_of(fitted.left)} after the rest has made up for it.",
            *["Give --over FILE, a plan or a table, to have it best where you work."] * (over is None),
        ]
    if fitted.exact:
        return ["Nothing was refitted: the file holds all that was identified."]
    return [*lines, f"What the file cannot hold costs {_of(fitted.left)}."]


def _of(error: Floats) -> str:
    return f"{MM.text(np.sqrt(np.mean(error**2)), '.3f')} RMS ({MM.of(error.max()):.3f} at most)"
