"""Which rig each observation belongs to: the one of all, or one a session and one for each name in the column ``rig``.

A session carries the rig that it was recorded with, so several sessions of one robot may have several rigs. Each then
makes unknowns of its own (``monday.sphere.s1.x``), and only the robot's parameters are shared. A session is called as its
file is, without the suffix: ``--rig monday=FILE`` stands in for the rig inside monday.mcap.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

from truearm.errors import Argument, InputError, RigError
from truearm.types import Rig
from truearm.workflows.session_observations import attached_rig, is_session
from truearm.workflows.session_parts import first_stem

LONGEST = 64  # letters of a name, as a table's identifiers
Assigned = tuple[str, Rig]  # name, "" for the one rig of all, and what it holds


def session_name(path: Path) -> str:
    """What a session is called where rigs have names: its first file's name without the suffix, fit for a table's column."""
    return re.sub(r"[^\w-]", "_", first_stem(path), flags=re.ASCII)[:LONGEST]


def session_rigs(inputs: list[Path], given: Mapping[str, Rig]) -> dict[Path, Assigned]:
    """Name and rig of every session among the inputs; ``given`` holds those that the user gave, by name.

    Without such a name, and where all sessions were recorded with one rig, that is the one rig of everything, as a rig
    without a name is. Raises RigError for a session that has no rig, InputError for names that do not tell rigs apart.
    """
    sessions = [path for path in inputs if is_session(path)]
    if "" in given:
        return dict.fromkeys(sessions, ("", given[""]))
    recorded = {path: _recorded(path) for path in sessions if session_name(path) not in given}
    for path, rig in recorded.items():
        if rig is None:
            name = f" {session_name(path)}=FILE" * bool(given)
            raise RigError(f"{path}: was recorded without a rig; give one as ", Argument("rig"), name)
    own = {path: rig for path, rig in recorded.items() if rig is not None}
    if not given and all(rig == next(iter(own.values())) for rig in own.values()):
        return {path: ("", rig) for path, rig in own.items()}
    named = {path: (session_name(path), given[session_name(path)]) for path in sessions if path not in own}
    return named | _named_apart(own)


def _recorded(path: Path) -> Rig | None:
    from truearm.session.session_file import open_session

    return attached_rig(open_session(path, allow_damaged=True), path)


def _named_apart(own: Mapping[Path, Rig]) -> dict[Path, Assigned]:
    """Each session's own rig under the session's name; sessions that were recorded with one rig share the first's."""
    named: dict[Path, Assigned] = {}
    for path, rig in own.items():
        same = next((name for name, other in named.values() if other == rig), session_name(path))
        if any(name == same and other != rig for name, other in named.values()):
            raise InputError(f"{path}: another session is called {same} too, but has another rig; rename one of them")
        named[path] = same, rig
    return named
