"""The moves of KUKA programs (.src with its .dat), each with its target, tool and base.

Names of a .dat file are seen by the .src of the same name, global ones and those of $config.dat by all. An element of
an array by a plain number, such as TOOL_DATA[1], is a name of its own. The tool and base of a move are those of its
WITH, or those that were set before it with no branch, loop or call of another routine between.
"""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import groupby

from truearm.correct.programs.order import closure
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
    Scope,
    Step,
    Surroundings,
    Target,
    Uses,
)
from truearm.correct.programs.reading import Reading, Uncertain, check_reach, matrix_of_angles, steps_of, words_of
from truearm.correct.programs.tokens import KRL, Source, Tokens, closing, is_bracketed, is_word, separated, tokens_of
from truearm.types import Floats

WORDS, STEPS = words_of("krl"), steps_of("krl")
RELATIVE = frozenset(f"{name}_rel" for name in WORDS["moves"])
NO_ASSIGNMENT = WORDS["no_assignment"] | WORDS["moves"] | RELATIVE
POSE, AXES = ("x", "y", "z", "a", "b", "c"), ("a1", "a2", "a3", "a4", "a5", "a6")
FDAT = {"tool": "tool_no", "base": "base_no", "ipo_mode": "ipo_frame"}
# an offset that BAS adds
CORRECTION = re.compile(r"\b(tool_corr_on|tool_corr_w_on|base_corr_on|m_bas_cor_on) = (?!false)")
PLAIN = re.compile(r"(?:[-+] )?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")  # a number with its sign


@dataclass(frozen=True, eq=False)
class Line:
    """The tokens of a line with their texts, in a routine ("" if in none) of a module, whose names are block 0."""

    tokens: Tokens
    texts: Sequence[str]
    scope: Scope
    module: str
    routine: str

    @property
    def word(self) -> str:
        """Its first word, after GLOBAL."""
        return self.texts[self.texts[0] == "global" and len(self.texts) > 1]

    @property
    def assigned(self) -> int:
        """The index of the sign of an assignment, 0 if it is none."""
        is_other = self.texts[0] in NO_ASSIGNMENT and self.texts[1:2] != ["="]
        return 0 if is_other or "=" not in self.texts else self.texts.index("=")

    @property
    def sets_frames(self) -> bool:
        """Whether it may set the tool or base."""
        is_command = self.texts[:2] == ["bas", "("] and WORDS["frameless"].isdisjoint(self.texts)
        return is_command or self.texts[0] in WORDS["active"] or self.texts[0] == "fdat_act"


Modules = dict[str, dict[str, Datum]]


def _lines(files: Sequence[Source], modules: Modules) -> Iterator[Line]:
    """Yield the lines that are not empty of all files but bas.src.

    That file is KUKA's own: what its routines do is known by their names.
    """
    for number, source in enumerate(files):
        module = source.name.lower().replace("\\", "/").rpartition("/")[2].rpartition(".")[0]
        scope = Scope(number, (modules[module], modules[""]))
        routine, text = "", "" if module == "bas" else source.text
        for is_end, group in groupby(tokens_of(KRL, text), lambda token: token.kind == "newline"):
            if not is_end:
                tokens = list(group)
                texts = [token.text for token in tokens]
                if not {"def", "deffct"}.isdisjoint(texts[:2]) and "(" in texts:
                    routine = texts[texts.index("(") - 1]
                yield Line(tokens, texts, scope, module, routine)
                routine = "" if texts[0] in ("end", "endfct") else routine


def _indexed(tokens: Tokens, index: int) -> tuple[str, int]:
    """Return the plain number in brackets after the name at an index, "" if there is none, and the index after both."""
    if is_word(tokens, index + 1, "[") and is_word(tokens, index + 3, "]") and tokens[index + 2].kind == "number":
        return tokens[index + 2].text, index + 4
    return "", index + 1


