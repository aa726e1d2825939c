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
MOVE = re.compile(r"\s*\d*:\s*([JLCSA])\s+(?=PR?\[)")
POINT = re.compile(r"\b(PR?)\[\s*(\w+)(\[?)[^\]\n]*\]")
POINT_DATA = re.compile(r"^P\[\s*(\d+)[^\]\n]*\]\s*\{", re.MULTILINE)
GROUP = re.compile(r"GP(\d+)\s*:")
FRAMES = re.compile(r"UF\s*:\s*(\w+)\s*,\s*UT\s*:\s*(\w+)")
POSE = [
    re.compile(rf"\b{name}{_NUMBER}{unit}")
    for name, unit in (("X", "mm"), ("Y", "mm"), ("Z", "mm"), ("R", "deg"), ("P", "deg"), ("W", "deg"))
]  # W, P, R about the fixed x, y, z are R, P, W about z, the new y, the new x
JOINTS = [re.compile(rf"\bJ{axis}{_NUMBER}deg") for axis in range(1, 7)]
EXTERNAL = re.compile(r"\bE\d\s*=")
DISPLACED = re.compile(r"\b(Offset|Tool_Offset|INC|VOFFSET|SKIP|COORD|Weave|PSPI|EV)\b", re.IGNORECASE)
FRAME_CHANGE = re.compile(r"\s*\d*:\s*(U(?:FRAME|TOOL)\[|(?:TOOL_)?OFFSET CONDITION)", re.IGNORECASE)
BRANCHING = re.compile(r"\s*\d*:\s*(LBL\[|CALL|RUN|IF|ELSE|ENDIF|FOR|ENDFOR|SELECT|\w+\s*$)", re.IGNORECASE)


def read_ls(files: Sequence[Source], surroundings: Surroundings) -> Program:
    """Read LS files. Tools and user frames are given by the names ut1, uf1 …; uf0 is the world."""
    program = Program("ls", list(files))
    for number, source in enumerate(files):
        _File(program, surroundings, number, source.text).read()
    return program


@dataclass(eq=False)
class _File:
    """One LS file; ``blocked``: why none of its moves is corrected."""

    program: Program
    surroundings: Surroundings
    number: int
    text: str
    data: dict[int, Datum] = field(default_factory=dict)
    points: dict[int, tuple[int, int]] = field(default_factory=dict)
    literals: dict[int, Literal] = field(default_factory=dict)
    blocked: Uncertain | None = None

    def read(self) -> None:
        """Add the moves of the file."""
        start = self.text.find("/MN") + len("/MN")
        end = self.text.find("/POS")
        end = len(self.text) if end < 0 else end
        matches = list(POINT_DATA.finditer(self.text, end))
        for match, following in zip(matches, [*(m.start() for m in matches[1:]), len(self.text)], strict=True):
            self.points[int(match[1])] = match.end(), following
        statements = [match.span() for match in STATEMENT.finditer(self.text, start, end)]
        for first, last in statements:
            self.note(first, last)
        self.program.steps.append(Step.ROUTINE)
        for first, last in statements:
            move = MOVE.match(self.text, first, last)
            if move is not None:
                self.add_move(move, last)
            elif BRANCHING.match(self.text, first, last - 1):
                self.program.steps.append(Step.CALL)
        self.program.steps.append(Step.END)

    def note(self, first: int, last: int) -> None:
        """Note the uses of points in a statement, and what changes all of them."""
        where = self.program.where(Place(self.number, last - 1))
        if FRAME_CHANGE.match(self.text, first, last):
            self.blocked = Uncertain("displaced", name="a frame or offset", where=where)
        is_move = MOVE.match(self.text, first, last)
        for match in POINT.finditer(self.text, first, last):
            if match[1] != "P":
                continue
            place = Place(self.number, match.start())
            if match[2].isdigit():
                self.data.setdefault(int(match[2]), Datum(f"P[{match[2]}]", "point", "var", place)).uses.add(place)
            elif not is_move:
                self.blocked = Uncertain("assigned", name="a point by a computed number", where=where)

    def add_move(self, match: re.Match[str], end: int) -> None:
        """Add a move with its points: two of a circle, one of another move."""
        move = Move(match[1], Place(self.number, match.start(1)), end, match[1] == "L")
        self.program.moves.append(move)
        self.program.steps.append(move)
        try:
            if self.blocked is not None:
                raise self.blocked.again()
            if DISPLACED.search(self.text, match.end(), end):
                raise Uncertain("path")
            points = list(POINT.finditer(self.text, match.end(), end))
            if len(points) != 1 + (match[1] == "C"):
                raise Uncertain("arguments")
            move.goals = [self.goal(point) for point in points]
        except Uncertain as uncertain:
            move.refuse(uncertain)

    def goal(self, point: re.Match[str]) -> Goal:
        """Return the goal of a point in a move. Raises Uncertain."""
        if point[1] == "PR" or not point[2].isdigit():
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
