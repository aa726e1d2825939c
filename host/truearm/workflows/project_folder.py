"""Find a project's truearm.toml. Every command calls this, even --help, so it does not import the file's reader."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from truearm.workflows.project_file import Project

FILE = "truearm.toml"
MAX_LEVELS = 64  # folders above the working folder


def find_project(start: Path) -> Path | None:
    """Return the nearest truearm.toml in ``start`` or above it, or None if there is none."""
    for folder in [start, *start.parents][:MAX_LEVELS]:
        if (folder / FILE).is_file():
            return folder / FILE
    return None


def project_of(start: Path) -> tuple[Project, Path] | None:
    """Return the project that contains a folder, and the project's folder; None if there is none. Raises InputError."""
    file = find_project(start)
    if file is None:
        return None
    from truearm.workflows.project_file import read_project

    return read_project(file), file.parent
