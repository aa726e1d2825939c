"""RAPID for tests: the subset that measuring and corrected programs use, executed; anything else is a fault.

It follows ABB's technical reference manual (RAPID instructions, functions and data types, RAPID kernel): identifiers
have at most 32 characters, strings 80; words are case-insensitive; names in a module are unique; arrays count from 1.
It is independent of ``truearm.plan.route_rapid`` and of ``truearm.correct.programs``: statements become closures over a
frame of variables, and the values choose the program's branches.
"""

import copy
import operator
import re
from itertools import repeat, takewhile

import numpy as np
from scipy.spatial.transform import Rotation
from tests.host.controllers import ProgramFault, pose_from

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
OPERATORS = {
    "+": operator.add, "-": operator.sub, "*": operator.mul, "/": operator.truediv, "div": operator.floordiv, "mod": operator.mod,
    "=": operator.eq, "<>": operator.ne, "<": operator.lt, ">": operator.gt, "<=": operator.le, ">=": operator.ge,
    "and": lambda a, b: a and b, "or": lambda a, b: a or b, "xor": operator.ne,
}  # fmt: skip
LEVELS = (("or", "xor"), ("and",), ("=", "<>", "<", ">", "<=", ">="), ("+", "-"), ("*", "/", "div", "mod"))
TURNS = 10_000  # of all loops together: a program that runs longer is not a test


def tokens_of(text):
    tokens = [(match.lastgroup, match[0]) for match in TOKEN.finditer(text)]
    for kind, word in tokens:
        if kind == "other" or len(word) > {"name": 32, "string": 82}.get(kind, 1000):
            raise ProgramFault(f"{word!r} is not RAPID, or too long")
    return [token for token in tokens if token[0] not in ("space", "comment")]


def run_rapid(text, controller, choices=()):
    """Load a module and execute its main. ``choices``: the values of its inputs (DInput), one after the other."""
    return Machine(tokens_of(text), controller, choices).module()


class Cell:
    """A variable, or an argument that represents one."""

    def __init__(self, value):
        self.value = value


class Part:
    """An element of an array or a component of a record, as a variable."""

    def __init__(self, of, at):
        self.of, self.at = of, at
        if self.of.value is None or not 0 <= at < len(self.of.value):
            raise ProgramFault("no such element")

    @property
    def value(self):
        return self.of.value[self.at]

    @value.setter
    def value(self, new):
        self.of.value[self.at] = new


class Returned(Exception):
    """The end of a routine."""


