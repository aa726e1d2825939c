"""The moves of KUKA programs (.src with its .dat), each with its target, tool and base.

Names of a .dat file are seen by the .src of the same name, global ones and those of $config.dat by all. The tool and
base of a move are those that were set before it, with no branch, loop or call of another routine between.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field

from truearm.correct.programs.poses import check_reach, matrix_of_angles
from truearm.correct.programs.program import (
    IDENTITY,
    Change,
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
    certain,
)
from truearm.correct.programs.tokens import (
    KRL,
    Source,
    Token,
    Tokens,
    closing,
    is_bracketed,
    is_word,
    separated,
    tokens_of,
    words,
)
from truearm.types import Floats

MOVES = words("ptp lin circ sptp slin scirc spl")
RELATIVE = frozenset(f"{name}_rel" for name in MOVES)
TYPES = words("e6pos pos frame e6axis axis fdat")
POSE, AXES = ("x", "y", "z", "a", "b", "c"), ("a1", "a2", "a3", "a4", "a5", "a6")
QUIET = words(
    "bas bas_command wait halt continue trigger pulse abs sin cos tan sqrt varstate ext extp extfct decl global"
)
FRAMES = ("tool_data", "base_data")
ACTIVE = words("$tool $base $ipo_mode")
ROOTS = words("$robroot $world")  # of all frames
PARAMETERS = words("#frames #ptp_params #cp_params")  # of BAS, which takes tool and base of FDAT_ACT with them
STEPS = {
    word: step
    for step, names in (
        (Step.ROUTINE, "def deffct"),
        (Step.END, "end endfct endif endfor endwhile endloop endswitch until"),
        (Step.IF, "if switch"),
        (Step.LOOP, "for while loop repeat"),
        (Step.BRANCH, "else case default"),
        (Step.LEAVE, "exit"),
        (Step.CALL, "interrupt resume goto"),
    )
    for word in names.split()
}


@dataclass(frozen=True, eq=False)
class Line:
    """The tokens of a line, in a file of a module."""

    tokens: Tokens
    file: int
    module: str

    @property
    def word(self) -> str:
        """Its first word, after GLOBAL."""
        return self.tokens[is_word(self.tokens, 0, "global") and len(self.tokens) > 1].text

    @property
    def assigned(self) -> int:
        """The index of the sign of an assignment, 0 if it is none."""
        sign = next((index for index, token in enumerate(self.tokens) if token.text == "="), 0)
        return sign if self.tokens[0].text not in ("if", "while", "until", "for", "switch", "wait") else 0


@dataclass(eq=False)
class _Reader:
    """Data and frames of all files. ``displaced``: why no move's tool and base are known."""

    program: Program
    surroundings: Surroundings
    lines: list[Line] = field(default_factory=list)
    modules: dict[str, dict[str, Datum]] = field(default_factory=lambda: defaultdict(dict))
    parameters: dict[str, set[str]] = field(default_factory=lambda: defaultdict(set))
    routines: set[str] = field(default_factory=set)
    frames: dict[str, list[Tokens]] = field(default_factory=lambda: defaultdict(list))
    frames_change: Uncertain | None = None
    displaced: Uncertain | None = None
    literals: dict[Place, Literal] = field(default_factory=dict)

    def read(self) -> None:
        """Read the lines of all files, then their data, then the uses of these."""
        for number, source in enumerate(self.program.files):
            module = source.name.lower().replace("\\", "/").rpartition("/")[2].rpartition(".")[0]
            line: list[Token] = []
            for token in [*tokens_of(KRL, source.text), Token("newline", "", len(source.data), len(source.data))]:
                if token.kind != "newline":
                    line.append(token)
                elif line:
                    self.lines.append(Line(line, number, module))
                    line = []
        for entry in self.lines:
            self.declare(entry)
        for entry in self.lines:
            self.program.names.update(token.text for token in entry.tokens if token.kind == "word")
            self.note(entry)
        self.note_interrupts()

    def note_interrupts(self) -> None:
        """Note the routines of interrupts and triggers that set frames, by themselves or by calls, and changes of roots."""
        bodies: dict[str, list[Line]] = defaultdict(list)
        name, waiting = "", []
        for line in self.lines:
            texts = [token.text for token in line.tokens]
            if line.word in ("def", "deffct") and "(" in texts:
                name = texts[texts.index("(") - 1]
            elif line.word in ("end", "endfct", "defdat"):
                name = ""
            bodies[name].append(line)
            if line.word in ("interrupt", "trigger") and "do" in texts[:-1]:
                waiting.append(texts[texts.index("do") + 1])
            if texts[0] in ROOTS and line.assigned:
                self.displaced = self.displacement(line)
        seen: set[str] = set()
        while waiting:
            routine = waiting.pop()
            if routine in seen:
                continue
            seen.add(routine)
            for line in bodies.get(routine, ())[1:]:
                if sets_frames(line):
                    self.displaced = self.displacement(line)
                waiting += [token.text for token in line.tokens if token.text in self.routines]

    def displacement(self, line: Line) -> Uncertain:
        """Return that a line displaces the moves."""
        name = line.tokens[0].text.upper()
        return Uncertain("displaced", name=name, where=self.program.where(Place(line.file, line.tokens[0].start)))

    def declare(self, line: Line) -> None:
        """Note the data, parameters and frames that a line declares."""
        tokens = line.tokens
        if line.word in ("def", "deffct") and "(" in (token.text for token in tokens):
            start = next(index for index, token in enumerate(tokens) if token.text == "(")
            self.routines.add(tokens[start - 1].text)
            self.parameters[line.module] |= {token.text for token in tokens[start:] if token.kind == "word"}
        if tokens[0].text in FRAMES and line.assigned:
            key = "".join(token.text for token in tokens[: line.assigned])
            self.frames[key].append(tokens[line.assigned + 1 :])
            if not (len(key.split("[")) == 2 and key.endswith("]") and key.split("[")[1][:-1].isdigit()):
                where = self.program.where(Place(line.file, tokens[0].start))
                self.frames_change = Uncertain("assigned", name=key.upper(), where=where)
        kind = next((index for index, token in enumerate(tokens[:4]) if token.text in TYPES), len(tokens))
        prefix = {token.text for token in tokens[:kind]}
        if kind > len(tokens) - 2 or prefix - {"decl", "global", "const"}:
            return
        is_global = "global" in prefix or line.module == "$config"
        for declared in separated(tokens[kind + 1 :], ","):
            if declared:
                self.add(line, declared, tokens[kind].text, is_global)

    def add(self, line: Line, declared: Tokens, kind: str, is_global: bool) -> None:
        """Add a datum with its value."""
        name, place = declared[0].text, Place(line.file, declared[0].start)
        names = self.modules["" if is_global else line.module]
        datum = names.setdefault(name, Datum(name, kind, "var", place, not is_global))
        datum.written.add(place)
        if datum.place != place:
            datum.changes.append(Change(place, "redeclared"))
        if is_word(declared, 1, "="):
            datum.values.append((declared[2:], line))

    def find(self, name: str, line: Line) -> Datum | None:
        """Return the datum of a name as seen from a line."""
        return self.modules[line.module].get(name) or self.modules[""].get(name)

    def note(self, line: Line) -> None:
        """Note the uses of data in a line, and what may change them."""
        tokens = line.tokens
        callers: list[str] = []  # of the brackets that are open
        for index, token in enumerate(tokens):
            if token.text in ("(", "[", "{") and token.kind == "sign":
                callers.append(tokens[index - 1].text if index and token.text == "(" else "")
            elif token.text in (")", "]", "}") and token.kind == "sign" and callers:
                callers.pop()
            if (
                token.kind == "word"
                and index > 1
                and is_word(tokens, index - 1, ".")
                and is_word(tokens, index - 2, ".")
            ):
                self.note_path(line, index)
            if token.kind != "word" or is_word(tokens, index - 1, "."):
                continue
            is_head = line.word in ("def", "deffct", "ext", "extfct", "extp")
            if is_word(tokens, index + 1, "(") and not is_head and token.text not in QUIET | self.routines:
                self.program.absent[token.text] = None
            datum, place = self.find(token.text, line), Place(line.file, token.start)
            if datum is None or place in datum.written:
                continue
            if index == 0 and line.assigned == 1:
                datum.written.add(place)
                datum.values.append((tokens[2:], line))
                continue
            datum.uses.add(place)
            is_argument = is_word(tokens, index + 1, ",") or is_word(tokens, index + 1, ")")
            if index == 0 and line.assigned:
                datum.changes.append(Change(place, "assigned"))
            elif callers and callers[-1] and callers[-1] not in QUIET and is_argument:
                change = Change(place, "argument", callers[-1])
                (datum.changes if callers[-1] in self.routines else datum.outside).append(change)

    def note_path(self, line: Line, index: int) -> None:
        """Note the use of a name of another module, as in /R1/P..XP1, which may change it."""
        token = line.tokens[index]
        place = Place(line.file, token.start)
        for names in self.modules.values():
            if (datum := names.get(token.text)) is not None:
                datum.uses.add(place)
                if line.word == "import" or index < line.assigned:
                    datum.changes.append(Change(place, "assigned"))

    def datum(self, name: str, line: Line) -> Datum:
        """Return a certain datum. Raises Uncertain."""
        datum = self.find(name, line)
        if datum is None or name in self.parameters[line.module]:
            code = "undeclared" if datum is None else "parameter"
            raise Uncertain(code, name=name.upper(), kind="parameter")
        certain(self.program, datum, self.surroundings)
        if not datum.values:
            raise Uncertain("no-value", name=name.upper())
        return datum

    def literal(self, tokens: Tokens, file: int) -> Literal:
        """Return the literal {X …, Y …, …} or {A1 …, …}. Raises Uncertain."""
        components = _components(tokens)
        place = Place(file, tokens[0].start)
        if place not in self.literals:
            names: tuple[str, ...] = AXES if "a1" in components else POSE
            if any(name not in components for name in names):
                raise Uncertain("partial")
            for name in components:
                if name[0] == "e" and name not in self.surroundings.unchanged and _number(components[name]):
                    raise Uncertain("axis", name=name)
            if names is POSE and "t" in components:
                names = (*POSE, "t")
            numbers = tuple(_number(components[name]) for name in names)
            spans = tuple((components[name][0].start, components[name][-1].end) for name in names)
            form = Form.DEGREES if names is AXES else Form.ANGLES
            literal = Literal(place, tokens[-1].end, form, numbers, spans)
            check_reach(literal)
            self.literals[place] = literal
        return self.literals[place]

    def frame(self, tokens: Tokens) -> Floats:
        """Return the pose (4, 4) of TOOL_DATA[n], BASE_DATA[n], $NULLFRAME or {X …}. Raises Uncertain."""
        key = "".join(token.text for token in tokens)
        if key in ("$nullframe", "$world", "tool_data[0]", "base_data[0]"):
            return IDENTITY
        if key.startswith(FRAMES):
            if self.frames_change is not None:
                raise self.frames_change.again()
            short = key.replace("[", "").replace("]", "")
            if short in self.surroundings.frames and key not in self.frames:
                return self.surroundings.frames[short]
            values = self.frames.get(key, [])
            if len(values) != 1:
                subject = "tool" if key.startswith("tool") else "base"
                raise Uncertain("several" if values else "undeclared", name=key.upper(), subject=subject)
            tokens = values[0]
        components = _components(tokens)
        if any(name not in components for name in POSE):
            raise Uncertain("not-written")
        x, y, z, a, b, c = (_number(components[name]) for name in POSE)
        return matrix_of_angles(x, y, z, a, b, c)


