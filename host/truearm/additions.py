"""What other packages add by entry points, for example ``[project.entry-points."truearm.kinds"]`` in a pyproject.toml.

docs/how-to/extending.md has the groups.
"""

from __future__ import annotations

import sys
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from truearm.errors import PlugInError

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

GROUPS = ("kinds", "joint_terms", "formats", "sources", "robots")
MARK = b"[truearm."  # begins a group of ours in the file entry_points.txt of an installed package
BROKEN: dict[EntryPoint, PlugInError] = {}  # additions that could not be loaded


class Registry(dict[str, Any]):
    """Entries by name. One that could not be loaded has only its name, and is raised as PlugInError when looked up."""

    def __getitem__(self, name: str) -> Any:
        if isinstance(entry := super().__getitem__(name), PlugInError):
            raise entry
        return entry

    def items(self) -> Any:
        """Return those that could be loaded."""
        return {name: entry for name, entry in super().items() if not isinstance(entry, PlugInError)}.items()

    def values(self) -> Any:
        """Return those that could be loaded."""
        return dict(self.items()).values()


@cache
def additions(group: str) -> Sequence[EntryPoint]:
    """Return the entry points of a group, such as "kinds", in the order of their names."""
    files = (file for folder in sys.path for file in Path(folder).glob("*-info/entry_points.txt"))
    if not any(MARK in file.read_bytes() for file in files):
        return ()  # the import below takes a third of the time of --help
    from importlib.metadata import entry_points

    return sorted(set(entry_points(group=f"truearm.{group}")))


@contextmanager
def blamed(place: str) -> Iterator[None]:
    """Turn every exception while an addition is loaded into a PlugInError that names its ``place``."""
    try:
        yield
    except (Exception, SystemExit) as exc:
        raise PlugInError("wrong-plug-in", place=place, reason=f"{type(exc).__name__}: {exc}") from exc


def with_additions(group: str, own: Mapping[str, Any], form: Callable[[Any], Any]) -> Registry:
    """Return truearm's own entries of a registry and, after them, what other packages add, each as ``form`` makes it.

    One that has a name of truearm's or of another package's, cannot be imported or has another form is in BROKEN.
    """
    registry = Registry(own)
    entries = additions(group)
    for entry in {entry.name: entry for entry in entries}.values():
        try:
            with blamed(f"{entry.group}: {entry.name} = {entry.value!r}"):
                if entry.name in own:
                    raise ValueError("truearm has an entry of this name; choose another")
                if others := [other.value for other in entries if other.name == entry.name and other != entry]:
                    raise ValueError(f"{' and '.join(others)} of another package has the same name")
                registry[entry.name] = form(entry.load())
        except PlugInError as exc:
            BROKEN[entry] = exc
            registry.setdefault(entry.name, exc)
    return registry


def check_loaded(group: str) -> None:
    """Raise PlugInError if an addition to a registry, which was read before, could not be loaded."""
    for error in (error for entry, error in BROKEN.items() if entry.group == f"truearm.{group}"):
        raise error


def instance(kind: type) -> Callable[[Any], Any]:
    """Return a form that accepts only instances of a type."""

    def form(item: Any) -> Any:
        if not isinstance(item, kind):
            raise TypeError(f"a {kind.__name__} is needed, not a {type(item).__name__}")
        return item

    return form


def plug_in_error(error: BaseException) -> PlugInError | None:
    """Return an error that names the last line of another package's code that led to an exception.

    It also names the line of truearm, if the exception arose in what that line called. None if no other package is in
    the traceback.
    """
    packages = {entry.module.partition(".")[0] for group in GROUPS for entry in additions(group)}
    frames = list(traceback.walk_tb(error.__traceback__))
    for frame, line in reversed(frames):
        if str(frame.f_globals.get("__name__")).partition(".")[0] in packages:
            code = frame.f_code
            (last, last_line), reason = frames[-1], f"{type(error).__name__}: {error}"
            if str(module := last.f_globals.get("__name__")).startswith("truearm."):
                reason += f" (raised by {module}, line {last_line})"
            return PlugInError(
                "wrong-plug-in", place=f"{code.co_filename}, line {line}, in {code.co_name}", reason=reason
            )
    return None