class Machine:
    """A module's data and routines, and the built-in instructions and functions."""

    def __init__(self, tokens, controller, choices=()):
        self.tokens, self.at = [*tokens, ("end", "")], 0
        self.controller, self.names, self.routines = controller, set(), {}
        self.data = {name: Cell(copy.deepcopy(value)) for name, value in [*DATA.items(), *zip(SIGNALS, SIGNALS)]}
        self.is_watched = True
        self.choices, self.turns = list(choices), TURNS

    # grammar

    def word(self):
        kind, word = self.tokens[self.at]
        return word.lower() if kind == "name" else word

    def take(self, *expected):
        kind, word = self.tokens[self.at]
        if expected and self.word() not in expected:
            raise ProgramFault(f"{word!r} stands where {' or '.join(expected)} was expected")
        self.at += 1
        return kind, word.lower() if kind == "name" else word

    def taken(self, *expected):
        """Return whether one of these words is next; it is consumed."""
        if self.word() in expected and self.tokens[self.at][0] != "string":
            self.at += 1
            return True
        return False

    def new_name(self, is_local=False):
        kind, name = self.take()
        if kind != "name" or name in RESERVED - {"main"} or (not is_local and name in self.names | set(DATA)):
            raise ProgramFault(f"{name!r} is not a new name")
        self.names |= set() if is_local else {name}
        return name

    def module(self):
        self.take("module")
        self.new_name()
        declarations = []
        while not self.taken("endmodule"):
            self.taken("local") or self.taken("task")
            if self.word() in ("var", "pers", "const"):
                declarations.append(self.declaration())
            else:
                self.routine()
        if self.tokens[self.at][0] != "end" or "main" not in self.routines:
            raise ProgramFault("a module has a main and ends with ENDMODULE")
        for name, value in declarations:
            self.data[name] = Cell(value({}))
        self.enter("main", [])
        return self

    def declaration(self, is_local=False):
        """Return a name and the source of its first value."""
        self.take("var", "pers", "const")
        first = {"num": 0.0, "bool": False, "string": ""}.get(self.take()[1])
        name = self.new_name(is_local)
        size = self.index() if self.taken("{") else None
        value = self.expression() if self.taken(":=") else lambda _: first if size is None else [first] * int(size({}))
        self.take(";")
        return name, lambda frame: copy.deepcopy(value(frame))

    def index(self):
        index = self.expression()
        self.take("}")
        return index

    def routine(self):
        kind = self.take("proc", "func")[1]
        self.at += kind == "func"
        name, parameters, local = self.new_name(), [], []
        self.take("(")
        while not self.taken(")"):
            is_shared = self.taken("inout", "var", "pers")
            self.take()
            parameters.append((self.new_name(True), is_shared))
            self.taken(",")
        while self.word() in ("var", "pers", "const"):
            local.append(self.declaration(True))
        ends = f"end{kind}", "error", "undo", "backward"
        body = self.block(*ends)
        while not self.taken(f"end{kind}"):  # no error is raised here
            self.take("error", "undo", "backward")
            self.block(*ends)
        self.routines[name] = parameters, local, body

    def block(self, *ends):
        """Return the statements up to one of the words that end them, which is not consumed."""
        steps = []
        while self.word() not in ends:
            if self.tokens[self.at][0] == "end":
                raise ProgramFault(f"the file ends where {' or '.join(ends)} should stand")
            steps.append(self.statement())
        return lambda frame: [step(frame) for step in steps]

    def statement(self):
        word = self.word()
        control = {
            "if": self.choice,
            "for": self.counted,
            "while": self.loop,
            "test": self.test,
            "return": self.returned,
        }
        if self.taken(*control):
            return control[word]()
        if word in ("connect", "raise", "retry", "trynext"):  # of traps and errors, which do not occur here
            while not self.taken(";"):
                self.take()
            return lambda frame: None
        if self.tokens[self.at + 1][1] in (":=", "{", "."):
            place = self.place()
            self.take(":=")
            value = self.expression()
            self.take(";")
            return lambda frame: setattr(place(frame), "value", copy.deepcopy(value(frame)))
        name = self.take()[1]
        arguments = self.arguments(";")
        return lambda frame: self.call(INSTRUCTIONS, name, arguments, frame)

    def choice(self):
        cases = [(self.expression(), self.block("elseif", "else", "endif") if self.taken("then") else None)]
        if cases[0][1] is None:
            cases = [(cases[0][0], self.statement())]
        else:
            while self.taken("elseif"):
                condition = self.expression()
                self.take("then")
                cases.append((condition, self.block("elseif", "else", "endif")))
            if self.taken("else"):
                cases.append((lambda _: True, self.block("endif")))
            self.take("endif")
        return lambda frame: next((block for condition, block in cases if condition(frame)), NOTHING)(frame)

    def test(self):
        value, cases, other = self.expression(), [], NOTHING
        while self.taken("case"):
            values = [self.expression()]
            while self.taken(","):
                values.append(self.expression())
            self.take(":")
            cases.append((values, self.block("case", "default", "endtest")))
        if self.taken("default"):
            self.take(":")
            other = self.block("endtest")
        self.take("endtest")
        matching = lambda f: (block for values, block in cases if value(f) in [one(f) for one in values])  # noqa: E731
        return lambda frame: next(matching(frame), other)(frame)

    def counted(self):
        name = self.new_name(True)
        self.take("from")
        first = self.expression()
        self.take("to")
        last = self.expression()
        self.take("do")
        numbers = lambda frame: np.arange(first(frame), last(frame) + 1.0).tolist()  # noqa: E731
        return self.repeated(lambda frame: ({**frame, name: Cell(k)} for k in numbers(frame)), "endfor")

    def loop(self):
        condition = self.expression()
        self.take("do")
        return self.repeated(lambda frame: takewhile(condition, repeat(frame)), "endwhile")

    def repeated(self, frames, end):
        block = self.block(end)
        self.take(end)

        def run(frame):
            for inner in frames(frame):
                self.turns -= 1
                if self.turns < 0:
                    raise ProgramFault("a loop without an end")
                block(inner)

        return run

    def returned(self):
        value = None if self.word() == ";" else self.expression()
        self.take(";")

        def leave(frame):
            raise Returned(copy.deepcopy(value(frame)) if value else None)

        return leave

    def arguments(self, end):
        """Return the sources of the arguments: those in order, and those by name. A variable yields its cell."""
        values, options = [], {}
        while not self.taken(end):
            if self.taken("\\"):
                option = self.take()[1]
                options[option] = self.reference() if self.taken(":=") else lambda _: True
            elif not self.taken(","):
                values.append(self.reference())
        return values, options

    def reference(self):
        """Return an argument: a variable's place if it is one."""
        start = self.at
        if self.tokens[self.at][0] == "name" and self.word() not in ("true", "false", "not"):
            try:
                place = self.place()
            except ProgramFault:
                place = None
            if place is not None and self.word() in (",", ";", ")", "\\"):
                return place
        self.at = start
        return self.expression()

    def call(self, table, name, arguments, frame):
        values = [one(frame) for one in arguments[0]]
        options = {key: one(frame) for key, one in arguments[1].items()}
        if name in self.routines:
            return self.enter(name, values)
        if name not in table:
            raise ProgramFault(f"no routine {name!r}")
        if name not in WRITES:
            values = [value_of(value) for value in values]
            options = {key: value_of(value) for key, value in options.items()}
        try:
            return table[name](self, *values, **options)
        except TypeError as exc:
            raise ProgramFault(f"{name}: {exc}") from exc

    def enter(self, name, values):
        parameters, local, body = self.routines[name]
        if len(values) != len(parameters):
            raise ProgramFault(f"{name} has {len(parameters)} arguments")
        inner = {}
        for (parameter, shared), value in zip(parameters, values, strict=True):
            inner[parameter] = value if shared else Cell(copy.deepcopy(value_of(value)))
            if not isinstance(inner[parameter], Cell | Part):
                raise ProgramFault(f"{parameter} of {name} needs a variable")
        for variable, value in local:
            inner[variable] = Cell(value(inner))
        try:
            body(inner)
        except Returned as exc:
            return exc.args[0]
        return None

    def place(self):
        """Return the source of the cell of a variable, an element or a component."""
        kind, name = self.take()
        if kind != "name" or self.word() == "(":
            raise ProgramFault(f"{name!r} is not a variable")

        def root(frame):
            if name not in frame and name not in self.data:
                raise ProgramFault(f"{name!r} is not known here")
            return frame.get(name) or self.data[name]

        found = root
        while self.word() in ("{", ".") and self.tokens[self.at][0] == "sign":
            if self.taken("."):
                place = COMPONENTS[self.take(*COMPONENTS)[1]]
                found = lambda frame, of=found, place=place: Part(of(frame), place)  # noqa: E731
            else:
                self.take("{")
                found = lambda frame, of=found, index=self.index(): Part(of(frame), int(index(frame)) - 1)  # noqa: B008, E731
        return found

    def expression(self, level=0):
        if level == len(LEVELS):
            return self.unary()
        left = self.expression(level + 1)
        while self.word() in LEVELS[level] and self.tokens[self.at][0] != "string":
            function, right, first = OPERATORS[self.take()[1]], self.expression(level + 1), left
            left = lambda frame, f=function, a=first, b=right: f(a(frame), b(frame))  # noqa: E731
        return left

    def unary(self):
        kind, word = self.tokens[self.at][0], self.word()
        if kind == "sign" and word in "+-":
            self.take()
            inner = self.unary()
            return lambda frame: inner(frame) * (-1.0 if word == "-" else 1.0)
        if kind in ("number", "string") or word in ("true", "false"):
            self.take()
            value = float(word) if kind == "number" else word[1:-1] if kind == "string" else word == "true"
            return lambda _: value
        if kind == "sign" and self.taken("["):
            values = [self.expression()]
            while self.take(",", "]")[1] == ",":
                values.append(self.expression())
            return lambda frame: [value(frame) for value in values]
        if kind == "name" and self.tokens[self.at + 1][1] == "(":
            self.take()
            self.take("(")
            arguments = self.arguments(")")
            return lambda frame: self.call(FUNCTIONS, word, arguments, frame)
        place = self.place()
        return lambda frame: place(frame).value

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
        self.MoveL(target.value, value_of(speed), "fine", value_of(tool))
        found.value = copy.deepcopy(target.value)

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

    def Incr(self, variable):
        variable.value += 1.0

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


def NOTHING(frame):
    pass


class Computed(list):
    """A robtarget that was not taught."""


def value_of(of):
    return of.value if isinstance(of, Cell | Part) else of


def linear(places):
    """Return an instruction like MoveL whose target, speed, zone and tool are at these places."""
    return lambda machine, *values, wobj=None, **_: machine.MoveL(*(values[place] for place in places), wobj)


INSTRUCTIONS = {
    name.lower(): getattr(Machine, name)
    for name in ("MoveAbsJ", "MoveJ", "MoveL", "MoveC", "ConfL", "SetDO", "WaitTime", "WaitDI", "TPWrite", "Stop", "Incr", "SearchL")
}  # fmt: skip
INSTRUCTIONS |= {"confj": lambda machine, **_: None}
INSTRUCTIONS |= {"triggl": linear((0, 1, 3, 4)), "arcl": linear((0, 1, 4, 5)), "spotl": linear((0, 1, 1, 4))}
FUNCTIONS = {name.lower(): getattr(Machine, name) for name in ("CalcRobT", "Offs", "RelTool", "DInput", "Dim")}
WRITES = ("searchl", "incr")  # arguments that they change