def _components(tokens: Tokens) -> dict[str, Tokens]:
    """Return the components of {X 1, Y 2, …}; a type before a colon is left out. Raises Uncertain."""
    if not is_bracketed(tokens, 0, "{"):
        raise Uncertain("not-written")
    content = tokens[3:-1] if is_word(tokens, 2, ":") else tokens[1:-1]
    return {component[0].text: component[1:] for component in separated(content, ",") if component}


def _number(tokens: Tokens) -> float:
    """Return a plain number. Raises Uncertain."""
    if (
        not tokens
        or len(tokens) > 2
        or tokens[-1].kind != "number"
        or tokens[0].text not in ("-", "+", tokens[-1].text)
    ):
        raise Uncertain("not-written")
    number = float(tokens[-1].text)
    if not math.isfinite(number):
        raise Uncertain("not-written")
    return -number if tokens[0].text == "-" else number


def sets_frames(line: Line) -> bool:
    """Return whether a line sets the tool or base."""
    texts = [token.text for token in line.tokens]
    return texts[0] in ACTIVE | {"fdat_act"} or (
        texts[:2] == ["bas", "("] and not {"#tool", "#base", "#initmov", *PARAMETERS}.isdisjoint(texts)
    )


# moves


def read_krl(files: Sequence[Source], surroundings: Surroundings) -> Program:
    """Read the modules of a KUKA controller."""
    reader = _Reader(Program("krl", list(files)), surroundings)
    reader.read()
    active = _ActiveFrames(reader)
    for line in reader.lines:
        is_call = (is_word(line.tokens, 1, "(") and line.word not in QUIET) or is_word(line.tokens, 1, ":")
        if is_call or line.word in STEPS:
            active.forget()
            reader.program.steps.append(STEPS.get(line.word, Step.CALL))
        elif line.word in MOVES | RELATIVE and len(line.tokens) > 1 and line.assigned != 1:
            _add_move(reader, line, active)
        else:
            active.note(line)
    return reader.program


