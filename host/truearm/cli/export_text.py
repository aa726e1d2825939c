"""What ``truearm export`` prints."""

from __future__ import annotations

from pathlib import Path

from truearm.text import one_line
from truearm.workflows.export import ExportedRobot, cost_lines

REMEDY = "Give --over FILE, a plan or a table, to have it best where you work."


def lines(found: ExportedRobot, out: Path, over: Path | None) -> list[str]:
    """The mountings, the error that the refit leaves, and the file; ``over``: what it was refitted over."""
    remedy = [REMEDY] if found.fitted.refitted and over is None else []
    return [*found.mountings, *cost_lines(found), *remedy, f"Written: {one_line(str(out))}"]
