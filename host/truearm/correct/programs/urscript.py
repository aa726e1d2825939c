"""The moves of a URScript, each with its targets and its tool.

A name has all values that are assigned to it in the files that run together, in any order. Local variables of one name
share their values, which only makes the reader stricter; parameters are separate.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from truearm.correct.programs.order import MOST_ORIGINS, MOST_SETTINGS, UNKNOWN, closure, preceding
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
)
from truearm.correct.programs.reading import (
    MOST_TARGETS,
    Reading,
    Uncertain,
    arithmetic,
    check_reach,
    common_pose,
    poses_of,
    table_of,
    words_of,
)
from truearm.correct.programs.tokens import (
    DEPTH,
    NUMBER,
    Source,
    Token,
    Tokens,
    closing,
    is_bracketed,
    is_word,
    separated,
)
from truearm.types import Floats
from truearm.units import DEG

WORDS = words_of("urscript")
# names of the arguments of each target
MOVES: Mapping[str, tuple[tuple[str, ...], ...]] = table_of("urscript")["moves"]
MOVE_TEXT = re.compile(rf"({'|'.join(MOVES)}) *\(")  # in a text that is sent elsewhere
EFFECTS = MOVES.keys() | WORDS["aimless"] | WORDS["effects"]
FAMILIES = re.compile(  # what neither moves the robot nor sets its tool, like the quiet words
    r"""(modbus|socket|str|encoder|conveyor|eip|rtde)_\w+
    |(get|set|read|write)_(analog|configurable|digital|euromap|input|output|port|runstate|standard)_\w+
    |(get|set)_tool_(analog|digital|output|voltage|current|communication|temp|accelerometer)\w*
    |get_(actual|target)_(joint|tcp|payload)\w*|\w+_from_primary_client""",
    re.VERBOSE,
)


@dataclass(eq=False)
class Routine:
    """A function or thread (``kind``), the function or file that defines it, and the scope with its parameters."""

    name: str
    kind: str
    outer: Routine | None
    scope: Scope


class Border(NamedTuple):
    """The beginning of a function or file, or one of its ends. What comes before a thread is unknown."""

    routine: Routine
    is_end: bool


@dataclass(eq=False)
class Call:
    """A call of a function in a function."""

    name: str
    tokens: Tokens
    routine: Routine

    @property
    def scope(self) -> Scope:
        """From where it looks up names."""
        return self.routine.scope

    @property
    def place(self) -> Place:
        """Where it begins."""
        return self.scope.place(self.tokens[0])

    @cached_property
    def arguments(self) -> dict[int | str, Tokens]:
        """The arguments by their names, or else their numbers."""
        arguments: dict[int | str, Tokens] = {}
        for number, argument in enumerate(separated(self.tokens[2:-1], ",")):
            is_named = is_word(argument, 1, "=")
            arguments[argument[0].text if is_named else number] = argument[2 * is_named :]
        return arguments

    def argument(self, *keys: int | str) -> Tokens:
        """Return the argument with one of these numbers or names, empty if there is none."""
        return next((self.arguments[key] for key in keys if key in self.arguments), ())


Entry = Border | Call
Origins = frozenset[Entry | None]


@dataclass(eq=False)
class Script(Reading):
    """Files that run together. ``routines``: by name, the files as ""."""

    names: dict[str, Datum] = field(default_factory=dict)
    routines: dict[str, list[Routine]] = field(default_factory=lambda: defaultdict(list))
    statements: list[tuple[Tokens, Scope]] = field(default_factory=list)
    steps: list[Step | Entry] = field(default_factory=list)
    placed_calls: dict[Place, Call] = field(default_factory=dict)
    calls: dict[str, list[Call]] = field(default_factory=lambda: defaultdict(list))

    def check(self, datum: Datum) -> None:
        """Raise Uncertain if a name may have values that are not assigned to it as a whole."""
        super().check(datum)
        if datum.name in self.routines:
            raise Uncertain("redeclared", name=datum.name, where="a function")

    def call(self, tokens: Tokens, scope: Scope) -> Call | None:
        """Return the call of a function of the language that tokens are, None if they are something else."""
        call = self.placed_calls.get(scope.place(tokens[0])) if tokens else None
        return call if call and call.tokens[-1] is tokens[-1] and call.name not in self.routines else None


def read_names(files: Sequence[Source], surroundings: Surroundings) -> Script:
    """Read scripts, and note who uses and changes each variable."""
    script = Script(Program("urscript", list(files), needed_frames={""}), surroundings)
    for number, source in enumerate(files):
        _ScriptReader(script, number).read(source.script_tokens)
    for tokens, scope in script.statements:
        _note_uses(script, tokens, scope)
    for call in script.placed_calls.values():
        script.calls[call.name].append(call)
    language = EFFECTS | WORDS["quiet"] | script.routines.keys()
    absent = [name for name in script.calls if name not in language and not FAMILIES.fullmatch(name)]
    script.program.absent.update(dict.fromkeys(absent))
    for name, calls in script.calls.items():
        if name in WORDS["tracking"]:
            script.displace("displacing", name, calls[0].place)
    for name in script.routines:
        if name in EFFECTS:
            script.displace("redefined", name, Place(0, 0))
    return script


def _lines(tokens: Sequence[Token]) -> Iterator[list[Token]]:
    """Yield statements.

    A line goes on while a bracket is open and after ``and`` or ``or``; a header ends at its colon.
    """
    line: list[Token] = []
    depth = 0
    for token in tokens:
        is_break = token.kind == "newline" and line and line[-1].text not in ("and", "or")
        if line and depth <= 0 and (is_break or token.text in WORDS["ending"]):
            yield line
            line, depth = [], 0
        if token.kind == "newline":
            continue
        line.append(token)
        depth += DEPTH.get(token.text, 0)
        if depth <= 0 and (token.text == ":" or (token.text == "end" and len(line) == 1)):
            yield line
            line, depth = [], 0
    if line:
        yield line


class _ScriptReader:
    """Reads the statements of one file. ``blocks``: the routine around each open block, and the steps that end it."""

    def __init__(self, script: Script, file: int) -> None:
        self.script = script
        self.routine = Routine("", "def", None, Scope(file, (script.names,)))
        self.blocks: list[tuple[Routine, list[Step | Entry]]] = []
        script.routines[""].append(self.routine)
        script.steps.append(Border(self.routine, is_end=False))

    def read(self, tokens: Sequence[Token]) -> None:
        """Read the file."""
        for line in _lines(tokens):
            word = line[0].text
            if word == "end" and self.blocks:
                self.routine, steps = self.blocks.pop()
                self.script.steps += steps
            elif word in WORDS["defining"] and len(line) > 1:
                self.define(line)
            elif word in ("if", "while", "elif", "else"):
                self.branch(word, line[1:])
            elif word in ("break", "continue"):
                self.script.steps.append(Step.LEAVE)
            elif word == "return":
                self.add(line[1:])
                self.script.steps.append(Border(self.routine, is_end=True))
            else:
                self.add(line)

    def add(self, tokens: Tokens) -> list[Step | Entry]:
        """Add a statement; return its calls. With ``and`` or ``or``, they may not be run."""
        scope = self.routine.scope
        self.script.statements.append((tokens, scope))
        _note_assignment(self.script, tokens, scope)
        steps: list[Step | Entry] = []
        is_optional = not {"and", "or"}.isdisjoint([token.text for token in tokens])
        for index, token in calls_in(tokens):
            end = closing(tokens, index + 1)
            call = Call(token.text, tokens[index : end + 1] if end < len(tokens) else [token], self.routine)
            self.script.placed_calls[call.place] = call
            steps += [Step.IF, call, Step.END] if is_optional else [call]
        self.script.steps += steps
        return steps

    def define(self, line: Tokens) -> None:
        """Read the head of a function or thread; defaults of parameters use names too."""
        scope = self.routine.scope._replace(blocks=({}, *self.routine.scope.blocks))
        routine = Routine(line[1].text, line[0].text, self.routine, scope)
        self.blocks.append((self.routine, [Border(routine, is_end=True), Step.END]))
        self.routine = routine
        self.script.routines[routine.name].append(routine)
        self.script.steps += [Step.ROUTINE, *([Border(routine, is_end=False)] if routine.kind == "def" else [])]
        parameters = line[3 : closing(line, 2)]
        for name, *_ in filter(None, separated(parameters, ",")):
            scope.blocks[0][name.text] = Datum(name.text, "", "parameter", scope.place(name))
        self.add(parameters)

    def branch(self, word: str, condition: Tokens) -> None:
        """Read IF, ELIF, ELSE or WHILE. ELIF is an IF in the ELSE branch: its condition runs only there.

        A loop is left through its condition; that of ``while True`` never ends it.
        """
        steps = self.script.steps
        loop = Step.REPEAT if [token.text for token in condition] == ["True", ":"] else Step.LOOP
        steps += {"if": [], "while": [loop]}.get(word, [Step.ELSE])
        calls = self.add(condition)
        steps += [Step.IF] * (word in ("if", "elif"))
        if word == "elif" and self.blocks:
            self.blocks[-1][1].append(Step.END)
        elif word in ("if", "while"):
            self.blocks.append((self.routine, [Step.END, *(calls if word == "while" else [])]))


def calls_in(tokens: Tokens) -> Iterator[tuple[int, Token]]:
    """Yield the index and name of each function call, but no calls of methods."""
    for index, (token, following) in enumerate(pairwise(tokens)):
        if following.text == "(" and token.kind == "word" and not is_word(tokens, index - 1, "."):
            yield index, token


# names and what may change them


def _note_assignment(script: Script, tokens: Tokens, scope: Scope) -> None:
    """Note an assignment: one more value of a variable, or a change of a part of it."""
    tokens = tokens[bool(tokens) and tokens[0].text in ("global", "local") :]
    if len(tokens) < 2 or tokens[0].kind != "word" or tokens[1].text not in ("=", "[", "."):
        return
    _, *values = separated(tokens, "=")
    name, place = tokens[0].text, scope.place(tokens[0])
    datum = scope.find(name) or Datum(name, "", "var", place)
    if not values or datum.kind == "parameter":
        return
    script.names[name] = datum
    if tokens[1].text == "=":
        datum.values.append((tokens[2:], scope))
    else:
        datum.changes.append(Change(place, "assigned"))


def _note_uses(script: Script, tokens: Tokens, scope: Scope) -> None:
    """Note the uses of names, method calls that may change them, and moves in texts."""
    for index, token in enumerate(tokens):
        if token.kind == "text" and MOVE_TEXT.search(token.text):
            script.program.texts.append(scope.place(token))
        if token.kind != "word" or is_word(tokens, index - 1, "."):
            continue
        datum = scope.find(token.text)
        following = tokens[index + 1].text if index + 1 < len(tokens) else ""
        is_length = index > 1 and tokens[index - 1].text == "(" and tokens[index - 2].text in WORDS["lengths"]
        if datum is not None and following not in ("(", "=") and not is_length:
            datum.uses.add(scope.place(token))
            if following == "." and is_word(tokens, index + 3, "("):
                datum.changes.append(Change(scope.place(token), "method"))


class Value(NamedTuple):
    """What an argument may be.

    Poses that ``get_inverse_kin`` turns into joint readings have the ``tool`` in force there, its ``near``, and the
    bytes (``span``) of its argument, unless a name has the joint readings.
    """

    target: Target
    tool: Floats | None = None
    near: tuple[float, ...] = ()
    span: tuple[int, int] | None = None

    @property
    def is_joints(self) -> bool:
        """Whether it is joint readings."""
        return self.target.literal.form.is_joints

    def pose(self) -> Floats:
        """Return the pose (4, 4) that it is.

        Raises Uncertain for a list without p, which no controller takes for one.
        """
        if self.is_joints:
            raise Uncertain("type", type="pose")
        return np.asarray(self.target.left @ poses_of([self.target.literal])[0] @ self.target.right)


@dataclass(eq=False)
class _Reader:
    """Evaluates the expressions of a script. Values of names are kept: each name is evaluated once."""

    script: Script
    setters: Mapping[Entry, Origins]  # the calls of set_tcp that may be the last before a call

    def number(self, tokens: Tokens, scope: Scope) -> float:
        """Return the value of a constant expression. Raises Uncertain."""
        value = arithmetic(tokens, lambda operand: self.number(operand, scope))
        if value is not None:
            return value
        call = self.script.call(tokens, scope)
        if call is not None and call.name == "d2r":
            return float(DEG.to_si(self.number(call.argument(0, "d"), scope)))
        datum = scope.find(tokens[0].text) if len(tokens) == 1 else None
        if datum is None:
            raise Uncertain("run-time")
        first, *further_values = set(self.script.through(datum, lambda tokens, scope: [self.number(tokens, scope)]))
        if further_values:
            raise Uncertain("several", name=datum.name)
        return first

    def six(self, tokens: Tokens, scope: Scope, form: Form) -> list[Value]:
        """Return six numbers in square brackets; computed ones have no bytes in the text."""
        place = scope.place(tokens[0])
        return [Value(Target(self.script.once(place, lambda: self.literal(place, tokens, scope, form))))]

    def literal(self, place: Place, tokens: Tokens, scope: Scope, form: Form) -> Literal:
        """Return ``six`` as a literal. Raises Uncertain."""
        row = tokens[-1]
        matches = list(NUMBER.finditer(row.text)) if row.kind == "row" else []
        spans = tuple((row.start + match.start(), row.start + match.end()) for match in matches)
        items = separated(tokens[1 + (form is Form.VECTOR) : -1], ",")
        numbers = tuple(float(match[0]) for match in matches) or tuple(self.number(item, scope) for item in items)
        if len(numbers) != 6:
            raise Uncertain("type", type="list of six numbers")
        literal = Literal(place, tokens[-1].end, form, numbers, spans)
        check_reach(literal)
        return literal

    def values(self, tokens: Tokens, scope: Scope, index: str = "") -> list[Value]:
        """Return what an argument may be, or an element of it. Raises Uncertain.

        ``index``: the text of an index such as [1], or "". An index that is no number stands for all elements.
        """
        if len(tokens) == 1 and tokens[0].kind == "word":
            return self.named(tokens, scope, index)
        if not is_word(tokens, 0, "p") and is_bracketed(tokens, 1, "["):
            return self.values(tokens[:1], scope, index + "".join(token.text for token in tokens[1:]))
        if index:
            if not is_bracketed(tokens, 0, "["):
                raise Uncertain("not-written")
            items = list(separated(tokens[1:-1], ","))
            if index[1:-1].isdecimal():
                items = items[int(index[1:-1]) :][:1]
            return [value for item in items for value in self.values(item, scope)]
        if is_list(tokens):
            return self.six(tokens, scope, Form.RADIANS)
        if is_word(tokens, 0, "p") and is_list(tokens[1:]):
            return self.six(tokens, scope, Form.VECTOR)
        call = self.script.call(tokens, scope)
        if call is None:
            raise Uncertain("run-time")
        return self.solved(call) if call.name == "get_inverse_kin" else self.product(call)

    def named(self, tokens: Tokens, scope: Scope, index: str) -> list[Value]:
        """Return what a name may stand for; its literals are reached by this use of it, too."""
        datum = scope.find(tokens[0].text)
        if datum is None:
            raise Uncertain("undeclared", name=tokens[0].text)
        values = self.script.through(datum, lambda tokens, scope: self.values(tokens, scope, index), index)
        return [value._replace(target=value.target.by(datum, scope.place(tokens[0])), span=None) for value in values]

    def product(self, call: Call) -> list[Value]:
        """Return the values of pose_trans and pose_add."""
        if call.name not in ("pose_trans", "pose_add"):
            raise Uncertain("run-time")
        first = self.values(call.argument(0, "p_from", "p_1"), call.scope)
        if call.name == "pose_add":  # positions are added, orientations are multiplied
            step, turn = IDENTITY.copy(), IDENTITY.copy()
            offset = self.pose(call.argument(1, "p_2"), call.scope)
            step[:3, 3], turn[:3, :3] = offset[:3, 3], offset[:3, :3]
            if any(value.is_joints for value in first):
                raise Uncertain("type", type="pose")
            return [Value(value.target.moved(step, turn)) for value in first]
        second = self.values(call.argument(1, "p_from_to"), call.scope)
        if len(first) * len(second) > MOST_TARGETS:
            raise Uncertain("many", most=MOST_TARGETS)
        return [_joined(a, b) for a in first for b in second]

    def solved(self, call: Call) -> list[Value]:
        """Return the values of get_inverse_kin(x, qnear=…, tcp=…)."""
        seed, tool = call.argument(1, "qnear"), call.argument(4, "tcp")
        readings: tuple[float, ...] = ()
        source = self.script.call(seed, call.scope)
        if seed and (source is None or source.name not in WORDS["current_joints"]):
            values = self.values(seed, call.scope)
            if len(values) != 1 or not values[0].is_joints:
                raise Uncertain("several", name="its qnear")
            self.script.program.harmless.update(place for _, place in values[0].target.uses)
            readings = values[0].target.literal.numbers
        pose = self.pose(tool, call.scope) if tool else self.tool(call)
        argument = call.argument(0, "x")
        values = self.values(argument, call.scope)
        return [Value(v.target, pose, readings, (argument[0].start, argument[-1].end)) for v in values]

    def pose(self, tokens: Tokens, scope: Scope) -> Floats:
        """Return the only pose (4, 4) of an expression. Raises Uncertain."""
        values = self.values(tokens, scope)
        return common_pose([value.pose() for value in values], Uncertain("several", name="it"))

    def tool(self, call: Call) -> Floats:
        """Return the tool (4, 4) in force at a call. Raises Uncertain."""
        setters = self.setters.get(call) or UNKNOWN
        return self.script.once(
            setters,
            lambda: common_pose([self.set_tool(setter) for setter in _in_order(setters)], Uncertain("several-tools")),
        )

    def set_tool(self, setter: Entry | None) -> Floats:
        """Return the tool that a set_tcp sets, or that of the beginning."""
        if setter is None:
            raise Uncertain("several-tools")
        if isinstance(setter, Call):
            try:
                return self.script.once(setter, lambda: self.pose(setter.argument(0, "pose"), setter.scope))
            except Uncertain as uncertain:
                raise uncertain.again(subject="tool") from None
        return self.script.given("", Uncertain("tool"))

    def goals(self, call: Call) -> list[Goal]:
        """Return the goals of a move. Raises Uncertain."""
        if call.name in WORDS["aimless"]:
            raise Uncertain("aimless")
        self.script.check_displacement()
        goals: list[Goal] = []
        for number, names in enumerate(MOVES[call.name]):
            argument = call.argument(number, *names)
            if not argument:
                raise Uncertain("arguments")
            values = self.values(argument, call.scope)
            for value in values:
                span = (argument[0].start, argument[-1].end) if value.tool is None else value.span
                tool = IDENTITY if value.is_joints else self.tool(call) if value.tool is None else value.tool
                if not value.target.literal.spans and not value.is_joints:
                    raise Uncertain("not-written")
                span = span if len(values) == 1 else None
                goals.append(Goal(value.target, tool, argument=span, near=value.near))
        return goals


def _in_order(entries: Origins) -> list[Entry | None]:
    """Return entries by their places, so that the first reason is always the same one."""
    return sorted(entries, key=lambda entry: entry.place if isinstance(entry, Call) else Place(-1, 0))


def _joined(first: Value, second: Value) -> Value:
    """Return the product of two poses. The last literal receives the correction, unless both are one literal."""
    pose, further_pose = first.pose(), second.pose()
    if first.target.literal is second.target.literal:
        first = Value(replace(first.target, literal=replace(first.target.literal, spans=())))
    elif second.target.literal.spans:
        return Value(second.target.moved(left=pose))
    return Value(first.target.moved(right=further_pose))


def is_list(tokens: Tokens) -> bool:
    """Return whether tokens are a list in square brackets."""
    return is_bracketed(tokens, 0, "[") or (len(tokens) == 1 and tokens[0].kind == "row")


def read_urscript(files: Sequence[Source], surroundings: Surroundings) -> Program:
    """Read scripts that run together: all moves of functions that may be called."""
    script = read_names(files, surroundings)
    program = script.program
    reader = _Reader(script, _last_calls(script, frozenset({"set_tcp"}), MOST_SETTINGS))
    reached = _reached(script)
    moves: dict[Call, Move] = {}
    for call in script.placed_calls.values():
        if call.name in MOVES.keys() | WORDS["aimless"] and call.routine in reached:
            moves[call] = move = Move(call.name, call.place, call.tokens[-1].end, call.name in WORDS["straight"])
            script.add_move(move, partial(reader.goals, call))
    last = _last_calls(script, frozenset(MOVES.keys() | WORDS["aimless"] | program.absent.keys()), MOST_ORIGINS)
    for call, move in moves.items():
        program.origins[move] = frozenset(moves.get(origin) for origin in last.get(call) or UNKNOWN)  # type: ignore[arg-type]
    return program


def _last_calls(script: Script, names: frozenset[str], limit: int) -> Mapping[Entry, Origins]:
    """Return the calls of the functions ``names`` that may be the last before each call.

    The beginning of a file or function that nothing calls stands for what was before it; None: unknown.
    """
    callers = {name: {call.routine.name for call in calls} for name, calls in script.calls.items()}
    acting = closure(names, lambda name: callers.get(name, ()))
    if any(routine.kind != "def" for name in acting for routine in script.routines.get(name, ())):
        return {}  # a thread acts at any time

    def linked(entry: Entry) -> Sequence[Entry]:
        if isinstance(entry, Border):
            return () if entry.is_end else script.calls.get(entry.routine.name, ())
        is_followed = entry.name in acting and entry.name not in names
        return [Border(routine, is_end=True) for routine in script.routines[entry.name]] if is_followed else ()

    def counts(entry: Entry) -> bool:
        return entry.name in names if isinstance(entry, Call) else not entry.is_end

    return preceding(script.steps, counts, limit, linked)


def _reached(script: Script) -> set[Routine]:
    """Return the functions that may be called: files, the outermost functions, and what these call."""
    called: dict[Routine, set[Routine]] = defaultdict(set)
    for name, calls in script.calls.items():
        for call in calls:
            called[call.routine].update(script.routines.get(name, ()))
    routines = (routine for same_name in script.routines.values() for routine in same_name)
    return closure((r for r in routines if r.outer is None or r.outer.outer is None), called.__getitem__)