@dataclass(eq=False)
class _ActiveFrames:
    """The tool and base that were set last, ``of_data`` if by FDAT_ACT; why they are not known."""

    reader: _Reader
    frames: dict[str, Floats] = field(default_factory=dict)
    reason: Uncertain = field(default_factory=lambda: Uncertain("frames"))
    of_data: bool = False

    def forget(self) -> None:
        """Forget both, at a branch, loop or call."""
        self.frames, self.of_data = {}, False

    def note(self, line: Line) -> None:
        """Note $TOOL=…, $BASE=…, $IPO_MODE=…, BAS(#TOOL,n), BAS(#BASE,n), FDAT_ACT=… and what else sets frames."""
        texts = [token.text for token in line.tokens]
        try:
            if texts[0] in ("$tool", "$base"):
                self.frames.pop(texts[0][1:], None)
                self.of_data = False
                if line.assigned == 1:
                    self.frames[texts[0][1:]] = self.reader.frame(line.tokens[2:])
            elif texts[:2] == ["bas", "("] and texts[2] in ("#tool", "#base") and len(texts) > 4:
                self.of_data = False
                self.numbered(texts[2][1:], texts[4])
            elif texts[:2] == ["fdat_act", "="]:
                self.forget()
                self.described(line)
            elif (sets_frames(line) or not ACTIVE.isdisjoint(texts)) and not (
                texts == ["$ipo_mode", "=", "#base"] or (self.of_data and not PARAMETERS.isdisjoint(texts))
            ):
                self.forget()
        except Uncertain as uncertain:
            self.reason = uncertain

    def described(self, line: Line) -> None:
        """Set both by FDAT_ACT=…. Raises Uncertain."""
        tokens = line.tokens[2:]
        if len(tokens) == 1 and tokens[0].kind == "word":
            values = self.reader.datum(tokens[0].text, line).values
            if len(values) > 1:
                raise Uncertain("several", name=tokens[0].text.upper())
            tokens = values[0][0]
        components = _components(tokens)
        if "".join(token.text for token in components.get("ipo_frame", ())) not in ("#base", ""):
            raise Uncertain("fixed-tool")
        for frame in ("tool", "base"):
            self.numbered(frame, str(int(_number(components.get(f"{frame}_no", ())))))
        self.of_data = True

    def numbered(self, frame: str, number: str) -> None:
        """Set the tool or base of a number."""
        self.frames.pop(frame, None)
        self.frames[frame] = self.reader.frame(tokens_of(KRL, f"{frame}_data[{number}]"))

    def tool_and_base(self) -> tuple[Floats, Floats]:
        """Return both. Raises Uncertain."""
        if self.reader.displaced is not None:
            raise self.reader.displaced.again()
        if len(self.frames) < 2:
            raise self.reason.again()
        return self.frames["tool"], self.frames["base"]


