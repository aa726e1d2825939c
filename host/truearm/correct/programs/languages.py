"""The languages of robot programs: the suffixes of their files, and which files run together."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import Literal

from truearm.correct.programs.krl import read_krl
from truearm.correct.programs.ls import read_ls
from truearm.correct.programs.order import closure
from truearm.correct.programs.program import Program, Surroundings
from truearm.correct.programs.rapid import read_rapid
from truearm.correct.programs.tokens import Source
from truearm.correct.programs.urscript import read_urscript
from truearm.correct.programs.urscript_names import WORDS, calls_in
from truearm.errors import InputError

ProgramLanguage = Literal["rapid", "urscript", "krl", "ls"]
SUFFIXES: dict[ProgramLanguage, tuple[str, ...]] = {
    "rapid": (".mod", ".prg", ".modx", ".sys", ".sysx"),
    "urscript": (".script", ".urscript"),
    "krl": (".src", ".dat", ".sub"),
    "ls": (".ls",),
}
ALL_SUFFIXES = tuple(suffix for suffixes in SUFFIXES.values() for suffix in suffixes)


def language_of(names: Iterable[str]) -> ProgramLanguage | None:
    """Return the language of files by their names, None if none is a program. Raises InputError if they differ."""
    suffixes = {name.lower().rpartition(".")[2] for name in names}
    languages = [language for language in SUFFIXES if any(f".{suffix}" in SUFFIXES[language] for suffix in suffixes)]
    if "krl" in languages and "src" not in suffixes and len(languages) > 1:
        languages.remove("krl")  # a .dat file of something else
    if len(languages) > 1:
        raise InputError("no-program", place="the files", names=languages, suffixes=list(ALL_SUFFIXES))
    return languages[0] if languages else None


def read_programs(language: ProgramLanguage, files: Sequence[Source], surroundings: Surroundings) -> list[Program]:
    """Read files of one language: one program for all files that run together. Raises InputError."""
    for source in files:
        if b"\0" in source.data:
            raise InputError("not-text", place=source.name, byte=source.data.index(0))
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
    called, defined = list[set[str]](), list[set[str]]()
    for source in files:
        tokens = source.script_tokens
        defined.append({name.text for word, name in pairwise(tokens) if word.text in WORDS["defining"]})
        called.append({token.text for _, token in calls_in(tokens)} - defined[-1])
    shared = set().union(*called) & set().union(*defined)
    linked: dict[int | str, set[int | str]] = defaultdict(set)  # files and the names of functions by which they are
    for number, names in enumerate(map(set.union, called, defined)):
        for name in names & shared:
            linked[number].add(name)
            linked[name].add(number)
    groups: dict[int | str, list[int]] = {}
    for number in range(len(files)):
        if number not in groups:
            nodes = closure(set[int | str]([number]), linked.__getitem__)
            groups |= dict.fromkeys(nodes, sorted(node for node in nodes if isinstance(node, int)))
    return [[files[n] for n in group] for number, group in groups.items() if number == group[0]]
