"""Joint sources by name: live ones by the scheme of an address, files by their suffix.

This module imports nothing slow, so that ``--help`` can list the sources; a source's module is imported when it is
used. To add a live source, write a module here with ``connect(url, clock, last) -> Link`` and add its line to
``SOURCES``; other packages add a ``SourceEntry`` by an entry point of the group ``truearm.sources``. ``last`` is the
link of an earlier connection to the same address, None for the first one. To add a file format, write a module with
``readings(path, options) -> Iterator[AddedReading]`` and add its line to ``FILES``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, NamedTuple

from truearm.additions import blamed, with_additions
from truearm.errors import InputError, PlugInError

if TYPE_CHECKING:
    from truearm.record.links import Clock, Link, Reopening


class AddedReading(NamedTuple):
    """Controller time [s] and the line of a reading that was added afterwards."""

    t: float
    line: bytes


class SourceEntry(NamedTuple):
    """A live source: its module, the part of an address after the scheme, and what sends such readings.

    ".module" is one of this package.
    """

    module: str
    example: str
    summary: str


class FileEntry(NamedTuple):
    """A file of readings: its module (as of a source), its suffixes, whether a folder can be one, and a description."""

    module: str
    suffixes: tuple[str, ...]
    folder: bool
    summary: str


class FileOptions(NamedTuple):
    """The user's options for a file.

    The topic and the names of the joints in order, for files that hold several, and how columns of a table are named,
    as in ``("q{}_rad", "actual_q_{}")``.
    """

    topic: str
    joints: Sequence[str] = ()
    allow_damaged: bool = False
    columns: Sequence[tuple[str, str]] = ()


RTDE = "rtde"
OWN: Mapping[str, SourceEntry] = {
    "tcp": SourceEntry(".text_lines", "127.0.0.1:7008", "JSON lines"),
    RTDE: SourceEntry(".rtde", "192.168.0.2", "Universal Robots"),
    "lines+tcp": SourceEntry(".text_lines", "192.168.0.2:7008", "CSV, or JSON with names and units of its own"),
    "lines+udp": SourceEntry(".text_lines", "0.0.0.0:7008", "the same in datagrams, sent to this computer"),
}
SOURCES = with_additions("sources", OWN, lambda fields: SourceEntry(*fields))
TABLE = FileEntry(".text_lines", (".csv",), False, "a table (.csv)")
FILES: tuple[FileEntry, ...] = (
    FileEntry(".bags", (".mcap", ".db3"), True, "a ROS 2 bag (a folder, .mcap or .db3)"),
    TABLE,
)


def sources_help() -> str:
    """Return an example address and a description of every live source, for ``--help``."""
    return ", ".join(f"{scheme}://{entry.example} ({entry.summary})" for scheme, entry in SOURCES.items())


def files_help() -> str:
    """Return a description of the supported files of joint readings, for ``--help``."""
    return " or ".join(entry.summary for entry in FILES)


def check_address(url: str) -> str:
    """Return the scheme of the address of a live source. Raises InputError for any other text."""
    scheme, separator, _ = url.partition("://")
    if not separator or scheme not in SOURCES:
        schemes = ", ".join(f"{name}://" for name in SOURCES)
        raise InputError(f"{url!r} is not the address of a robot; an address begins with one of {schemes}")
    return scheme


def open_source(url: str, clock: Clock) -> Reopening:
    """Open the live source at an address; after a loss it can be opened again.

    Raises InputError for an address without a matching source, LinkError if nothing answers.
    """
    from truearm.record.links import Reopening

    scheme = check_address(url)
    module = SOURCES[scheme].module
    with blamed(f"joint source {scheme}"):
        connect: Callable[[str, Clock, Link | None], Link | None] = _module(module).connect
    last: Link | None = None

    def open_link() -> Link:
        nonlocal last
        last = connect(url, clock, last)
        if last is None:
            raise PlugInError("wrong-plug-in", place=f"joint source {scheme}", reason="connect() returns no link")
        return last

    return Reopening(open_link)


def file_entry(path: Path) -> FileEntry:
    """Return the entry of a file by its suffix; that of a table for an unknown one."""
    return next((e for e in FILES if path.suffix.lower() in e.suffixes or (e.folder and path.is_dir())), TABLE)


def readings_of_file(path: Path, options: FileOptions) -> Iterator[AddedReading]:
    """Return the readings of a file by its suffix, in order.

    Raises InputError if there is no such file, topic or joint, SessionError or TableError if a file is damaged.
    """
    readings: Iterator[AddedReading] = _module(file_entry(path).module).readings(path, options)
    return readings


def _module(name: str) -> ModuleType:
    return import_module(name, __package__)
