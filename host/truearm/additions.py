"""What other packages add by entry points, for example ``[project.entry-points."truearm.kinds"]`` in a pyproject.toml.

docs/how-to/extending.md has the groups.
"""

from __future__ import annotations

import sys
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from truearm.errors import PlugInError

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

GROUPS = ("kinds", "joint_terms", "formats", "sources", "robots")
MARK = b"[truearm."  # begins a group of ours in the file entry_points.txt of an installed package


@cache
def additions(group: str) -> Mapping[str, EntryPoint]:
    """Return the entry points of a group, such as "kinds", by name, in the order of their names."""
    files = (file for folder in sys.path for file in Path(folder).glob("*-info/entry_points.txt"))
    if not any(MARK in file.read_bytes() for file in files):
        return {}  # the import below takes a third of the time of --help
    from importlib.metadata import entry_points

    return {entry.name: entry for entry in sorted(entry_points(group=f"truearm.{group}"))}


@contextmanager
def blamed(place: str) -> Iterator[None]:
    """Turn every exception while an addition is loaded into a PlugInError that names its ``place``."""
    try:
        yield
    except Exception as exc:
        raise PlugInError("wrong-plug-in", place=place, reason=f"{type(exc).__name__}: {exc}") from exc


def place_of(entry: EntryPoint) -> str:
    """Return how a message names an entry point."""
    return f"{entry.group}: {entry.name} = {entry.value!r}"


def with_additions(group: str, own: Mapping[str, Any], form: Callable[[Any], Any]) -> dict[str, Any]:
    """Return truearm's own entries of a registry and, after them, what other packages add, each as ``form`` makes it.

    Raises PlugInError for one that has a name of truearm's, cannot be imported or has another form.
    """
    registry = dict(own)
    for name, entry in additions(group).items():
        with blamed(place_of(entry)):
            if name in own:
                raise ValueError("truearm has an entry of this name; choose another")
            registry[name] = form(entry.load())
    return registry


def instance(kind: type) -> Callable[[Any], Any]:
    """Return a form that accepts only instances of a type."""

    def form(item: Any) -> Any:
        if not isinstance(item, kind):
            raise TypeError(f"a {kind.__name__} is needed, not a {type(item).__name__}")
        return item

    return form


def plug_in_error(error: BaseException) -> PlugInError | None:
    """Return an error that names the line of another package's code in which an exception arose.

    None if it is not in the traceback.
    """
    packages = {entry.module.partition(".")[0] for group in GROUPS for entry in additions(group).values()}
    for frame, line in reversed(list(traceback.walk_tb(error.__traceback__))):
        if str(frame.f_globals.get("__name__")).partition(".")[0] in packages:
            code = frame.f_code
            reason = f"{type(error).__name__}: {error}"
            return PlugInError(
                "wrong-plug-in", place=f"{code.co_filename}, line {line}, in {code.co_name}", reason=reason
            )
    return None
