"""truearm.toml: the settings shared by the commands in a folder, so that they need not be typed
(docs/how-to/project.md).

The file is searched for in the working folder and in its parent folders, as git does. Paths in it are relative to its
folder.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from truearm.errors import InputError
from truearm.files.disk import parse_toml, read_text
from truearm.schema import Key, Table, Text, read
from truearm.text import page

FIRST_LINE = f"# A truearm project; {page('A project folder')}"
MAX_BYTES = 2**16

_LINE = Text(longest=400, one_line=True)


@dataclass(frozen=True)
class Project:
    """The content of a truearm.toml; "" for a missing entry.

    ``model``: built-in robot, robot file or URDF, with ``base`` and ``tip`` of a URDF, and ``branch`` (as for --branch)
    for a model whose file has none. ``serial`` of the robot, ``controller``, ``customer`` and ``operator`` are for the
    certificate. ``address``: how the robot's joints are read. ``box``: its port. ``rig``, ``plan``: files. ``table``: seats in sockets, which identify reads instead of sessions.
    ``sessions``, ``results``: folders that
    record and identify write to.
    """

    model: str
    name: str = ""
    base: str = ""
    tip: str = ""
    branch: str = ""
    serial: str = ""
    controller: str = ""
    customer: str = ""
    operator: str = ""
    address: str = ""
    box: str = ""
    rig: str = "rig.toml"
    plan: str = "plan.csv"
    table: str = ""
    sessions: str = "sessions"
    results: str = "results"


KEYS = tuple(Key(name, _LINE, optional=name != "model") for name in Project.__dataclass_fields__)
PROJECT = Table(KEYS, Project)


def read_project(path: Path) -> Project:
    """Read a truearm.toml. Raises InputError that names the file and the key."""
    return read(
        PROJECT, parse_toml(read_text(path, MAX_BYTES, InputError), str(path), InputError), str(path), InputError
    )


def format_project(project: Project) -> str:
    """Return the text of a truearm.toml with the purpose of each entry; unknown entries are written as comments."""
    remarks = {
        "model": "built-in robot, robot file (.toml) or URDF (.urdf)",
        "name": "what is calibrated, as reports call it",
        "base": "first link of a URDF",
        "tip": "last link of a URDF",
        "branch": "bounds of the joints to stay in [deg], LOW:HIGH,…; without it the robot file's [branch]",
        "serial": "serial number of the robot, for the certificate",
        "controller": "controller of the robot and its software, for the certificate",
        "customer": "whom the certificate is for",
        "operator": "who measures, for the certificate",
        "address": "how truearm record reads the joints, such as rtde://192.168.0.2",
        "box": "the box's port; without it the one that is plugged in",
        "rig": f"chucks, spheres, bars; {page('Build and measure the rig')}",
        "plan": "the poses to measure",
        "table": "the seats in sockets, which truearm identify reads instead of sessions",
        "sessions": "folder of the recordings",
        "results": "folder of the results",
    }
    values = vars(project)
    lines = [FIRST_LINE, "# Commands in this folder or below it take missing options from here.", ""]
    for key in KEYS:
        is_set = values[key.name] != ""
        lines.append(f"{'' if is_set else '# '}{key.name} = {_LINE.format(values[key.name])}  # {remarks[key.name]}")
    return "\n".join(lines) + "\n"
