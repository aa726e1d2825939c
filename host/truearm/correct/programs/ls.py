"""The moves of Fanuc's LS programs. Every P[n] has its numbers, user frame and tool in the section /POS."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field

from truearm.correct.programs.poses import check_reach
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
    Uncertain,
)
from truearm.correct.programs.tokens import Source
from truearm.types import Floats

_NUMBER = r"\s*=\s*(-?\d*\.?\d+)\s*"
STATEMENT = re.compile(r"[^;]*;")
MOVE = re.compile(r"\s*\d*:\s*([JLCSA])\s+(?=\w+\s*\[)", re.IGNORECASE)
POINT = re.compile(r"\b(PR?)\[\s*(\w+)(\[?)[^\]\n]*\]", re.IGNORECASE)
POINT_DATA = re.compile(r"^P\[\s*(\d+)[^\]\n]*\]\s*\{", re.MULTILINE)
GROUP = re.compile(r"GP(\d+)\s*:")
FRAMES = re.compile(r"UF\s*:\s*(\w+)\s*,\s*UT\s*:\s*(\w+)")
POSE = [
    re.compile(rf"\b{name}{_NUMBER}{unit}")
    for name, unit in (("X", "mm"), ("Y", "mm"), ("Z", "mm"), ("R", "deg"), ("P", "deg"), ("W", "deg"))
]  # W, P, R about the fixed x, y, z are R, P, W about z, the new y, the new x
JOINTS = [re.compile(rf"\bJ{axis}{_NUMBER}deg") for axis in range(1, 7)]
EXTERNAL = re.compile(r"\bE\d\s*=")
REMARK = re.compile(r"\s*\d*:\s*(?:!|//)")
DISPLACED = re.compile(r"\b(Offset|Tool_Offset|INC|VOFFSET|SKIP|COORD|RTCP|Weave|PSPI|EV)\b", re.IGNORECASE)
FRAME_CHANGE = re.compile(r"\s*\d*:\s*(?:UFRAME|UTOOL|\$MNUFRAME|\$MNUTOOL)\s*\[", re.IGNORECASE)
TOUCH_OFFSET = re.compile(r"\s*\d*:\s*Touch\s+Offset\b", re.IGNORECASE)
LINE_TRACK = re.compile(r"\bLINE_TRACK_SCHEDULE_NUMBER\s*:\s*[1-9]", re.IGNORECASE)
BRANCHING = re.compile(r"\s*\d*:\s*(LBL\[|CALL|RUN|IF|ELSE|ENDIF|FOR|ENDFOR|SELECT|\w+\s*$)", re.IGNORECASE)


def read_ls(files: Sequence[Source], surroundings: Surroundings) -> Program:
    """Read LS files. Tools and user frames are given by the names ut1, uf1 …; uf0 is the world."""
    program = Program("ls", list(files))
    parsed = [_File(program, surroundings, number, source.text) for number, source in enumerate(files)]
    frames_change = next((change for change in [file.read() for file in parsed] if change is not None), None)
    for file in parsed:
        file.add_moves(frames_change or file.displaced)
    return program


@dataclass(eq=False)
class _File:
    """One LS file; ``displaced``: why none of its moves is corrected."""

    program: Program
    surroundings: Surroundings
    number: int
    text: str
    data: dict[int, Datum] = field(default_factory=dict)
    points: dict[int, tuple[int, int]] = field(default_factory=dict)
    literals: dict[int, Literal] = field(default_factory=dict)
    statements: list[tuple[int, int]] = field(default_factory=list)
    displaced: Uncertain | None = None

    def read(self) -> Uncertain | None:
        """Note the points and their uses; return what changes the frames of all files."""
        start = self.text.find("/MN") + len("/MN")
        end = self.text.find("/POS")
        end = len(self.text) if end < 0 else end
        matches = list(POINT_DATA.finditer(self.text, end))
        ends = [*(match.start() for match in matches[1:]), len(self.text)]
        self.points = {int(match[1]): (match.end(), last) for match, last in zip(matches, ends, strict=False)}
        if (match := LINE_TRACK.search(self.text, 0, start)) is not None:
            self.displaced = self.displacement("LINE_TRACK", match.start())
        spans = (match.span() for match in STATEMENT.finditer(self.text, start, end))
        self.statements = [span for span in spans if not REMARK.match(self.text, *span)]
        frames_change = None
        for first, last in self.statements:
            self.note(first, last)
            if FRAME_CHANGE.match(self.text, first, last):
                frames_change = self.displacement("a frame", last - 1)
        return frames_change

    def displacement(self, name: str, offset: int) -> Uncertain:
        """Return that something in the text displaces the moves."""
        return Uncertain("displaced", name=name, where=self.program.where(Place(self.number, offset)))

    def add_moves(self, displaced: Uncertain | None) -> None:
        """Add the moves, refused if they are ``displaced``."""
        self.program.steps.append(Step.ROUTINE)
        for first, last in self.statements:
            move = MOVE.match(self.text, first, last)
            if move is not None:
                self.add_move(move, last, displaced)
            elif BRANCHING.match(self.text, first, last - 1):
                self.program.steps.append(Step.CALL)
        self.program.steps.append(Step.END)

    def note(self, first: int, last: int) -> None:
        """Note the uses of points in a statement, and what displaces all of them."""
        if TOUCH_OFFSET.match(self.text, first, last):
            self.displaced = self.displacement("Touch Offset", last - 1)
        is_move = MOVE.match(self.text, first, last)
        for match in POINT.finditer(self.text, first, last):
            if match[1].upper() != "P":
                continue
            place = Place(self.number, match.start())
            if match[2].isdigit():
                self.data.setdefault(int(match[2]), Datum(f"P[{match[2]}]", "point", "var", place)).uses.add(place)
            elif not is_move:
                where = self.program.where(Place(self.number, last - 1))
                self.displaced = Uncertain("assigned", name="a point by a computed number", where=where)

    def add_move(self, match: re.Match[str], end: int, displaced: Uncertain | None) -> None:
        """Add a move with its points: two of a circle, one of another move."""
        name = match[1].upper()
        move = Move(name, Place(self.number, match.start(1)), end, name == "L")
        self.program.moves.append(move)
        self.program.steps.append(move)
        try:
            if displaced is not None:
                raise displaced.again()
            if DISPLACED.search(self.text, match.end(), end):
                raise Uncertain("path")
            points = list(POINT.finditer(self.text, match.end(), end))
            if len(points) != 1 + (name == "C"):
                raise Uncertain("arguments")
            move.goals = [self.goal(point) for point in points]
        except Uncertain as uncertain:
            move.refuse(uncertain)

    def goal(self, point: re.Match[str]) -> Goal:
        """Return the goal of a point in a move. Raises Uncertain."""
        if point[1].upper() == "PR" or not point[2].isdigit():
            raise Uncertain("register")
        number = int(point[2])
        literal, user_frame, tool = self.literal(number)
        target = Target(literal, uses=((self.data[number], Place(self.number, point.start())),))
        if literal.form.is_joints:
            return Goal(target)
        return Goal(target, self.frame(f"ut{tool}", "tool"), self.frame(f"uf{user_frame}", "user frame"))

    def frame(self, name: str, subject: str) -> Floats:
        """Return a tool or user frame that is given by its name."""
        if name == "uf0":
            return IDENTITY
        if name.lower() not in self.surroundings.frames:
            raise Uncertain("undeclared", name=name.upper(), subject=subject)
        return self.surroundings.frames[name.lower()]

    def literal(self, number: int) -> tuple[Literal, str, str]:
        """Return the numbers of a point with its user frame and tool. Raises Uncertain."""
        if number not in self.points:
            raise Uncertain("undeclared", name=f"P[{number}]")
        first, last = self.points[number]
        groups = list(GROUP.finditer(self.text, first, last))
        group = next((index for index, match in enumerate(groups) if match[1] == "1"), None)
        if group is None:
            raise Uncertain("no-value", name=f"P[{number}]")
        first = groups[group].end()
        last = groups[group + 1].start() if group + 1 < len(groups) else last
        frames = FRAMES.search(self.text, first, last)
        if frames is None:
            raise Uncertain("frames")
        if number not in self.literals:
            form, matches = Form.ANGLES, [pattern.search(self.text, first, last) for pattern in POSE]
            if not all(matches):
                form, matches = Form.DEGREES, [pattern.search(self.text, first, last) for pattern in JOINTS]
            if not all(matches) or EXTERNAL.search(self.text, first, last):
                raise Uncertain("type", type="point of six numbers without external axes")
            numbers = tuple(float(match[1]) for match in matches if match)
            spans = tuple(match.span(1) for match in matches if match)
            literal = Literal(Place(self.number, min(spans)[0]), max(spans)[1], form, numbers, spans)
            check_reach(literal)
            self.literals[number] = literal
        return self.literals[number], frames[1], frames[2]
