"""The statements, functions and variables of URScript files that run together.

A name has all values that are assigned to it in these files, in any order. Local variables of one name share their
values, which only makes the reader stricter; parameters are separate.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from truearm.correct.programs.program import Change, Datum, Place, Program, Step, Surroundings, Uncertain
from truearm.correct.programs.program import certain as certain_in_program
from truearm.correct.programs.tokens import (
    Source,
    Token,
    Tokens,
    closing,
    depth_change,
    is_bracketed,
    is_word,
    separated,
    words,
)
from truearm.correct.programs.urscript_words import EFFECTS, QUIET

TRACKING = words("track_conveyor_linear track_conveyor_circular frame_tracking_enable path_offset_enable")
POSE_FUNCTIONS = words("pose_trans pose_add pose_sub pose_inv")
LANGUAGE = EFFECTS | QUIET | POSE_FUNCTIONS
LANGUAGE |= words(
    "get_inverse_kin get_tcp_offset struct make_list rpy2rotvec rotvec2rpy if elif while return not and or xor run kill join"
)
LENGTHS = words("length get_list_length size")  # of a list: its numbers do not count
DEFINING = words("def thread sec")
ENDING = words("end else elif")


@dataclass(eq=False)
class Routine:
    """A function or thread (``kind``) with its parameters, and the function in which it is defined."""

    name: str
    kind: str
    outer: Routine | None
    parameters: dict[str, Datum] = field(default_factory=dict)


@dataclass(eq=False)
class Statement:
    """A statement, a condition, or a parameter's default, in a function of a file."""

    tokens: Tokens
    file: int
    routine: Routine | None
    returns: bool = False

    def place(self, token: Token) -> Place:
        """Return the place of one of its tokens."""
        return Place(self.file, token.start)


class Call(NamedTuple):
    """A function call with the arguments in their order and those given by name."""

    function: str
    positional: list[Tokens]
    named: dict[str, Tokens]

    def argument(self, number: int, *names: str) -> Tokens:
        """Return an argument by its name or number, empty if it is not given."""
        by_name = next((self.named[name] for name in names if name in self.named), None)
        if by_name is not None:
            return by_name
        return self.positional[number] if number < len(self.positional) else ()


@dataclass(eq=False)
class Script:
    """Files that run together. ``displaced``: why no pose of the script is certain."""

    program: Program
    surroundings: Surroundings
    names: dict[str, Datum] = field(default_factory=dict)
    routines: dict[str, list[Routine]] = field(default_factory=lambda: defaultdict(list))
    outline: list[Step | Statement | Routine] = field(default_factory=list)
    displaced: Uncertain | None = None

    def statements(self) -> Iterator[Statement]:
        """Yield all statements."""
        return (entry for entry in self.outline if isinstance(entry, Statement))


def read_names(files: Sequence[Source], surroundings: Surroundings) -> Script:
    """Read scripts, and note who uses and changes each variable."""
    script = Script(Program("urscript", list(files)), surroundings)
    for number, source in enumerate(files):
        _ScriptReader(script, number).read(source.script_tokens)
    for statement in script.statements():
        _note_assignment(script, statement)
    for statement in script.statements():
        _note_uses(script, statement)
    for name in script.routines:
        if name in EFFECTS or name == "get_inverse_kin":
            script.displaced = Uncertain("redefined", name=name)
    return script


def _lines(tokens: Sequence[Token]) -> Iterator[list[Token]]:
    """Yield statements. A line goes on while a bracket is open and after ``and`` or ``or``; a header ends at its colon."""
    line: list[Token] = []
    depth = 0
    for token in tokens:
        if token.kind == "newline":
            if line and depth <= 0 and line[-1].text not in ("and", "or"):
                yield line
                line, depth = [], 0
            continue
        if token.kind == "word" and token.text in ENDING and depth <= 0 and line:
            yield line
            line = []
        line.append(token)
        depth += depth_change(token)
        if depth <= 0 and (token.text == ":" or (token.text == "end" and len(line) == 1)):
            yield line
            line, depth = [], 0
    if line:
        yield line


@dataclass(eq=False)
class _Block:
    """A function, choice or loop that is open: the function around it, how many ends it needs, its condition if a loop."""

    outer: Routine | None
    ends: int = 1
    condition: Statement | None = None