@dataclass(eq=False)
class _Reader(Reading):
    """Data of all files, by module, "" for those that all see; an array is one datum.

    ``values``: what is assigned to each datum, by the index of an array's element. ``is_stationary``: some moves are
    those of a work object to a tool that stands still.
    """

    lines: list[Line] = field(default_factory=list)
    modules: Modules = field(default_factory=lambda: defaultdict(dict))
    values: dict[tuple[Datum, str], list[tuple[Tokens, Scope]]] = field(default_factory=lambda: defaultdict(list))
    parameters: dict[int, set[str]] = field(default_factory=lambda: defaultdict(set))
    routines: set[str] = field(default_factory=set)
    is_stationary: bool = False

    def read(self) -> None:
        """Read the lines of all files, then their data, then the uses of these."""
        self.modules[""] = {name: Datum(name, "", "var", Place(0, 0)) for name in WORDS["system"]}
        self.lines = list(_lines(self.program.files, self.modules))
        self.routines = {line.routine for line in self.lines} - {""}
        self.is_stationary = any("#tcp" in line.texts for line in self.lines)
        for line in self.lines:
            self.declare(line)
        for names in list(self.modules.values())[1:]:  # another routine of the module may mean the one that all see
            for name in names.keys() & self.modules[""].keys():
                names[name].changes.append(Change(names[name].place, "redeclared"))
        for line in self.lines:
            self.note(line)
        home = self.modules[""]["$h_pos"]
        if not home.uses:  # only the controller reads it, to say whether the robot is where the program calls home
            self.program.harmless |= {
                scope.place(token) for value, scope in self.values[home, ""] for token in value[:1]
            }
        self.note_displacement()

    def declare(self, line: Line) -> None:
        """Note the data and parameters that a line declares."""
        tokens = line.tokens
        if line.word in ("def", "deffct") and "(" in line.texts:
            self.parameters[line.scope.file] |= set(line.texts[line.texts.index("(") :])
        kind = next((index for index, text in enumerate(line.texts[:4]) if text in WORDS["types"]), len(tokens))
        prefix = set(line.texts[:kind])
        if kind > len(tokens) - 2 or prefix - {"decl", "global", "const"}:
            return
        names = self.modules["" if "global" in prefix or line.module in ("$config", "$machine") else line.module]
        for declared in separated(tokens[kind + 1 :], ","):
            if declared:
                name, place = declared[0].text, line.scope.place(declared[0])
                datum = names.setdefault(
                    name, Datum(name, line.texts[kind], "var", place, names is not self.modules[""])
                )
                datum.written.add(place)
                if datum.place != place and name not in WORDS["system"]:
                    datum.changes.append(Change(place, "redeclared"))
                if is_word(declared, 1, "="):
                    self.values[datum, ""].append((declared[2:], line.scope))

    def note(self, line: Line) -> None:
        """Note the uses of data in a line, and what may change them."""
        tokens, caller = line.tokens, ""
        if line.assigned and line.texts[: line.assigned] == line.texts[line.assigned + 1 :]:
            return  # such as $H_POS=$H_POS of the submit interpreter
        for index, token in enumerate(tokens):
            if token.kind != "word":
                continue
            if is_word(tokens, index + 1, "(") and token.text not in WORDS["quiet"] and line.word not in WORDS["heads"]:
                caller = token.text
                if caller not in self.routines:
                    self.program.absent[caller] = None
            number, end = _indexed(tokens, index)
            place = line.scope.place(token)
            if not is_word(tokens, index - 1, "."):
                data = [line.scope.find(token.text)]
            else:  # a component, or a name of another module, as in /R1/P..XP1
                is_path = is_word(tokens, index - 2, ".")
                data = [names.get(token.text) for names in self.modules.values()] if is_path else []
            for datum in data:
                if datum is None or place in datum.written:
                    continue
                if index == 0 and line.assigned == end:
                    datum.written.add(place)
                    self.values[datum, number].append((tokens[end + 1 :], line.scope))
                    continue
                datum.uses.add(place)
                if index < line.assigned or line.word == "import":
                    datum.changes.append(Change(place, "assigned"))
                elif caller:
                    changes = datum.changes if caller in self.routines else datum.outside
                    changes.append(Change(place, "argument", caller))

    def note_displacement(self) -> None:
        """Note a line that moves all frames, or lets a routine set some at any time, as by an interrupt or trigger."""
        callers: dict[str, set[str]] = defaultdict(set)
        for line in self.lines:
            for routine in self.routines.intersection(line.texts):
                callers[routine].add(line.routine)
        setting = closure({line.routine for line in self.lines if line.sets_frames}, callers.__getitem__)
        for line in self.lines:
            is_root = line.texts[0] in WORDS["roots"] and line.assigned
            is_event = line.word in ("interrupt", "trigger") and not setting.isdisjoint(line.texts)
            if is_root or is_event or CORRECTION.search(" ".join(line.texts)):
                self.displace("displacing", line.texts[0].upper(), line.scope.place(line.tokens[0]))

    def targets(self, tokens: Tokens, scope: Scope) -> list[tuple[Tokens, int, Uses]]:
        """Return each {…} that tokens may stand for, with its file and the names on the way. Raises Uncertain."""
        if is_bracketed(tokens, 0, "{"):
            return [(tokens, scope.file, ())]
        number, end = _indexed(tokens, 0)
        if end != len(tokens) or tokens[0].kind != "word":
            raise Uncertain("run-time")
        name, datum = tokens[0].text, scope.find(tokens[0].text)
        if datum is None or name in self.parameters[scope.file]:
            code = "parameter" if datum is not None else "run-time" if name[0] == "$" else "undeclared"
            raise Uncertain(code, name=name.upper(), kind="parameter")
        self.check(datum)
        if not (values := self.values[datum, number]):
            name = f"{name}[{number}]" if number else name
            raise Uncertain("undeclared" if datum.name in WORDS["system"] else "no-value", name=name.upper())
        targets = self.once((datum, number), lambda: self.all_values(values, self.targets))
        return [(target, file, ((datum, scope.place(tokens[0])), *uses)) for target, file, uses in targets]

    def components(self, tokens: Tokens, scope: Scope) -> dict[str, Tokens]:
        """Return the components of {X 1, Y 2, …}, or of what a name certainly stands for. Raises Uncertain."""
        targets = self.targets(tokens, scope)
        if len(targets) > 1:
            raise Uncertain("several", name=tokens[0].text.upper())
        return _components(targets[0][0])

    def literal(self, tokens: Tokens, file: int) -> Literal:
        """Return the literal {X …, Y …, …} or {A1 …, …}. Raises Uncertain."""
        components = _components(tokens)
        names: tuple[str, ...] = AXES if "a1" in components else POSE
        if any(name not in components for name in names):
            raise Uncertain("partial")
        for name in components:
            if name[0] == "e" and name not in self.surroundings.unchanged and _number(components[name]):
                raise Uncertain("axis", name=name)
        form = Form.DEGREES if names is AXES else Form.ANGLES
        if names is POSE and "t" in components:
            names = (*POSE, "t")
        numbers = tuple(_number(components[name]) for name in names)
        spans = tuple((components[name][0].start, components[name][-1].end) for name in names)
        literal = Literal(Place(file, tokens[0].start), tokens[-1].end, form, numbers, spans)
        check_reach(literal)
        return literal

    def frame(self, tokens: Tokens, subject: str, scope: Scope) -> Floats:
        """Return the pose (4, 4) of TOOL_DATA[n], BASE_DATA[n], $NULLFRAME, {X …} or a name. Raises Uncertain."""
        key = "".join(token.text for token in tokens)
        if key in WORDS["root_frames"]:
            return IDENTITY
        kinematics = self.values.get((self.modules[""]["machine_frame_dat"], key[len("base_data[") : -1]), ())
        if subject == "base" and any(_number(_components(value).get("mach_def_index", ())) for value, _ in kinematics):
            raise Uncertain("moved-object")
        try:
            components = self.components(tokens, scope)
        except Uncertain as uncertain:
            if uncertain.reason.name != "undeclared":
                raise uncertain.again(subject=subject) from None
            name = key.replace("[", "").replace("]", "")
            return self.given(name, Uncertain("undeclared", name=name.upper(), subject=subject))
        x, y, z, a, b, c = (_number(components.get(name, ())) for name in POSE)
        return matrix_of_angles(x, y, z, a, b, c)


