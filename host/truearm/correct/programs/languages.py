"""The languages of robot programs: suffixes of files, which files run together, and their controllers' frames.

Universal Robots' controllers express poses in ``base``, rotated by half a turn about z from ur_description's
``base_link``; their flange is ``tool0``. ABB's controllers use the base frame, ROS-Industrial's ``base`` or
``base_link``, and their ``tool0`` is the flange with z pointing out of it. ROS's ``flange`` has x pointing out of the
flange (REP 199). Robots that are not URDFs, such as truearm's built-in ones, use the controller's own frames.
ROS-Industrial's ``base`` of KUKA and Fanuc arms is the controller's world frame. Other names do not determine the pose
of a frame.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from truearm.correct.programs.krl import read_krl
from truearm.correct.programs.ls import read_ls
from truearm.correct.programs.order import closure
from truearm.correct.programs.program import Program, Surroundings
from truearm.correct.programs.rapid import read_rapid
from truearm.correct.programs.tokens import Source
from truearm.correct.programs.urscript import WORDS, calls_in, read_urscript
from truearm.errors import InputError
from truearm.text import one_line
from truearm.types import Floats

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


class Frame(NamedTuple):
    """A controller's frame in a frame of the calibration, (4, 4), and its description in words."""

    pose: Floats
    words: str

    def called(self, name: str) -> str:
        """Return what this frame is; ``name`` is that of the calibration's frame."""
        return f"the calibration's frame {one_line(name[:60])}" if self is SAME else self.words


def _turn(words: str, roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0) -> Frame:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", [roll, pitch, yaw]).as_matrix()
    return Frame(pose, words)


_HALF, _QUARTER = np.pi, 0.5 * np.pi
SAME = _turn("the same frame")
BASES = {
    "urscript": {
        "base_link": _turn("base (half a turn about z from base_link)", yaw=_HALF),
        "base_link_inertia": _turn("base (the same frame as base_link_inertia)"),
    },
    "rapid": {"base_link": _turn("base (the same frame as base_link)")},
}  # beside base, which is each controller's own
FLANGES = {
    "urscript": {"flange": _turn("tool0 (z out of the flange)", roll=_QUARTER, yaw=_QUARTER)},
    "rapid": {"flange": _turn("tool0 (z out of the flange)", pitch=_QUARTER)},
}  # beside tool0
OUT = {"tool0": 2, "flange": 0}  # which of a frame's axes points out of the flange
ALONG = 1.0 - 1e-6


def base_of(language: str, frame: str) -> Frame | None:
    """Return the controller's base in the calibration's base frame, or None if the name does not determine it."""
    return SAME if frame == "base" else BASES.get(language, {}).get(frame)


def flange_of(language: str, frame: str, brought: bool, axis: Floats | None = None) -> Frame | None:
    """Return the controller's flange in the calibration's end frame, or None if the name does not determine it.

    ``brought``: the robot is not a URDF. ``axis``: the last joint's axis (3,) in the end frame. In a URDF, it must be
    the direction that points out of a frame of this name: not every description follows REP 199.
    """
    if brought:
        return SAME if frame in ("flange", "tool0") else None
    if axis is not None and abs(axis[OUT.get(frame, 2)]) < ALONG:
        return None
    return SAME if frame == "tool0" else FLANGES.get(language, {}).get(frame)
