"""Assign a rig to each observation: a common one, or one per session and one for each name in the column ``rig``.

A session contains the rig with which it was recorded, so several sessions of one robot may have several rigs. Each rig
then has unknowns of its own (``monday.sphere.s1.x``), and only the robot's parameters are shared. A session is named
after its file without the suffix: ``--rig monday=FILE`` replaces the rig inside monday.mcap.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from truearm.errors import Argument, InputError, RigError
from truearm.types import Rig
from truearm.workflows.session_observations import attached_rig
from truearm.workflows.session_parts import first_stem

if TYPE_CHECKING:
    from truearm.session.session_file import Session

LONGEST = 64  # letters in a name, as for a table's identifiers
Assigned = tuple[str, Rig]  # name, "" for the common rig, and the rig


def session_name(path: Path) -> str:
    """Return a session's name for use with rigs: its first file's name without the suffix, valid in a table's column."""
    return re.sub(r"[^\w-]", "_", first_stem(path), flags=re.ASCII)[:LONGEST]


def session_rigs(sessions: Mapping[Path, Session], given: Mapping[str, Rig]) -> dict[Path, Assigned]:
    """Return name and rig of every session; ``given`` holds the rigs given by the user, by name.

    If no name is given and all sessions were recorded with one rig, that rig is used for everything, like a rig without
    a name. Raises RigError for a session without a rig, InputError for names that do not distinguish rigs.
    """
    if "" in given:
        return dict.fromkeys(sessions, ("", given[""]))
    recorded = {path: attached_rig(one, path) for path, one in sessions.items() if session_name(path) not in given}
    for path, rig in recorded.items():
        if rig is None:
            name = f" {session_name(path)}=FILE" * bool(given)
            raise RigError(f"{path}: was recorded without a rig; give one as ", Argument("rig"), name)
    own = {path: rig for path, rig in recorded.items() if rig is not None}
    if not given and all(rig == next(iter(own.values())) for rig in own.values()):
        return {path: ("", rig) for path, rig in own.items()}
    named = {path: (session_name(path), given[session_name(path)]) for path in sessions if path not in own}
    return named | _named_apart(own)


def _named_apart(own: Mapping[Path, Rig]) -> dict[Path, Assigned]:
    """Return each session's own rig under the session's name; sessions recorded with the same rig share the first
    one's.
    """
    named: dict[Path, Assigned] = {}
    for path, rig in own.items():
        same = next((name for name, other in named.values() if other == rig), session_name(path))
        if any(name == same and other != rig for name, other in named.values()):
            raise InputError(f"{path}: another session is also named {same} but has another rig; rename one of them")
        named[path] = same, rig
    return named
