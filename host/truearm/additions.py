"""What other packages add by entry points, for example ``[project.entry-points."truearm.kinds"]`` in a pyproject.toml.

docs/how-to/extending.md has the groups.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

MARK = b"[truearm."  # begins a group of ours in the file entry_points.txt of an installed package


@cache
def additions(group: str) -> Mapping[str, EntryPoint]:
    """Return the entry points of a group, such as "kinds", by name, in the order of their names."""
    files = (file for folder in sys.path for file in Path(folder).glob("*-info/entry_points.txt"))
    if not any(MARK in file.read_bytes() for file in files):
        return {}  # the import below takes a third of the time of --help
    from importlib.metadata import entry_points

    return {entry.name: entry for entry in sorted(entry_points(group=f"truearm.{group}"))}


def with_additions(group: str, own: Mapping[str, Any]) -> dict[str, Any]:
    """Return truearm's own entries of a registry and, after them, what other packages add under other names."""
    return {**own, **{name: entry.load() for name, entry in additions(group).items() if name not in own}}
