"""The languages of robot programs: the suffixes of their files, and which files run together."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable, Sequence
from typing import Literal

from truearm.correct.programs.krl import read_krl
from truearm.correct.programs.ls import read_ls
from truearm.correct.programs.order import closure
from truearm.correct.programs.program import Program, Surroundings
from truearm.correct.programs.rapid import read_rapid
from truearm.correct.programs.tokens import Source
from truearm.correct.programs.urscript import read_urscript
from truearm.correct.programs.urscript_names import DEFINING, calls_in
from truearm.errors import FindingError
from truearm.findings import Finding

ProgramLanguage = Literal["rapid", "urscript", "krl", "ls"]
SUFFIXES: dict[ProgramLanguage, tuple[str, ...]] = {
    "rapid": (".mod", ".prg", ".modx", ".sys", ".sysx"),
    "urscript": (".script", ".urscript"),
    "krl": (".src", ".dat", ".sub"),
    "ls": (".ls",),
}
ALL_SUFFIXES = tuple(suffix for suffixes in SUFFIXES.values() for suffix in suffixes)


def language_of(names: Iterable[str]) -> ProgramLanguage | None:
    """Return the language of files by their names, None if none is a program. Raises FindingError if they differ."""
    suffixes = {name.lower().rpartition(".")[2] for name in names}
    found = [language for language in SUFFIXES if any(f".{suffix}" in SUFFIXES[language] for suffix in suffixes)]
    if "krl" in found and "src" not in suffixes and len(found) > 1:
        found.remove("krl")  # a .dat file of something else
    if len(found) > 1:
        kinds = " and ".join(found)
        raise FindingError(Finding("languages"), f"programs of several languages ({kinds}); give those of one robot")
    return found[0] if found else None


def read_programs(language: ProgramLanguage, files: Sequence[Source], surroundings: Surroundings) -> list[Program]:
    """Read files of one language: one program for all files that run together. Raises FindingError."""
    for source in files:
        if b"\0" in source.data:
            raise FindingError(Finding("binary"), f"{source.name}: holds a NUL byte, so it is not a program")
    if language == "rapid":
        return read_rapid(_tasks(files), surroundings)
    if language == "urscript":
        return [read_urscript(group, surroundings) for group in _scripts(files)]
    return [read_krl(files, surroundings) if language == "krl" else read_ls(files, surroundings)]


def _tasks(files: Sequence[Source]) -> list[list[Source]]:
    """Return the files of each RAPID task: a controller's backup has one folder TASK1, TASK2 … for each."""
    tasks: dict[str, list[Source]] = defaultdict(list)
    for source in files:
        folder = re.search(r"(?:^|/)task\d+(?=/)", source.name.lower())
        tasks[folder[0] if folder else ""].append(source)
    return list(tasks.values())


def _scripts(files: Sequence[Source]) -> list[list[Source]]:
    """Return the URScripts that run together: those that call functions which only another one defines."""
    defined: dict[str, list[int]] = defaultdict(list)
    called: list[set[str]] = []
    linked: dict[int, set[int]] = defaultdict(set)
    for number, source in enumerate(files):
        tokens = source.script_tokens
        calls = {token.text for _, token in calls_in(tokens)}
        own = {tokens[i + 1].text for i in range(len(tokens) - 1) if tokens[i].text in DEFINING}
        called.append(calls - own)
        for name in own:
            defined[name].append(number)
    for number, names in enumerate(called):
        for other in [other for name in names for other in defined.get(name, ())]:
            linked[number].add(other)
            linked[other].add(number)
    groups: dict[int, frozenset[int]] = {}
    for number in range(len(files)):
        if number not in groups:
            group = frozenset(closure([number], linked.__getitem__))
            groups |= dict.fromkeys(group, group)
    return [[files[number] for number in sorted(group)] for group in dict.fromkeys(groups.values())]
