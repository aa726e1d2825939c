"""The moves of Fanuc's LS programs. Every P[n] has its numbers, user frame and tool in the section /POS."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from functools import partial

from truearm.correct.programs.program import (
    IDENTITY,
    Datum,
    Form,
    Goal,
    Literal,
    Move,
    Place,
    Program,
    Step,
    Surroundings,
    Target,
)
from truearm.correct.programs.reading import Reading, Uncertain, check_reach
from truearm.correct.programs.tokens import Source
from truearm.types import Floats

STATEMENT = re.compile(r"(?:\s*+\d*+:)?+\s*+([^;]*);")
MOVE = re.compile(r"([JLCSA])\s+(?=\w+\s*\[)", re.IGNORECASE)
POINT = re.compile(r"\b(PR?)\[\s*(\w+)(\[?)[^\]\n]*\]", re.IGNORECASE)
POINT_DATA = re.compile(r"^P\[\s*(\d+)[^\]\n]*\]\s*\{(.*?)(?=^P\[|\Z)", re.MULTILINE | re.DOTALL)
GROUP = re.compile(r"GP1\s*:(.*?)(?=GP\d+\s*:|\Z)", re.DOTALL)
FRAMES = re.compile(r"UF\s*:\s*(\w+)\s*,\s*UT\s*:\s*(\w+)")
NUMBER = re.compile(r"\b(?:([XYZWPR]|J\d)\s*=\s*(-?\d*\.?\d+)\s*(mm|deg)|E\d\s*=)")
POSE = ("Xmm", "Ymm", "Zmm", "Rdeg", "Pdeg", "Wdeg")  # W, P, R about fixed x, y, z are R, P, W about z, new y, new x
JOINTS = tuple(f"J{axis}deg" for axis in range(1, 7))
REMARK = ("!", "//")
RUN_TIME = re.compile(r"\b(Offset|Tool_Offset|INC|VOFFSET|SKIP|COORD|RTCP|Weave|PSPI|EV)\b", re.IGNORECASE)
# also after IF …,
DISPLACING = re.compile(r"Touch\s+Offset\b|(?:\bUFRAME|\bUTOOL|\$MNUFRAME|\$MNUTOOL)(?=\s*\[[^=]*=)", re.IGNORECASE)
CALLED = re.compile(r"\b(?:CALL|RUN)\s+(\w+)", re.IGNORECASE)
LINE_TRACK = re.compile(r"\bLINE_TRACK_SCHEDULE_NUMBER\s*:\s*[1-9]", re.IGNORECASE)
BRANCHING = re.compile(r"(LBL\[|CALL|RUN|IF|ELSE|ENDIF|FOR|ENDFOR|SELECT|\w+\s*$)", re.IGNORECASE)


def read_ls(files: Sequence[Source], surroundings: Surroundings) -> Program:
    """Read LS files. Tools and user frames are given by the names ut1, uf1 …; uf0 is the world."""
    reading = Reading(Program("ls", list(files)), surroundings)
    parsed = [_File(reading, number, source.text) for number, source in enumerate(files)]
    programs = {source.name.rsplit("/", 1)[-1].rsplit(".", 1)[0].lower() for source in files}
    for file in parsed:
        file.read(programs)
    for file in parsed:
        file.add_moves()
    return reading.program


@dataclass(eq=False)
class _File:
    """One LS file; ``tracked``: why none of its moves is corrected."""

    reading: Reading
    number: int
    text: str
    data: dict[int, Datum] = field(default_factory=dict)
    points: dict[int, tuple[int, int]] = field(default_factory=dict)
    statements: list[tuple[int, int]] = field(default_factory=list)
    tracked: Uncertain | None = None

    def read(self, programs: Collection[str]) -> None:
        """Note the points, their uses and what displaces them: a frame that is set counts in all files.

        Calls of other programs than ``programs`` lead out of the files.
        """
        start = self.text.find("/MN") + len("/MN")
        end = self.text.find("/POS") if "/POS" in self.text else len(self.text)
        self.points = {int(match[1]): match.span(2) for match in POINT_DATA.finditer(self.text, end)}
        spans = (match.span(1) for match in STATEMENT.finditer(self.text, start, end))
        self.statements = [span for span in spans if not self.text.startswith(REMARK, *span)]
        if (match := LINE_TRACK.search(self.text, 0, start)) is not None:
            self.tracked = Uncertain("displacing", name="LINE_TRACK", where=self.where(match.start()))
        computed = set()
        for first, last in self.statements:
            for point in POINT.finditer(self.text, first, last):
                if point[1].upper() == "P" and point[2].isdigit():
                    datum = Datum(f"P[{point[2]}]", "point", "var", Place(self.number, point.start()))
                    self.data.setdefault(int(point[2]), datum).uses.add(datum.place)
                elif point[1].upper() == "P":
                    computed.add(Place(self.number, point.start()))
            if (match := DISPLACING.search(self.text, first, last)) is not None:
                self.reading.displace("displacing", match[0], Place(self.number, first))
            for call in CALLED.finditer(self.text, first, last):
                if call[1].lower() not in programs:
                    self.reading.program.absent[call[1]] = None
        for datum in self.data.values():
            datum.uses |= computed  # a computed number may be that of any point

    def where(self, offset: int) -> str:
        """Return the line of an offset."""
        return self.reading.program.where(Place(self.number, offset))

    def add_moves(self) -> None:
        """Add the moves."""
        steps = self.reading.program.steps
        steps.append(Step.ROUTINE)
        for first, last in self.statements:
            match = MOVE.match(self.text, first, last)
            if match is not None:
                name = match[1].upper()
                move = Move(name, Place(self.number, first), last, name == "L")
                self.reading.add_move(move, partial(self.goals, name, match.end(), last))
            elif BRANCHING.match(self.text, first, last):
                steps.append(Step.CALL)
        steps.append(Step.END)

    def goals(self, name: str, first: int, last: int) -> list[Goal]:
        """Return the goals of a move: two of a circle, one of another move. Raises Uncertain."""
        self.reading.check_displacement()
        if self.tracked is not None:
            raise self.tracked.again()
        if RUN_TIME.search(self.text, first, last):
            raise Uncertain("path")
        points = list(POINT.finditer(self.text, first, last))
        if len(points) != 1 + (name == "C"):
            raise Uncertain("arguments")
        return [self.goal(point) for point in points]

    def goal(self, point: re.Match[str]) -> Goal:
        """Return the goal of a point in a move. Raises Uncertain."""
        if point[1].upper() == "PR" or not point[2].isdigit():
            raise Uncertain("register")
        number = int(point[2])
        literal, frame, tool = self.reading.once((self.number, number), lambda: self.literal(number))
        target = Target(literal, uses=((self.data[number], Place(self.number, point.start())),))
        if literal.form.is_joints:
            return Goal(target)
        return Goal(target, self.frame(f"ut{tool}", "tool"), self.frame(f"uf{frame}", "user frame"))

    def frame(self, name: str, subject: str) -> Floats:
        """Return a tool or user frame that is given by its name. Raises Uncertain."""
        otherwise = Uncertain("undeclared", name=name.upper(), subject=subject)
        return IDENTITY if name == "uf0" else self.reading.given(name.lower(), otherwise)

    def literal(self, number: int) -> tuple[Literal, str, str]:
        """Return the numbers of a point in the first group of axes, with its user frame and tool. Raises Uncertain."""
        if number not in self.points:
            raise Uncertain("undeclared", name=f"P[{number}]")
        group = GROUP.search(self.text, *self.points[number])
        if group is None:
            raise Uncertain("no-value", name=f"P[{number}]")
        frames = FRAMES.search(self.text, *group.span(1))
        if frames is None:
            raise Uncertain("frames")
        matches = {f"{match[1]}{match[3]}": match for match in NUMBER.finditer(self.text, *group.span(1))}
        form, names = (Form.ANGLES, POSE) if matches.keys() >= set(POSE) else (Form.DEGREES, JOINTS)
        if not matches.keys() >= set(names) or "NoneNone" in matches:
            raise Uncertain("type", type="point of six numbers without external axes")
        numbers = tuple(float(matches[name][2]) for name in names)
        spans = tuple(matches[name].span(2) for name in names)
        literal = Literal(Place(self.number, min(spans)[0]), max(spans)[1], form, numbers, spans)
        check_reach(literal)
        return literal, frames[1], frames[2]