def _components(tokens: Tokens) -> dict[str, Tokens]:
    """Return the components of {X 1, Y 2, …}; a type before a colon is left out."""
    content = tokens[3:-1] if is_word(tokens, 2, ":") else tokens[1:-1]
    return {component[0].text: component[1:] for component in separated(content, ",") if component}


def _number(tokens: Tokens) -> float:
    """Return a plain number. Raises Uncertain."""
    text = " ".join(token.text for token in tokens)
    number = float(text.replace(" ", "")) if PLAIN.fullmatch(text) else math.inf
    if not math.isfinite(number):
        raise Uncertain("not-written")
    return number


# moves


def read_krl(files: Sequence[Source], surroundings: Surroundings) -> Program:
    """Read the modules of a KUKA controller."""
    reader = _Reader(Program("krl", list(files)), surroundings)
    reader.read()
    active = _ActiveFrames(reader)
    for line in reader.lines:
        if line.word in WORDS["moves"] | RELATIVE and line.assigned != 1:
            if not WORDS["here"].issuperset(line.texts[1:2]):
                place, end = line.scope.place(line.tokens[0]), line.tokens[-1].end
                move = Move(line.word, place, end, line.word in ("lin", "slin"))
                reader.add_move(move, partial(_goals, reader, line, active))
            continue
        is_call = is_word(line.tokens, 1, "(") or not reader.routines.isdisjoint(line.texts)
        is_label = is_word(line.tokens, 1, ":")
        if line.word in STEPS or is_label or (is_call and line.word not in WORDS["quiet"]):
            active.forget()
            reader.program.steps.append(STEPS.get(line.word, Step.CALL))
        else:
            active.note(line)
    return reader.program


Settings = dict[str, Callable[[], Floats]]


