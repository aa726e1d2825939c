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
    Memo,
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

STATEMENT = re.compile(r"[^;]*;")
MOVE = re.compile(r"\s*\d*:\s*([JLCSA])\s+(?=\w+\s*\[)", re.IGNORECASE)
POINT = re.compile(r"\b(PR?)\[\s*(\w+)(\[?)[^\]\n]*\]", re.IGNORECASE)
POINT_DATA = re.compile(r"^P\[\s*(\d+)[^\]\n]*\]\s*\{", re.MULTILINE)
GROUP = re.compile(r"GP1\s*:(.*?)(?=GP\d+\s*:|\Z)", re.DOTALL)
FRAMES = re.compile(r"UF\s*:\s*(\w+)\s*,\s*UT\s*:\s*(\w+)")
NUMBER = re.compile(r"\b(?:([XYZWPR]|J\d)\s*=\s*(-?\d*\.?\d+)\s*(mm|deg)|E\d\s*=)")
POSE = ("Xmm", "Ymm", "Zmm", "Rdeg", "Pdeg", "Wdeg")  # W, P, R about fixed x, y, z are R, P, W about z, new y, new x
JOINTS = tuple(f"J{axis}deg" for axis in range(1, 7))
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
    changes = [change for file in parsed if (change := file.read()) is not None]
    for file in parsed:
        file.add_moves(changes[0] if changes else file.displaced)
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
    memo: Memo = field(default_factory=Memo)
    statements: list[tuple[int, int]] = field(default_factory=list)
    displaced: Uncertain | None = None

    def read(self) -> Uncertain | None:
        """Note the points, their uses and what displaces them; return what changes the frames of all files."""
        start = self.text.find("/MN") + len("/MN")
        end = self.text.find("/POS") if "/POS" in self.text else len(self.text)
        matches = list(POINT_DATA.finditer(self.text, end))
        ends = [*(match.start() for match in matches[1:]), len(self.text)]
        self.points = {int(match[1]): (match.end(), last) for match, last in zip(matches, ends, strict=False)}
        spans = (match.span() for match in STATEMENT.finditer(self.text, start, end))
        self.statements = [span for span in spans if not REMARK.match(self.text, *span)]
        if (match := LINE_TRACK.search(self.text, 0, start)) is not None:
            self.displaced = self.reason("displaced", "LINE_TRACK", match.start())
        frames_change = None
        for first, last in self.statements:
            is_move = MOVE.match(self.text, first, last)
            for point in POINT.finditer(self.text, first, last):
                if point[1].upper() == "P" and point[2].isdigit():
                    datum = Datum(f"P[{point[2]}]", "point", "var", Place(self.number, point.start()))
                    self.data.setdefault(int(point[2]), datum).uses.add(datum.place)
                elif point[1].upper() == "P" and not is_move:
                    self.displaced = self.reason("assigned", "a point by a computed number", last - 1)
            if TOUCH_OFFSET.match(self.text, first, last):
                self.displaced = self.reason("displaced", "Touch Offset", last - 1)
            if FRAME_CHANGE.match(self.text, first, last):
                frames_change = self.reason("displaced", "a frame", last - 1)
        return frames_change

    def reason(self, code: str, name: str, offset: int) -> Uncertain:
        """Return a reason with its line."""
        return Uncertain(code, name=name, where=self.program.where(Place(self.number, offset)))

    def add_moves(self, displaced: Uncertain | None) -> None:
        """Add the moves, refused if they are ``displaced``."""
        self.program.steps.append(Step.ROUTINE)
        for first, last in self.statements:
            match = MOVE.match(self.text, first, last)
            if match is None:
                if BRANCHING.match(self.text, first, last - 1):
                    self.program.steps.append(Step.CALL)
                continue
            name = match[1].upper()
            move = Move(name, Place(self.number, match.start(1)), last, name == "L")
            self.program.moves.append(move)
            self.program.steps.append(move)
            try:
                if displaced is not None:
                    raise displaced.again()
                move.goals = self.goals(name, match.end(), last)
                self.program.count(move)
            except Uncertain as uncertain:
                move.refuse(uncertain)
        self.program.steps.append(Step.END)

    def goals(self, name: str, first: int, last: int) -> list[Goal]:
        """Return the goals of a move: two of a circle, one of another move. Raises Uncertain."""
        if DISPLACED.search(self.text, first, last):
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
        literal, frame, tool = self.memo.get(number, lambda: self.literal(number))
        target = Target(literal, uses=((self.data[number], Place(self.number, point.start())),))
        if literal.form.is_joints:
            return Goal(target)
        return Goal(target, self.frame(f"ut{tool}", "tool"), self.frame(f"uf{frame}", "user frame"))

    def frame(self, name: str, subject: str) -> Floats:
        """Return a tool or user frame that is given by its name. Raises Uncertain."""
        pose = IDENTITY if name == "uf0" else self.surroundings.frames.get(name.lower())
        if pose is None:
            raise Uncertain("undeclared", name=name.upper(), subject=subject)
        return pose

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
