"""RAPID for tests: the subset that measuring and corrected programs use, executed; anything else is a fault.

It follows ABB's technical reference manual (RAPID instructions, functions and data types, RAPID kernel): identifiers
have at most 32 characters, strings 80; words are case-insensitive; names in a module are unique; arrays count from 1.
It is independent of ``truearm.plan.route_program`` and of ``truearm.correct.programs``: as in ``urscript_machine``, each
statement becomes one of Python, in which S has the variables of a call, F the routines, and E makes an index of an element.
"""

import copy
import re
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation
from tests.host.controllers import ProgramFault, pose_from
from tests.host.urscript_machine import Runner, Scope

TOKEN = re.compile(
    r"""(?P<comment>![^\n]*|%%%[^%]*%%%|<[A-Z]{3}>)|(?P<string>"(?:[^"\n]|"")*")|(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)|(?P<name>[A-Za-z]\w*)
        |(?P<sign>:=|<>|<=|>=|[-+*/()\[\]{},;:\\.=<>?])|(?P<space>\s+)|(?P<other>.)""",
    re.VERBOSE,
)
RESERVED = {"module", "endmodule", "proc", "endproc", "var", "pers", "const", "if", "then", "endif", "while", "do", "endwhile", "for",
            "return", "true", "false", "local", "task", "func", "trap", "record", "alias", "connect", "error", "undo", "main", "test", "endtest",
            "case", "default", "else", "elseif", "endfor", "from", "to", "step", "endfunc", "endrecord", "not", "and", "or", "xor", "div", "mod", "goto", "raise", "retry", "trynext", "backward"}  # fmt: skip
SPEEDS = {f"v{n}": [float(n), 500.0, 5000.0, 1000.0] for n in (5, 10, 20, 50, 100, 150, 200, 300, 400, 500, 1000)}
NO_FRAME = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]]
TOOL0 = [True, NO_FRAME, [0.001]]
WOBJ0 = [False, True, "", NO_FRAME, NO_FRAME]
DATA = {**SPEEDS, "fine": "fine", "z10": "z10", "load0": [0.001], "wobj0": WOBJ0, "tool0": TOOL0}
SIGNALS = ("dotruearm", "ditruearm")
COMPONENTS = {
    "trans": 0, "rot": 1, "robconf": 2, "extax": 3, "robax": 0, "x": 0, "y": 1, "z": 2, "q1": 0, "q2": 1, "q3": 2, "q4": 3,
    "robhold": 0, "tframe": 1, "tload": 2, "ufprog": 1, "ufmec": 2, "uframe": 3, "oframe": 4,
}  # fmt: skip
WORDS = {"and": "and", "or": "or", "not": "not", "xor": "!=", "div": "//", "mod": "%", "true": "True", "false": "False"}
SIGNS = {"=": "==", "<>": "!=", ":=": "="}
DEPTH = {"(": 1, "[": 1, "{": 1, ")": -1, "]": -1, "}": -1}


def tokens_of(text):
    """Return tokens (kind, word, line) without comments, names in lower case."""
    tokens, line = [], 1
    for match in TOKEN.finditer(text):
        kind, word = match.lastgroup, match[0]
        if kind == "other" or len(word) > {"name": 32, "string": 82}.get(kind, 1000):
            raise ProgramFault(f"{word!r} is not RAPID, or too long")
        if kind not in ("space", "comment"):
            tokens.append((kind, word.lower() if kind == "name" else word, line))
        line += word.count("\n")
    return tokens


def run_rapid(text, controller, choices=()):
    """Load a module and execute its main. ``choices``: the values of its inputs (DInput), one after the other."""
    machine = Machine(tokens_of(text), controller, choices)
    machine.load()
    return machine


def pieces(tokens, signs):
    """Yield (sign before, tokens) of what stands between signs outside of brackets."""
    depth, sign, piece = 0, "", []
    for token in tokens:
        depth += DEPTH.get(token[1], 0)
        if not depth and token[1] in signs:
            yield sign, piece
            sign, piece = token[1], []
        else:
            piece.append(token)
    yield sign, piece


def closing(tokens, start):
    """Return the index of the bracket that closes the one at ``start``."""
    depth = 0
    for index in range(start, len(tokens)):
        depth += DEPTH.get(tokens[index][1], 0)
        if not depth:
            return index
    raise ProgramFault("a bracket is not closed")


def element(number):
    """Return the index of an element by its number."""
    if number < 1:
        raise ProgramFault("no such element")
    return int(number) - 1


class Variables(Scope):
    """The variables of a call, all declared. A record or array keeps its place, so that INOUT arguments are shared."""

    def __setattr__(self, name, value):
        old = getattr(self, name)
        if type(old) is type(value) is list:
            old[:] = value
        else:
            super().__setattr__(name, value)


