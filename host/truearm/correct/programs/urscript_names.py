"""The statements, functions and variables of URScript files that run together.

A name has all values that are assigned to it in these files, in any order. Local variables of one name share their
values, which only makes the reader stricter; parameters are separate.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

from truearm.correct.programs.data import Change, Datum, Place, Scope
from truearm.correct.programs.language_words import table_of, words_of
from truearm.correct.programs.program import Program, Step, Surroundings
from truearm.correct.programs.reading import Reading, Uncertain
from truearm.correct.programs.tokens import DEPTH, Source, Token, Tokens, closing, is_word, separated

WORDS = words_of("urscript")
MOVES: Mapping[str, tuple[tuple[str, ...], ...]] = table_of("urscript")[
    "moves"
]  # names of the arguments of each target
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
    """A function or thread (``kind``), the function or file in which it is defined, and the scope with its parameters."""

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
    """Yield statements. A line goes on while a bracket is open and after ``and`` or ``or``; a header ends at its colon."""
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