class _ScriptReader:
    """Reads the statements of one file."""

    def __init__(self, script: Script, file: int) -> None:
        self.script, self.file = script, file
        self.routine: Routine | None = None
        self.blocks: list[_Block] = []

    def read(self, tokens: Sequence[Token]) -> None:
        """Read the file."""
        for line in _lines(tokens):
            word = line[0].text
            if word == "end":
                self.end()
            elif word in DEFINING and len(line) > 1:
                self.define(line)
            elif word in ("if", "while", "elif", "else"):
                self.branch(word, line[1:])
            elif word in ("break", "continue"):
                self.script.outline.append(Step.LEAVE)
            else:
                self.add(line[word == "return" :], returns=word == "return")

    def add(self, tokens: Tokens, returns: bool = False) -> Statement:
        """Add a statement."""
        statement = Statement(tokens, self.file, self.routine, returns)
        if tokens or returns:
            self.script.outline.append(statement)
        return statement

    def define(self, line: Tokens) -> None:
        """Read the head of a function or thread; defaults of parameters use names too."""
        self.blocks.append(_Block(self.routine))
        self.routine = Routine(line[1].text, line[0].text, self.routine)
        self.script.routines[self.routine.name].append(self.routine)
        self.script.outline += [Step.ROUTINE, self.routine]
        end = closing(line, 2) if len(line) > 2 else 2
        for parameter in separated(line[3:end], ","):
            if parameter:
                name = parameter[0]
                datum = Datum(name.text, "", "parameter", Place(self.file, name.start))
                self.routine.parameters[name.text] = datum
        self.add(line[3:end])

    def branch(self, word: str, condition: Tokens) -> None:
        """Read IF, ELIF, ELSE or WHILE. ELIF is an IF in the ELSE branch: its condition runs only there."""
        if word in ("elif", "else"):
            self.script.outline.append(Step.BRANCH)
        if word == "while":
            self.script.outline.append(Step.LOOP)
        statement = self.add(condition)
        if word in ("if", "elif"):
            self.script.outline.append(Step.IF)
        if word == "elif" and self.blocks:
            self.blocks[-1].ends += 1
        elif word in ("if", "while"):
            self.blocks.append(_Block(self.routine, condition=statement if word == "while" else None))

    def end(self) -> None:
        """Leave a function, choice or loop. A loop is left through its condition."""
        if not self.blocks:
            return
        block = self.blocks.pop()
        self.script.outline += [Step.END] * block.ends
        if block.condition is not None and block.condition.tokens:
            again = block.condition
            self.script.outline.append(Statement(again.tokens, again.file, again.routine))
        self.routine = block.outer


def call_of(tokens: Tokens) -> Call | None:
    """Return the call that tokens are, None if they are something else."""
    if len(tokens) < 3 or tokens[0].kind != "word" or not is_bracketed(tokens, 1, "("):
        return None
    call = Call(tokens[0].text, [], {})
    for argument in separated(tokens[2:-1], ","):
        if len(argument) > 2 and argument[0].kind == "word" and argument[1].text == "=":
            call.named[argument[0].text] = argument[2:]
        elif argument:
            call.positional.append(argument)
    return call


def calls_in(tokens: Tokens) -> Iterator[tuple[int, Token]]:
    """Yield the index and name of each function call, but no calls of methods."""
    for index, token in enumerate(tokens):
        if token.kind == "word" and is_word(tokens, index + 1, "(") and not is_word(tokens, index - 1, "."):
            yield index, token


# names and what may change them


def find(script: Script, name: str, statement: Statement) -> Datum | None:
    """Return the datum of a name as seen from a statement: a parameter of a function around it, or a variable."""
    routine = statement.routine
    while routine is not None:
        if name in routine.parameters:
            return routine.parameters[name]
        routine = routine.outer
    return script.names.get(name)


def certain(script: Script, datum: Datum) -> None:
    """Raise Uncertain if a name may have values that are not assigned to it as a whole."""
    certain_in_program(script.program, datum, script.surroundings)
    if datum.name in script.routines:
        raise Uncertain("redeclared", name=datum.name, where="a function")


def _note_assignment(script: Script, statement: Statement) -> None:
    """Note an assignment: one more value of a variable, or a change of an element of it."""
    tokens = statement.tokens
    begin = bool(tokens) and tokens[0].text in ("global", "local")
    depth = 0
    for index, token in enumerate(tokens):
        depth += depth_change(token)
        if token.text == "=" and token.kind == "sign" and not depth and index > begin:
            break
    else:
        return
    name = tokens[begin]
    datum = find(script, name.text, statement) if name.kind == "word" else None
    if name.kind != "word" or (datum is not None and datum.kind == "parameter"):
        return
    place = statement.place(name)
    if datum is None:
        datum = script.names[name.text] = Datum(name.text, "", "var", place)
    datum.written.add(place)
    if index == begin + 1:
        datum.values.append((tokens[index + 1 :], statement))
    else:
        datum.changes.append(Change(place, "assigned"))


def _note_uses(script: Script, statement: Statement) -> None:
    """Note the uses of names, method calls that may change them, and what a statement does to all moves."""
    tokens, depth = statement.tokens, 0
    script.program.names.update(token.text for token in tokens if token.kind == "word")
    for _, token in calls_in(tokens):
        if token.text in TRACKING:
            where = script.program.where(statement.place(token))
            script.displaced = Uncertain("displaced", name=token.text, where=where)
        if token.text not in LANGUAGE and token.text not in script.routines:
            script.program.absent[token.text] = None
    for index, token in enumerate(tokens):
        depth += depth_change(token)
        is_function = is_word(tokens, index + 1, "(")
        is_argument = depth > 0 and is_word(tokens, index + 1, "=")
        if token.kind != "word" or is_function or is_argument or is_word(tokens, index - 1, "."):
            continue
        datum = find(script, token.text, statement)
        place = statement.place(token)
        is_measured = is_word(tokens, index - 1, "(") and index > 1 and tokens[index - 2].text in LENGTHS
        if datum is None or place in datum.written or is_measured:
            continue
        datum.uses.add(place)
        if is_word(tokens, index + 1, ".") and is_word(tokens, index + 3, "("):
            datum.changes.append(Change(place, "method"))