class Machine(Runner):
    """A module's data and routines, and the built-in instructions and functions."""

    def __init__(self, tokens, controller, choices=()):
        super().__init__(controller, Variables())
        self.tokens, self.index, self.code, self.indent, self.blocks = tokens, 0, [], 0, []
        self.names, self.components = set(), dict(COMPONENTS)
        vars(self.program).update(copy.deepcopy({**DATA, **dict(zip(SIGNALS, SIGNALS, strict=True))}))
        self.is_watched, self.choices = True, list(choices)

    # translation

    def load(self):
        """Translate the module and run its main."""
        while self.index < len(self.tokens):
            self.statement()
        if self.blocks or self.tokens[-1][1] != "endmodule" or "main" not in self.names:
            raise ProgramFault("a module has a main and ends with ENDMODULE")
        names = {"E": element, "numbers": lambda a, b: np.arange(a, b + 1.0).tolist()}
        self.run([*self.code, "F.main()"], names)

    def take(self, *words):
        """Return the next word, which is one of these, if any are given."""
        kind, word, _ = self.tokens[self.index] if self.index < len(self.tokens) else ("end", "", 0)
        if words and (word not in words or kind == "string"):
            raise ProgramFault(f"{word!r} stands where {' or '.join(words)} was expected")
        self.index += 1
        return word

    def before(self, *words):
        """Return the tokens before the next of these words, which is consumed."""
        start = self.index
        while self.index < len(self.tokens) and self.tokens[self.index][1] not in words:
            self.index += 1
        self.take(*words)
        return self.tokens[start : self.index - 1]

    def emit(self, *lines):
        self.code += [" " * self.indent + line for line in lines]

    def begin(self, line, end=""):
        """Begin a block with a line of Python, up to a word that ends it, or another branch of the last one."""
        self.indent -= not end
        self.emit(line)
        self.blocks += [end] * bool(end)
        self.indent += 1
        self.emit("pass")

    def new_name(self, is_local=False):
        name = self.take()
        if not name.isidentifier() or name in RESERVED - {"main"} or (not is_local and name in self.names | set(DATA)):
            raise ProgramFault(f"{name!r} is not a new name")
        self.names |= set() if is_local else {name}
        return name

    def statement(self):
        """Translate the next statement, or the beginning or end of a block."""
        self.emit(f"at({self.tokens[self.index][2]})")
        word = self.take()
        if word == "module":
            self.new_name()
            self.blocks.append("endmodule")
        elif word.startswith("end") and self.blocks[-1:] == [word]:
            self.indent -= self.blocks.pop() != "endmodule"
        elif word in ("local", "task"):
            self.statement()
        elif word in ("var", "pers", "const"):
            self.declaration()
        elif word == "record":
            self.new_name()
            fields = [piece for _, piece in pieces(self.before("endrecord"), ";") if piece]
            self.components |= {piece[1][1]: index for index, piece in enumerate(fields)}
        elif word in ("proc", "func"):
            self.header(word)
        elif self.blocks[1:] == []:
            raise ProgramFault(f"{word!r} stands outside of a routine")
        elif hasattr(self, f"do_{word}"):
            getattr(self, f"do_{word}")()
        elif word in ("connect", "raise", "retry", "trynext"):  # of traps and errors, which do not occur here
            self.before(";")
        elif word in ("error", "undo", "backward"):
            self.emit("return")
        else:
            self.index -= 1
            self.instruction(self.before(";"))

    def instruction(self, tokens):
        """Translate an assignment or a call of a procedure."""
        name = tokens[0][1]
        sign = next((k for k, token in enumerate(tokens) if token[1] == ":="), 0)
        if sign and tokens[1][1] in (":=", "{", "."):
            self.emit(f"{self.expression(tokens[:sign])} = copy({self.expression(tokens[sign + 1 :])})")
        elif name in ("incr", "add"):
            by = [self.expression(piece) for _, piece in pieces(tokens[1:], ",")]
            self.emit(f"{by[0]} += {[*by, '1.0'][1]}")
        else:
            self.emit(f"F.{name}({self.arguments(tokens[1:])})")

    def declaration(self):
        kind = self.take()
        name = self.new_name(len(self.blocks) > 1)
        tokens = self.before(";")
        first = {"num": 0.0, "bool": False, "string": ""}.get(kind, [])
        (_, size), *value = pieces(tokens, {":="})
        text = f"[{first!r}] * int({self.expression(size[1:-1])})" if size else repr(first)
        self.emit(f"vars(S)[{name!r}] = copy({self.expression(value[0][1]) if value else text})")

    def header(self, kind):
        self.index += kind == "func"
        name = self.new_name()
        self.take("(")
        parameters = [[word for _, word, _ in piece] for _, piece in pieces(self.before(")"), ",") if piece]
        shared = [(words[-1], words[0] in ("inout", "var", "pers")) for words in parameters]
        self.emit(f"@routine({name!r}, {shared!r})")
        self.begin("def _(S):", f"end{kind}")

    def do_if(self):
        end = next(k for k in range(self.index, len(self.tokens)) if self.tokens[k][1] in ("then", ";"))
        if self.tokens[end][1] == "then":
            self.begin(f"if {self.expression(self.before('then'))}:", "endif")
            return
        start = self.index
        while not self.begins_statement():
            self.index += 1
        self.begin(f"if {self.expression(self.tokens[start : self.index])}:", ";")
        self.statement()
        self.blocks.pop()
        self.indent -= 1

    def begins_statement(self):
        """Return whether a name follows an operand."""
        (before, last, _), (kind, word, _) = self.tokens[self.index - 1 : self.index + 1]
        is_operand = (before != "sign" and last not in ("if", *WORDS)) or last in (")", "]", "}", "true", "false")
        return is_operand and kind == "name" and word not in WORDS

    def do_elseif(self):
        self.begin(f"elif {self.expression(self.before('then'))}:")

    def do_else(self):
        self.begin("else:")

    def do_test(self):
        end = next(
            k for k in range(self.index, len(self.tokens)) if self.tokens[k][1] in ("case", "default", "endtest")
        )
        self.emit(f"value_{self.indent} = {self.expression(self.tokens[self.index : end])}")
        self.index = end
        self.begin("if False:", "endtest")

    def do_case(self):
        self.begin(f"elif value_{self.indent - 1} in [{self.expression(self.before(':'))}]:")

    def do_default(self):
        self.take(":")
        self.begin("else:")

    def do_for(self):
        name = self.new_name(True)
        self.take("from")
        first, last = self.expression(self.before("to")), self.expression(self.before("do"))
        self.begin(f"for vars(S)[{name!r}] in [*numbers({first}, {last}), None]:", "endfor")
        self.emit(f"if vars(S)[{name!r}] is None: vars(S).pop({name!r}); break")  # the data outside are seen again

    def do_while(self):
        self.begin(f"while {self.expression(self.before('do'))}:", "endwhile")

    def do_return(self):
        self.emit(f"return copy({self.expression(self.before(';')) or None})")

    def arguments(self, tokens):
        """Return arguments in Python: those in order, then those by name."""
        positional, named = [], []
        for sign, piece in pieces(tokens, {",", "\\"}):
            if sign == "\\":
                named.append(f"{piece[0][1]} {self.expression(piece[1:]) or '= True'}")
            elif piece:
                positional.append(self.expression(piece))
        return ", ".join(positional + named)

    def expression(self, tokens):
        """Return an expression or a place in Python."""
        words, index = [], 0
        while index < len(tokens):
            kind, word, _ = tokens[index]
            after = tokens[index + 1][1] if index + 1 < len(tokens) else ""
            if kind == "name" and after == "(" and word not in WORDS:
                end = closing(tokens, index + 1)
                words.append(f"F.{word}({self.arguments(tokens[index + 2 : end])})")
                index = end
            elif kind == "sign" and word == "{":
                end = closing(tokens, index)
                words += [f"[E({self.expression(piece)})]" for _, piece in pieces(tokens[index + 1 : end], {","})]
                index = end
            elif kind == "sign" and word == ".":
                words.append(f"[{self.components[after]}]")
                index += 1
            elif kind == "name":
                words.append(WORDS.get(word) or f"S.{word}")
            else:
                plain = {"number": lambda word: repr(float(word)), "string": lambda word: repr(word[1:-1])}
                words.append(plain.get(kind, lambda word: SIGNS.get(word, word))(word))
            index += 1
        return " ".join(words)

    def builtin(self, name):
        for table in (INSTRUCTIONS, FUNCTIONS):
            if name in table:
                return partial(table[name], self)
        raise ProgramFault(f"no routine {name!r}")

    # meaning of the values

    @staticmethod
    def pose(numbers):
        (x, y, z), (w, i, j, k) = numbers[:2]
        if abs(np.linalg.norm([w, i, j, k]) - 1.0) > 1e-3:
            raise ProgramFault("the orientation is not normalised")
        return pose_from(1e-3 * np.array([x, y, z]), Rotation.from_quat([i, j, k, w]))

    def use(self, tool, work=None):
        """Use a tool, and return the object frame of a work object in the base."""
        if tool[0] is not True or not tool[2][0] > 0.0:
            raise ProgramFault("a tool that the robot does not hold, or that weighs nothing")
        self.controller.tcp = self.pose(tool[1])
        if work is None:
            return np.eye(4)
        if work[:3] != [False, True, ""]:
            raise ProgramFault("a work object that is held or moved")
        return self.pose(work[3]) @ self.pose(work[4])

    @staticmethod
    def jointtarget(target):
        if len(target[0]) != 6 or target[1:] != [[9e9] * 6]:
            raise ProgramFault("a jointtarget has six axes and six external ones")
        return np.deg2rad(target[0])

    def robtarget(self, target):
        if len(target) != 4 or [len(part) for part in target] != [3, 4, 4, 6]:
            raise ProgramFault("a robtarget has place, orientation, configuration and external axes")
        self.controller.configuration = tuple(target[2])
        return self.pose(target)

    # instructions and functions

    def MoveAbsJ(self, target, speed, zone, tool, t=0.0, noeoffs=False):
        self.use(tool)
        self.controller.configuration = ()
        self.controller.move_joints(self.jointtarget(target), t)

    def MoveJ(self, target, speed, zone, tool, wobj=None, **options):
        pose = self.use(tool, wobj) @ self.robtarget(target)
        self.controller.move_joints(self.controller.solved(pose, self.controller.q))

    def MoveL(self, target, speed, zone, tool, wobj=None, **options):
        frame = self.use(tool, wobj)
        if self.is_watched and isinstance(target, Computed):
            raise ProgramFault("a computed target while configurations are watched")
        self.controller.move_line(frame @ self.robtarget(target), 1e-3 * speed[0])

    def MoveC(self, circle, target, speed, zone, tool, wobj=None):
        """Drive through both points of the circle, not along the circle itself."""
        self.MoveL(circle, speed, zone, tool, wobj)
        self.MoveL(target, speed, zone, tool, wobj)

    def SearchL(self, signal, found, target, speed, tool, stop=False):
        """Search without finding anything: the search ends at its target, which is where it stopped."""
        self.MoveL(target, speed, "fine", tool)
        found[:] = copy.deepcopy(target)

    def ConfL(self, off=False, on=False):
        self.is_watched = not off

    def SetDO(self, signal, level):
        if signal != "dotruearm" or level not in (0.0, 1.0):
            raise ProgramFault("an output is 0 or 1")
        self.controller.put_out(level == 1.0)

    def WaitTime(self, seconds, inpos=False):
        self.controller.t += seconds

    def WaitDI(self, signal, level, maxtime=None, timeflag=""):
        if signal != "ditruearm" or maxtime is None or timeflag is not False:  # a bool
            raise ProgramFault("an input that may never come is waited for with MaxTime and TimeFlag")
        self.controller.wait_for(level == 1.0, maxtime)

    def TPWrite(self, text):
        self.text = text

    def Stop(self):
        self.controller.said.append((len(self.controller.moves), self.text))

    def CalcRobT(self, target, tool, wobj=None):
        frame = self.use(tool, wobj)
        pose = np.linalg.inv(frame) @ self.controller.pose_of(self.jointtarget(target))
        return Computed([*self.numbers(pose), [0.0] * 4, [9e9] * 6])

    @staticmethod
    def numbers(pose):
        i, j, k, w = Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
        return [(1e3 * pose[:3, 3]).tolist(), [w, i, j, k]]

    def Offs(self, target, x, y, z):
        """Move along the axes of the work object; a taught target keeps its configuration."""
        return type(target)([[a + b for a, b in zip(target[0], (x, y, z), strict=True)], *target[1:]])

    def RelTool(self, target, x, y, z, rx=0.0, ry=0.0, rz=0.0):
        """Move along the axes of the tool; rotations about x, then the new y, then the new z."""
        turn = Rotation.from_euler("XYZ", [rx, ry, rz], degrees=True)
        pose = self.pose(target) @ pose_from(1e-3 * np.array([x, y, z]), turn)
        return type(target)([*self.numbers(pose), *target[2:]])

    def DInput(self, signal):
        return float(self.choices.pop(0)) if self.choices else 0.0

    def Dim(self, array, dimension):
        return float(len(array))


class Computed(list):
    """A robtarget that was not taught."""


def linear(places):
    """Return an instruction like MoveL whose target, speed, zone and tool are at these places."""
    return lambda machine, *values, wobj=None, **_: machine.MoveL(*(values[place] for place in places), wobj)


INSTRUCTIONS = {
    name.lower(): getattr(Machine, name)
    for name in ("MoveAbsJ", "MoveJ", "MoveL", "MoveC", "ConfL", "SetDO", "WaitTime", "WaitDI", "TPWrite", "Stop", "SearchL")
}  # fmt: skip
INSTRUCTIONS |= {"confj": lambda machine, **_: None}
INSTRUCTIONS |= {"triggl": linear((0, 1, 3, 4)), "arcl": linear((0, 1, 4, 5)), "spotl": linear((0, 1, 1, 4))}
FUNCTIONS = {name.lower(): getattr(Machine, name) for name in ("CalcRobT", "Offs", "RelTool", "DInput", "Dim")}
