"""RAPID for tests: the part of the language that measuring and corrected programs use, executed; anything else is a fault.

After ABB's technical reference manual (RAPID instructions, functions and data types): identifiers have at most 32 characters, strings 80;
names in a module are unique. Independent of ``truearm.plan.route_rapid`` and of ``truearm.files.programs``.
"""

import re

import numpy as np
from scipy.spatial.transform import Rotation
from tests.host.controllers import ProgramFault, pose_from

TOKEN = re.compile(
    r"""(?P<comment>![^\n]*)|(?P<string>"[^"\n]*")|(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)|(?P<name>[A-Za-z]\w*)
        |(?P<sign>:=|[-+*/()\[\]{},;\\])|(?P<space>\s+)""",
    re.VERBOSE,
)
RESERVED = {"module", "endmodule", "proc", "endproc", "var", "pers", "const", "if", "then", "endif", "while", "do", "endwhile", "for",
            "return", "true", "false", "local", "task", "func", "trap", "record", "alias", "connect", "error", "undo", "main"}  # fmt: skip
SPEEDS = {
    f"v{n}": [float(n), 500.0, 5000.0, 1000.0]
    for n in (5, 10, 20, 30, 40, 50, 60, 80, 100, 150, 200, 300, 400, 500, 1000)
}
DATA = {
    **SPEEDS,
    "fine": "fine",
    "z10": "z10",
    "wobj0": np.eye(4),
    "tool0": [True, [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]], [0.001]],
}


def tokens_of(text):
    out, at = [], 0
    while at < len(text):
        match = TOKEN.match(text, at)
        if match is None:
            raise ProgramFault(f"{text[at : at + 20]!r} is no RAPID")
        if match.lastgroup == "name" and len(match[0]) > 32:
            raise ProgramFault(f"{match[0]} has more than 32 characters")
        if match.lastgroup == "string" and len(match[0]) > 82:
            raise ProgramFault(f"{match[0]} has more than 80 characters")
        if match.lastgroup not in ("space", "comment"):
            out.append((match.lastgroup, match[0]))
        at = match.end()
    return out


def run_rapid(text, controller):
    """Load a module and execute its main."""
    machine = Machine(tokens_of(text), controller)
    machine.module()
    return machine


