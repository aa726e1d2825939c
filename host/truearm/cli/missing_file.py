"""Say which file a command can use if it was typed without one and the project has none in its usual folder."""

from __future__ import annotations

import json
import os
import shlex
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from truearm.files.project_folder import find_project

# Commands that take two files from the command line, and what the second one is; neither is taken from the project.
TWO_FILES = {"validate": "the measurements that judge it", "correct": "the targets or the program"}
MOST = 3  # files that are named in addition to the proposed one


def missing_file(parameter: str, arguments: Sequence[str], folder: Path) -> str | None:
    """Return the message for a command line without a result or session; None outside a project, and for others.

    ``parameter`` is the name of the command's argument. The message names the command line that reads the newest such
    file elsewhere in the project, for example that of a rehearsal.
    """
    file = find_project(folder)
    if file is None or parameter not in ("result", "inputs", "session"):
        return None
    from truearm.files.project_file import read_project
    from truearm.workflows.project import results_of, sessions_of

    project, home = read_project(file), file.parent
    folders = [home, *(path for path in home.iterdir() if path.is_dir() and not path.name.startswith("."))]
    sessions = _by_time(path for one in folders for path in sessions_of(one))
    documents = {path: _result(path) for path in _by_time(path for one in folders for path in results_of(one))}
    results = [path for path, document in documents.items() if document]

    def shown(path: Path) -> str:
        return os.path.relpath(path, folder)

    if second := TWO_FILES.get(arguments[0]):
        newest = shown(results[-1]) if results else "result.json"
        return f"name the result and {second}, such as: truearm {arguments[0]} {shlex.quote(newest)} FILE"
    if parameter == "result":
        found, why, first = (
            results,
            f"the folder {shown(home / project.results)} (truearm.toml) holds no result",
            "truearm identify",
        )
    else:
        found, why, first = (
            sessions,
            f"the folder {shown(home / project.sessions)} (truearm.toml) holds no session",
            "truearm record",
        )
    if not found:
        return f"{why} yet; make one with {first}"
    used = found[-1:]
    if arguments[0] == "report" and results:  # it reads the sessions of its result
        typed = [path for path in results if path in {Path(os.path.abspath(word)) for word in arguments}]
        of = documents[(typed or results)[-1]]
        read = [path for path in sessions if path.parent != home / project.sessions and _was_read(path, of)]
        read = read or (used if parameter != "result" else [])
        used = [*([] if typed else results[-1:]), *read]
    others = ", ".join(shown(path) for path in [path for path in found if path not in used][-MOST:])
    proposed = shlex.join(["truearm", *arguments, *map(shown, used)])
    return f"{why} yet; to read another one, type: {proposed}{f' (there is also {others})' * bool(others)}"


def _by_time(files: Iterable[Path]) -> list[Path]:
    return sorted(files, key=lambda path: path.stat().st_mtime_ns)


def _result(path: Path) -> Mapping[str, Any]:
    """Return the document of a result; empty for any other file."""
    from truearm.files.result_file import FORMAT

    try:
        document = json.loads(path.read_bytes())
    except (OSError, ValueError):
        return {}
    return document if isinstance(document, dict) and document.get("format") == FORMAT else {}


def _was_read(session: Path, result: Mapping[str, Any]) -> bool:
    """Return whether a result was made from this session."""
    from truearm.files.disk import sha256

    hashes = [one.get("sha256") for one in result.get("inputs", ()) if one.get("name") == session.name]
    return bool(hashes) and sha256(session) in hashes