def _add_move(reader: _Reader, line: Line, active: _ActiveFrames) -> None:
    """Add a move."""
    tokens, program = line.tokens, reader.program
    move = Move(line.word, Place(line.file, tokens[0].start), tokens[-1].end, line.word in ("lin", "slin"))
    program.moves.append(move)
    program.steps.append(move)
    try:
        if line.word in RELATIVE:
            raise Uncertain("relative")
        if not ACTIVE.isdisjoint(token.text for token in tokens):  # WITH $TOOL=…
            raise Uncertain("frames")
        arguments = list(separated(tokens[1:], ","))[: 1 + ("circ" in line.word)]
        for argument in arguments:
            end = closing(argument, 0) + 1 if is_word(argument, 0, "{") else 1
            if not argument or (len(argument) > end and argument[end].text in (":", "[", ".")):
                raise Uncertain("run-time")
            move.goals += _goals(reader, line, argument[:end], active)
    except Uncertain as uncertain:
        move.refuse(uncertain)


def _goals(reader: _Reader, line: Line, tokens: Tokens, active: _ActiveFrames) -> list[Goal]:
    """Return the goals of one argument of a move. Raises Uncertain."""
    if tokens[0].text == "{":
        targets = [Target(reader.literal(tokens, line.file))]
    else:
        datum = reader.datum(tokens[0].text, line)
        uses = ((datum, Place(line.file, tokens[0].start)),)
        targets = [Target(reader.literal(value, of.file), uses=uses) for value, of in datum.values]  # type: ignore[attr-defined]
    goals = []
    for target in targets:
        if target.literal.form.is_joints:
            goals.append(Goal(target))
            continue
        tool, base = active.tool_and_base()
        numbers = target.literal.numbers
        goals.append(Goal(target, tool, base, turns=int(numbers[6]) if len(numbers) > 6 else None))
    return goals
