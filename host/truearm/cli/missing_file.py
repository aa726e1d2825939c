"""Say which file a command can use if it was typed without one and the project has none in its usual folder."""

from __future__ import annotations

import os
import shlex
from collections.abc import Iterable, Sequence
from pathlib import Path

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
    from truearm.workflows.project import folders_of, result_document, results_of, sessions_of, was_read

    project, home = read_project(file), file.parent
    folders = folders_of(home)
    sessions = _by_time(path for one in folders for path in sessions_of(one))
    documents = {path: result_document(path) for path in _by_time(path for one in folders for path in results_of(one))}
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
        read = [path for path in sessions if path.parent != home / project.sessions and was_read(path, of)]
        read = read or (used if parameter != "result" else [])
        used = [*([] if typed else results[-1:]), *read]
    others = ", ".join(shown(path) for path in [path for path in found if path not in used][-MOST:])
    proposed = shlex.join(["truearm", *arguments, *map(shown, used)])
    return f"{why} yet; to read another one, type: {proposed}{f' (there is also {others})' * bool(others)}"


def _by_time(files: Iterable[Path]) -> list[Path]:
    return sorted(files, key=lambda path: path.stat().st_mtime_ns)
