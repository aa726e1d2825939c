"""A robot program that was read: its text and its moves, each with its goals."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import NamedTuple, assert_never

from truearm.collector import uncollected
from truearm.errors import ProgramError
from truearm.files.disk import read_bytes
from truearm.files.programs import rapid_meaning, urscript_meaning
from truearm.files.programs.dataflow import Flow
from truearm.files.programs.motions import Motion, goals_of
from truearm.files.programs.rapid import read_rapid
from truearm.files.programs.rapid_poses import tooldata, wobjdata
from truearm.files.programs.suffixes import ProgramLanguage, language_of
from truearm.files.programs.syntax import Source
from truearm.files.programs.urscript import read_urscript
from truearm.files.programs.values import Pose, Unknown
from truearm.files.programs.work import Work
from truearm.text import one_line

MAX_BYTES = 64 * 2**20


class Surroundings(NamedTuple):
    """The external definitions of a program.

    ``tool``: the active tool before a URScript sets one, None if unknown. ``tools`` and ``works``: those of a RAPID
    program that are declared elsewhere, by name in lower case: positions [m] and rotation vectors [rad]. ``harmless``:
    external routines that do not move the robot.
    """

    tool: Pose | None = None
    tools: Mapping[str, Sequence[float]] = {}
    works: Mapping[str, Sequence[float]] = {}
    harmless: frozenset[str] = frozenset()


@dataclass(frozen=True)
class Program:
    """A program and its moves, in the order of the text.

    ``judged``: the literals whose numbers a condition reads, and that condition, by their places. ``unused``: tools and
    work objects of the surroundings that a RAPID program does not mention, each with a similar name in it, or "".
    """

    language: ProgramLanguage
    source: Source
    motions: tuple[Motion, ...]
    judged: Mapping[int, int] = field(default_factory=dict)
    unused: Mapping[str, str] = field(default_factory=dict)

    @cached_property
    def motion_at(self) -> Mapping[int, Motion]:
        """Return the moves by their places."""
        return {motion.start: motion for motion in self.motions}


def read_program(path: Path, surroundings: Surroundings) -> Program:
    """Read a program and follow its moves. Raises ProgramError with file and line."""
    source = _source_of(read_bytes(path, MAX_BYTES, ProgramError), str(path))  # the bytes are not kept
    return _program_of(source, language_of(path), surroundings)


def parse_program(data: bytes, language: ProgramLanguage, surroundings: Surroundings, name: str = "program") -> Program:
    """Follow the moves of a program. Raises ProgramError."""
    return _program_of(_source_of(data, name), language, surroundings)


def _source_of(data: bytes, name: str) -> Source:
    source = Source(data.decode("latin-1"), name)
    _check_text(source, data)
    return source


@uncollected()
def _program_of(source: Source, language: ProgramLanguage, surroundings: Surroundings) -> Program:
    work = Work(source)
    try:
        flow = _followed(work, language, surroundings)
    except RecursionError as exc:  # thousands of operators in one expression
        raise work.wrong("an expression is nested too deeply; split it") from exc
    motions = tuple(flow.motions[start] for start in sorted(flow.motions))
    for motion in motions:
        motion.goals = goals_of(motion.legs)
    if not motions:
        raise ProgramError(f"{source.name}: contains no move; there is nothing to correct")
    return Program(language, source, motions, flow.judged, flow.unused)


def _followed(work: Work, language: ProgramLanguage, surroundings: Surroundings) -> Flow:
    match language:
        case "urscript":
            tool = surroundings.tool or Unknown("no set_tcp comes before it, so its tool is not known", 0, "tool")
            return urscript_meaning.analyse(work, read_urscript(work), (tool,), surroundings.harmless)
        case "rapid":
            given = {name: tooldata(six) for name, six in surroundings.tools.items()}
            given |= {name: wobjdata(six) for name, six in surroundings.works.items()}
            return rapid_meaning.analyse(work, read_rapid(work), given, surroundings.harmless)
        case _:
            assert_never(language)


def _check_text(source: Source, data: bytes) -> None:
    """Reject what is not text, and text in two encodings: it was assembled from parts, and names may not match."""
    if (at := source.text.find("\0")) >= 0:
        raise source.wrong(at, "holds a NUL byte, so it is not a program in a one-byte encoding or UTF-8")
    try:
        data.decode("utf-8")
    except UnicodeDecodeError as exc:
        for line in LINES.finditer(data):
            if not line[0].isascii() and (_is_utf8(line[0]) or UMLAUTS.search(line[0])):
                number = source.line(line.start())
                found = f"line {source.line(exc.start)} is not UTF-8, but line {number} contains UTF-8"
                raise ProgramError(f"{source.name}: {found}; save the file in one encoding") from exc


LINES = re.compile(rb"[^\r\n]+")
UMLAUTS = re.compile(rb"(?<![\x80-\xff])(?:\xc3[\x80-\xbf])+(?![\x80-\xff])")  # Latin letters in UTF-8, not in Latin-1


def _is_utf8(line: bytes) -> bool:
    try:
        line.decode("utf-8")
    except UnicodeDecodeError:
        return False
    return True


def statement_of(program: Program, motion: Motion) -> str:
    """Return a move's statement, shortened to one line."""
    text = one_line(" ".join(program.source.text[motion.start : motion.end].split()))
    return text if len(text) <= 60 else f"{text[:57]}..."


class Refused(NamedTuple):
    """A move that cannot be corrected: line, statement and reason; ``remedy``: the argument to resolve it, or ""."""

    line: int
    statement: str
    why: str
    remedy: str = ""


def refused_at(program: Program, at: int, why: str, remedy: str = "") -> Refused:
    """Return the rejection of the move at a place."""
    return Refused(program.source.line(at), statement_of(program, program.motion_at[at]), why, remedy)