@dataclass(eq=False)
class _ActiveFrames:
    """The tool, base and mode that were set last (``settings``), and those of FDAT_ACT, each evaluated by a move."""

    reader: _Reader
    settings: Settings = field(default_factory=dict)
    described: Settings = field(default_factory=dict)
    outside: Settings = field(default_factory=dict)  # of a spline block

    def forget(self) -> None:
        """Forget all, at a branch, loop or call."""
        self.settings, self.described = {}, {}
        if not self.reader.is_stationary:
            self.settings["ipo_mode"] = lambda: IDENTITY

    def note(self, line: Line) -> None:
        """Note $TOOL=…, BAS(#TOOL,n), FDAT_ACT=…, BAS(#PTP_PARAMS,n), SPLINE and what else sets frames."""
        texts, tokens = line.texts, line.tokens
        command = "".join(texts[2:3]) if texts[:2] == ["bas", "("] else ""
        if texts[0] in WORDS["active"]:
            self.settings[texts[0][1:]] = partial(self.setting, tokens, line.scope)
        elif command in ("#tool", "#base"):
            self.settings[command[1:]] = partial(self.numbered, command[1:], tokens[4:-1], line.scope)
        elif texts[0] == "fdat_act":
            is_whole = line.assigned == 1
            self.described = {name: partial(self.component, name, tokens[2:], line.scope) for name in FDAT if is_whole}
        elif command in WORDS["parameters"]:
            self.settings = dict(self.described)
        elif texts[0] == "spline":
            self.outside, self.settings = self.settings, self.within(line)
        elif texts[0] == "endspline":
            self.settings = self.outside
        elif line.sets_frames or not WORDS["active"].isdisjoint(texts):
            self.forget()

    def setting(self, tokens: Tokens, scope: Scope) -> Floats:
        """Return what $TOOL=…, $BASE=… or $IPO_MODE=… sets. Raises Uncertain."""
        name, value = tokens[0].text[1:], tokens[2:]
        if not value or tokens[1].text != "=":
            raise Uncertain("frames")
        if value[0].text in ("stool", "stool2", "sbase", "sipo_mode"):
            value = value[2 : closing(value, 1)]
            if value and value[0].kind == "word":
                return self.component(name, value[:1], scope, value[-1].text if len(value) > 1 else "")
        elif name != "ipo_mode":
            return self.reader.frame(value, name, scope)
        return self.numbered(name, value, scope)

    def component(self, name: str, tokens: Tokens, scope: Scope, key: str = "") -> Floats:
        """Return the tool, base or mode of an FDAT. Raises Uncertain."""
        return self.numbered(name, self.reader.components(tokens, scope).get(key or FDAT[name], ()), scope)

    def numbered(self, name: str, tokens: Tokens, scope: Scope) -> Floats:
        """Return the tool or base of a number; for the mode, whether the robot holds the tool. Raises Uncertain."""
        text = "".join(token.text for token in tokens)
        if name != "ipo_mode":
            data = f"{name}_data[{text}]"
            frame: Floats = self.reader.once(data, lambda: self.reader.frame(tokens_of(KRL, data), name, scope))
            return frame
        if text not in ("#base", ""):
            raise Uncertain("fixed-tool")
        return IDENTITY

    def within(self, line: Line) -> Settings:
        """Return the settings for a line with those of its WITH."""
        clauses = line.tokens[line.texts.index("with") + 1 :] if "with" in line.texts else ()
        active = [clause for clause in separated(clauses, ",") if clause and clause[0].text in WORDS["active"]]
        return {**self.settings, **{clause[0].text[1:]: partial(self.setting, clause, line.scope) for clause in active}}

    def tool_and_base(self, line: Line) -> tuple[Floats, Floats]:
        """Return both for a move. Raises Uncertain."""
        self.reader.check_displacement()
        frames = {name: setting() for name, setting in self.within(line).items()}
        if len(frames) < len(FDAT):
            raise Uncertain("frames")
        return frames["tool"], frames["base"]


def _goals(reader: _Reader, line: Line, active: _ActiveFrames) -> list[Goal]:
    """Return the goals of a move. Raises Uncertain."""
    if line.word in RELATIVE:
        raise Uncertain("relative")
    end = next((i for i, text in enumerate(line.texts) if text == "with" or text.startswith("c_")), len(line.texts))
    arguments = list(separated(line.tokens[1:end], ","))[: 1 + ("circ" in line.word)]
    goals = []
    for target, file, uses in [target for argument in arguments for target in reader.targets(argument, line.scope)]:
        literal = reader.once(Place(file, target[0].start), partial(reader.literal, target, file))
        tool, base = (IDENTITY, IDENTITY) if literal.form.is_joints else active.tool_and_base(line)
        turns = int(literal.numbers[6]) if len(literal.numbers) > len(POSE) else None
        goals.append(Goal(Target(literal, uses=uses), tool, base, turns=turns))
    return goals
