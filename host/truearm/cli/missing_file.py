"""Say which file a command can use if it was typed without one and the project has none in its usual folder."""

from __future__ import annotations

import os
import shlex
from collections.abc import Sequence
from pathlib import Path

from truearm.files.project_folder import find_project

MOST = 3  # files that are named in addition to the proposed one


def missing_file(parameter: str, arguments: Sequence[str], folder: Path) -> str | None:
    """Return the message for a command line without a result or session; None outside a project, and for others.

    ``parameter`` is the name of the command's argument. The message names the command line that reads the newest session
    elsewhere in the project, for example that of a rehearsal.
    """
    file = find_project(folder)
    if (
        file is None
        or parameter not in ("result", "inputs", "session")
        or (parameter, arguments[0]) == ("inputs", "validate")
    ):
        return None
    from truearm.files.project_file import read_project
    from truearm.workflows.project import by_time, folders_of, sessions_of

    project, home = read_project(file), file.parent

    def lack(name: str, what: str) -> str:
        return f"the folder {os.path.relpath(home / name, folder)} (truearm.toml) holds no {what} yet"

    if parameter == "result":
        return f"{lack(project.results, 'result')}; make one with truearm identify"
    sessions = by_time(path for one in folders_of(home) for path in sessions_of(one))
    if not sessions:
        return f"{lack(project.sessions, 'session')}; make one with truearm record"
    *others, newest = (os.path.relpath(path, folder) for path in sessions)
    proposed = shlex.join(["truearm", *arguments, newest])
    more = f" (there is also {', '.join(others[-MOST:])})" * bool(others)
    return f"{lack(project.sessions, 'session')}; to read another one, type: {proposed}{more}"
