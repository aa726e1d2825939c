"""Where a project's truearm.toml is. Every command asks, --help too, so this imports nothing that reads it."""

from __future__ import annotations

from pathlib import Path

FILE = "truearm.toml"
MAX_LEVELS = 64  # of folders above the working one


def find_project(start: Path) -> Path | None:
    """The nearest truearm.toml in ``start`` or above it; None where there is none."""
    for folder in [start, *start.parents][:MAX_LEVELS]:
        if (folder / FILE).is_file():
            return folder / FILE
    return None
