"""truearm.toml: the settings that the commands in a folder share (docs/how-to/project.md).

The file is searched for in the working folder and in its parent folders, as git does. Paths in it are relative to its
folder. Every command reads it, even ``--help``, so this imports nothing slow.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, get_type_hints

from truearm.disk import parse_toml, read_text
from truearm.errors import InputError
from truearm.schema import Key, Table, Text, read
from truearm.text import page

FIRST_LINE = f"# A truearm project; {page('A project folder')}"
MAX_BYTES = 2**16
FILE = "truearm.toml"
MAX_LEVELS = 64  # folders above the working folder

_LINE = Text(longest=400, one_line=True)


@dataclass(frozen=True)
class Project:
    """The content of a truearm.toml, each entry with its purpose, which the file states; "" for a missing entry.

    ``table`` is read instead of sessions. ``sessions`` and ``results`` are folders that record and identify write to.
    """

    model: Annotated[str, "built-in robot, robot file (.toml) or URDF (.urdf)"]
    name: Annotated[str, "what is calibrated, as reports call it"] = ""
    base: Annotated[str, "first link of a URDF"] = ""
    tip: Annotated[str, "last link of a URDF"] = ""
    branch: Annotated[
        str, "bounds of the joints to stay in [deg], LOW:HIGH,…; without it the robot file's [branch]"
    ] = ""
    serial: Annotated[str, "serial number of the robot, for the certificate"] = ""
    controller: Annotated[str, "controller of the robot and its software, for the certificate"] = ""
    customer: Annotated[str, "whom the certificate is for"] = ""
    operator: Annotated[str, "who measures, for the certificate"] = ""
    address: Annotated[str, "how truearm record reads the joints, such as rtde://192.168.0.2"] = ""
    box: Annotated[str, "the box's port; without it the one that is plugged in"] = ""
    rig: Annotated[str, f"chucks, spheres, bars; {page('Build and measure the rig')}"] = "rig.toml"
    plan: Annotated[str, "the poses to measure"] = "plan.csv"
    table: Annotated[str, "the seats in sockets, which truearm identify reads instead of sessions"] = ""
    sessions: Annotated[str, "folder of the recordings"] = "sessions"
    results: Annotated[str, "folder of the results"] = "results"


KEYS = tuple(Key(name, _LINE, optional=name != "model") for name in Project.__dataclass_fields__)
PROJECT = Table(KEYS, Project)


def read_project(path: Path) -> Project:
    """Read a truearm.toml. Raises InputError that names the file and the key."""
    return read(
        PROJECT, parse_toml(read_text(path, MAX_BYTES, InputError), str(path), InputError), str(path), InputError
    )


def format_project(project: Project) -> str:
    """Return the text of a truearm.toml with the purpose of each entry; unknown entries are written as comments."""
    remarks = {name: hint.__metadata__[0] for name, hint in get_type_hints(Project, include_extras=True).items()}
    values = vars(project)
    lines = [FIRST_LINE, "# Commands in this folder or below it take missing options from here.", ""]
    for key in KEYS:
        is_set = values[key.name] != ""
        lines.append(f"{'' if is_set else '# '}{key.name} = {_LINE.format(values[key.name])}  # {remarks[key.name]}")
    return "\n".join(lines) + "\n"


def find_project(start: Path) -> Path | None:
    """Return the nearest truearm.toml in ``start`` or above it, or None if there is none."""
    files = (folder / FILE for folder in [start, *start.parents][:MAX_LEVELS])
    return next((file for file in files if file.is_file()), None)


def project_of(start: Path) -> tuple[Project, Path] | None:
    """Return the project that contains a folder, and the project's folder; None if there is none. Raises InputError."""
    file = find_project(start)
    return None if file is None else (read_project(file), file.parent)
