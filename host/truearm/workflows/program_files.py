"""Read the program files of a robot, from one file or a folder, and write corrected ones."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from truearm.correct.programs.languages import ALL_SUFFIXES, SUFFIXES, ProgramLanguage, language_of
from truearm.errors import InputError
from truearm.files.disk import check_new_folder, check_writable, read_bytes, write_atomic, write_folder

MAX_BYTES = 64 * 2**20  # of all files together


class ProgramFiles(NamedTuple):
    """Program files by their names: of a file its own, in a folder the path within it with slashes."""

    path: Path
    language: ProgramLanguage
    contents: Mapping[str, bytes]


def is_program(path: Path) -> bool:
    """Return whether a path is a folder or, by its suffix, a robot program."""
    return path.is_dir() or path.suffix.lower() in ALL_SUFFIXES


def read_program_files(path: Path) -> ProgramFiles:
    """Read a program, or all programs of a folder and its folders. Raises InputError."""
    files = {path.name: path}
    if path.is_dir():
        files = {file.relative_to(path).as_posix(): file for file in sorted(path.rglob("*")) if file.is_file()}
    try:
        language = language_of(files)
    except InputError as exc:
        raise exc.within(path) from exc
    if language is None:
        raise InputError("no-program", place=path, suffixes=list(ALL_SUFFIXES))
    names = [name for name in files if name.lower().endswith(SUFFIXES[language])]
    contents: dict[str, bytes] = {}
    room = MAX_BYTES
    for name in names:
        contents[name] = read_bytes(files[name], room, InputError)
        room -= len(contents[name])
    return ProgramFiles(path, language, contents)


def check_program_out(out: Path, programs: ProgramFiles, inputs: list[Path]) -> None:
    """Raise InputError unless corrected programs can be written to a new file or folder."""
    if programs.path.is_dir():
        check_new_folder(out, programs.path)
        return
    check_writable(out, inputs=inputs, suffixes=SUFFIXES[programs.language])
    if out.exists():
        raise InputError("file-exists", place=out)


def write_program_files(out: Path, programs: ProgramFiles, contents: Mapping[str, bytes]) -> None:
    """Write corrected programs, all of them or none."""
    if programs.path.is_dir():
        write_folder(out, contents)
    else:
        write_atomic(out, contents[programs.path.name])