class Machine:
    """A module's data, and the built-in instructions and functions."""

    def __init__(self, tokens, controller):
        self.tokens, self.at = [*tokens, ("end", "")], 0
        self.controller, self.data, self.names = controller, dict(DATA), set()
        self.configurations = {"ConfJ": True, "ConfL": True}

    # grammar

    def word(self):
        return self.tokens[self.at][1]

    def take(self, *expected):
        kind, word = self.tokens[self.at]
        if expected and word not in expected:
            raise ProgramFault(f"{word!r} stands where {' or '.join(expected)} was expected")
        self.at += 1
        return kind, word

    def new_name(self):
        kind, name = self.take()
        if (
            kind != "name"
            or name.lower() in RESERVED - {"main"}
            or name.lower() in self.names | {d.lower() for d in DATA}
        ):
            raise ProgramFault(f"{name!r} is no new name")
        self.names.add(name.lower())

        return name

    def module(self):
        self.take("MODULE")
        self.new_name()
        while self.word() in ("VAR", "PERS", "CONST"):
            self.declaration()
        found_main = False
        while self.word() == "PROC":
            self.take()
            found_main |= self.new_name() == "main"
            self.take("(")
            self.take(")")
            while self.word() != "ENDPROC":
                self.statement()
            self.take()
        self.take("ENDMODULE")
        if not found_main or self.tokens[self.at][0] != "end":
            raise ProgramFault("a module has a main and ends with ENDMODULE")

    def declaration(self):
        self.take()
        self.take()  # the type
        name = self.new_name()
        self.data[name] = None
        if self.word() == "{":
            self.at += 3
        if self.word() == ":=":
            self.take()
            self.data[name] = self.value()
        self.take(";")

    def statement(self):
        kind, name = self.take()
        if kind != "name" or name not in INSTRUCTIONS:
            raise ProgramFault(f"no instruction {name!r}")
        values, options = self.arguments(";")
        self.call(INSTRUCTIONS, name, values, options)

    def arguments(self, end):
        values, options = [], {}
        while self.word() != end:
            if self.word() == "\\":
                self.take()
                option, options_value = self.take()[1], True
                if self.word() == ":=":
                    self.take()
                    options_value = self.value()
                options[option.lower()] = options_value
            elif self.word() == ",":
                self.take()
            else:
                values.append(self.value())
        self.take(end)
        return values, options

    def call(self, table, name, values, options):
        try:
            return table[name](self, *values, **options)
        except TypeError as exc:
            raise ProgramFault(f"{name}: {exc}") from exc

    def value(self):
        kind, word = self.take()
        if kind == "number":
            return float(word)
        if kind == "string":
            return word[1:-1]
        if word in ("+", "-"):
            return self.value() * (-1.0 if word == "-" else 1.0)
        if word in ("TRUE", "FALSE"):
            return word == "TRUE"
        if word == "[":
            values = [self.value()]
            while self.take(",", "]")[1] == ",":
                values.append(self.value())
            return values
        if kind == "name" and self.word() == "(":
            self.take()
            return self.call(FUNCTIONS, word, *self.arguments(")"))
        if kind == "name" and self.word() == "{":
            self.take()
            index = int(self.value())
            self.take("}")
            return self.data[word][index - 1]
        if word in self.data:
            return self.data[word]
        if word in ("doTruearm", "diTruearm"):
            return word
        raise ProgramFault(f"{word!r} is not known here")

    # what the values mean

    @staticmethod
    def pose(numbers):
        (x, y, z), (w, i, j, k) = numbers[:2]
        if abs(np.linalg.norm([w, i, j, k]) - 1.0) > 1e-3:
            raise ProgramFault("the orientation is not normalised")
        return pose_from(1e-3 * np.array([x, y, z]), Rotation.from_quat([i, j, k, w]))

    def use(self, tool):
        if tool is not DATA["tool0"] and not tool[2][0] > 0.0:
            raise ProgramFault("a tool weighs more than nothing")
        self.controller.tcp = self.pose(tool[1])

    @staticmethod
    def jointtarget(target):
        if len(target) != 2 or len(target[0]) != 6 or target[1] != [9e9] * 6:
            raise ProgramFault("a jointtarget has six axes and six external ones")
        return np.deg2rad(target[0])

    def robtarget(self, target):
        if len(target) != 4 or [len(part) for part in target] != [3, 4, 4, 6]:
            raise ProgramFault("a robtarget has place, orientation, configuration and external axes")
        return self.pose(target)

    # instructions and functions

    def MoveAbsJ(self, target, speed, zone, tool, t=0.0, noeoffs=False):
        self.use(tool)
        self.controller.move_joints(self.jointtarget(target), t)

    def MoveJ(self, target, speed, zone, tool):
        self.use(tool)
        pose = self.robtarget(target)
        self.controller.move_joints(self.controller.solved(pose, self.controller.q))

    def MoveL(self, target, speed, zone, tool):
        self.use(tool)
        if self.configurations["ConfL"] and isinstance(target, Computed):
            raise ProgramFault("a computed target while configurations are watched")
        pose = self.robtarget(target)
        self.controller.move_line(pose, 1e-3 * speed[0])

    def ConfJ(self, off=False, on=False):
        self.configurations["ConfJ"] = not off

    def ConfL(self, off=False, on=False):
        self.configurations["ConfL"] = not off

    def SetDO(self, signal, level):
        if signal != "doTruearm" or level not in (0.0, 1.0):
            raise ProgramFault("an output is 0 or 1")
        self.controller.put_out(level == 1.0)

    def WaitTime(self, seconds, inpos=False):
        self.controller.t += seconds

    def WaitDI(self, signal, level, maxtime=None, timeflag=""):
        if signal != "diTruearm" or maxtime is None or timeflag is not None:  # a bool without a value
            raise ProgramFault("an input that may never come is waited for with MaxTime and TimeFlag")
        self.controller.wait_for(level == 1.0, maxtime)

    def TPWrite(self, text):
        self.text = text

    def Stop(self):
        self.controller.said.append((len(self.controller.moves), self.text))

    def CalcRobT(self, target, tool):
        self.use(tool)
        pose = self.controller.pose_of(self.jointtarget(target))
        i, j, k, w = Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
        return Computed([(1e3 * pose[:3, 3]).tolist(), [w, i, j, k], [0.0] * 4, [9e9] * 6])

    def Offs(self, target, x, y, z):
        return Computed([[a + b for a, b in zip(target[0], (x, y, z), strict=True)], *target[1:]])


class Computed(list):
    """A robtarget that no one has taught."""


INSTRUCTIONS = {
    name: getattr(Machine, name)
    for name in ("MoveAbsJ", "MoveJ", "MoveL", "ConfJ", "ConfL", "SetDO", "WaitTime", "WaitDI", "TPWrite", "Stop")
}
FUNCTIONS = {name: getattr(Machine, name) for name in ("CalcRobT", "Offs")}
