"""URScript for tests: the part of the language that measuring and corrected programs use, executed; anything else is a fault.

After Universal Robots' script manual: what is sent to the controller's port begins with a ``def`` in the first column, ends with
its ``end`` there, all other lines are indented, and it runs when the ``end`` has arrived. Independent of ``truearm.plan.route_urscript`` and of
``truearm.files.programs``: tokens, grammar and meaning are here once more.
"""

import re
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation
from tests.host.controllers import ProgramFault, pose_from

TOKEN = re.compile(
    r"""(?P<string>"[^"\n]*"|'[^'\n]*')|(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)|(?P<pose>p(?=\[))|(?P<name>[A-Za-z_]\w*)
        |(?P<sign>==|!=|<=|>=|[-+*/()\[\],:=<>])|(?P<space>[ \t]+)""",
    re.VERBOSE,
)
KEYWORDS = {"def", "end", "while", "if", "else", "elif", "global", "local", "and", "or", "not", "True", "False", "return", "thread", "sec"}  # fmt: skip


@dataclass(frozen=True)
class Pose:
    """p[x, y, z, rx, ry, rz] in m and rad."""

    six: tuple

    def matrix(self):
        return pose_from(self.six[:3], Rotation.from_rotvec(self.six[3:]))


def tokens_of(line):
    out, at = [], 0
    while at < len(line):
        match = TOKEN.match(line, at)
        if match is None:
            raise ProgramFault(f"{line[at:]!r} is no URScript")
        if match.lastgroup != "space":
            out.append((match.lastgroup, match[0]))
        at = match.end()
    return out


def without_comment(line):
    return re.sub(r"""("[^"\n]*"|'[^'\n]*')|#.*""", lambda m: m[1] or "", line)


def run_urscript(text, controller):
    """Execute a program as the controller does that it is sent to."""
    lines = [(i, without_comment(line).rstrip()) for i, line in enumerate(text.splitlines(), start=1)]
    lines = [(i, line) for i, line in lines if line]
    if not re.fullmatch(r"def [A-Za-z_]\w*\(\):", lines[0][1]):
        raise ProgramFault("the first line is no def in the first column")
    if lines[0][1][4:-3] in KEYWORDS | set(BUILTINS):
        raise ProgramFault(f"{lines[0][1]} redefines what the language has")
    if lines[-1][1] != "end" or any(not line.startswith(" ") for _, line in lines[1:-1]):
        raise ProgramFault("all lines but the first def and the last end have to be indented")
    machine = Machine(controller)
    machine.block([(i, tokens_of(line)) for i, line in lines[1:-1]])
    return machine


class Machine:
    """Variables, and the built-in functions."""

    def __init__(self, controller):
        self.controller, self.variables = controller, {}

    def block(self, lines):
        i = 0
        while i < len(lines):
            number, tokens = lines[i]
            try:
                if tokens[0] == ("name", "while"):
                    body = self._body(lines, i)
                    while self._whole(tokens[1:-1]) is True:
                        self.block(body)
                    i += len(body) + 1
                else:
                    self._simple(tokens)
            except ProgramFault as exc:
                raise exc if "line" in str(exc) else ProgramFault(f"line {number}: {exc}") from exc
            i += 1

    def _body(self, lines, start):
        if lines[start][1][-1] != ("sign", ":"):
            raise ProgramFault("a while without a colon")
        depth = 0
        for k in range(start, len(lines)):
            depth += lines[k][1][0] == ("name", "while")
            depth -= lines[k][1] == [("name", "end")]
            if depth == 0:
                return lines[start + 1 : k]
        raise ProgramFault("a while without an end")

    def _simple(self, tokens):
        if tokens[0] in (("name", "global"), ("name", "local")):
            tokens = tokens[1:]
        if len(tokens) > 2 and tokens[0][0] == "name" and tokens[1] == ("sign", "="):
            if tokens[0][1] in KEYWORDS | set(BUILTINS):
                raise ProgramFault(f"{tokens[0][1]} is no name for a variable")
            self.variables[tokens[0][1]] = self._whole(tokens[2:])
            return
        self._whole(tokens)

    def _whole(self, tokens):
        value, at = self._either(tokens, 0)
        if at != len(tokens):
            raise ProgramFault(f"{tokens[at][1]!r} is not expected")
        return value

    # each of the following takes tokens and a place, and returns a value and the place after it

    def _either(self, tokens, at):
        value, at = self._comparison(tokens, at)
        while at < len(tokens) and tokens[at][1] in ("and", "or"):
            word = tokens[at][1]
            other, at = self._comparison(tokens, at + 1)
            if type(value) is not bool or type(other) is not bool:
                raise ProgramFault(f"{word} of what is not True or False")
            value = (value and other) if word == "and" else (value or other)
        return value, at

    def _comparison(self, tokens, at):
        value, at = self._sum(tokens, at)
        if at < len(tokens) and tokens[at][1] in ("==", "!=", "<", ">", "<=", ">="):
            sign = tokens[at][1]
            other, at = self._sum(tokens, at + 1)
            if type(value) is not type(other):
                raise ProgramFault("a comparison of different kinds")
            value = {
                "==": value == other,
                "!=": value != other,
                "<": value < other,
                ">": value > other,
                "<=": value <= other,
                ">=": value >= other,
            }[sign]
        return value, at

    def _sum(self, tokens, at):
        value, at = self._atom(tokens, at)
        while at < len(tokens) and tokens[at][1] in ("+", "-"):
            sign = -1.0 if tokens[at][1] == "-" else 1.0
            other, at = self._atom(tokens, at + 1)
            value = value + sign * other
        return value, at

    def _atom(self, tokens, at):
        if at >= len(tokens):
            raise ProgramFault("something is missing at the end")
        kind, word = tokens[at]
        if kind == "number":
            return float(word), at + 1
        if kind == "string":
            return word[1:-1], at + 1
        if word in ("True", "False"):
            return word == "True", at + 1
        if word == "-":
            value, at = self._atom(tokens, at + 1)
            return -value, at
        if kind == "pose":
            six, at = self._list(tokens, at + 1)
            if len(six) != 6:
                raise ProgramFault("a pose has six numbers")
            return Pose(tuple(six)), at
        if word == "[":
            return self._list(tokens, at)
        if kind == "name" and at + 1 < len(tokens) and tokens[at + 1][1] == "(":
            return self._call(tokens, at)
        if kind == "name" and word in self.variables:
            return self.variables[word], at + 1
        raise ProgramFault(f"{word!r} is not known here")

    def _list(self, tokens, at):
        values = []
        while True:
            value, at = self._either(tokens, at + 1)
            values.append(value)
            if at >= len(tokens) or tokens[at][1] not in (",", "]"):
                raise ProgramFault("a list is not closed")
            if tokens[at][1] == "]":
                return values, at + 1

    def _call(self, tokens, at):
        name, values, named = tokens[at][1], [], {}
        if name not in BUILTINS:
            raise ProgramFault(f"no function {name}")
        at += 2
        while tokens[at][1] != ")":
            if tokens[at][0] == "name" and tokens[at + 1][1] == "=":
                named[tokens[at][1]], at = self._either(tokens, at + 2)
            else:
                if named:
                    raise ProgramFault("an argument without a name after one with a name")
                value, at = self._either(tokens, at)
                values.append(value)
            if at >= len(tokens) or tokens[at][1] not in (",", ")"):
                raise ProgramFault(f"the arguments of {name} are not closed")
            at += tokens[at][1] == ","
        try:
            return BUILTINS[name](self, *values, **named), at + 1
        except TypeError as exc:
            raise ProgramFault(f"{name}: {exc}") from exc

    # the manual's functions, with its names of arguments and defaults

    def _joints(self, target):
        """Joints of a target that is joints or a pose."""
        if isinstance(target, Pose):
            return self.controller.solved(target.matrix(), self.controller.q)
        if len(target) != 6:
            raise ProgramFault("a target has six joints")
        return np.array(target)

    def movej(self, q, a=1.4, v=1.05, t=0, r=0):
        there, here = self._joints(q), self.controller.q
        if t == 0 and here is not None:  # trapezoid, of the joint that turns most
            far = np.abs(there - here).max()
            t = far / v + v / a if far > v * v / a else 2.0 * np.sqrt(far / a)
        self.controller.move_joints(there, float(t))

    def movel(self, pose, a=1.2, v=0.25, t=0, r=0):
        there = pose.matrix() if isinstance(pose, Pose) else self.controller.pose_of(self._joints(pose))
        self.controller.move_line(there, v)

    def set_tcp(self, pose):
        self.controller.tcp = pose.matrix()

    def sleep(self, t):
        self.controller.t += t

    def popup(self, s, title="Popup", warning=False, error=False, blocking=False):
        if blocking is not True:
            raise ProgramFault("the operator is not waited for")
        self.controller.said.append((len(self.controller.moves), s))

    def textmsg(self, s1, s2=""):
        pass

    def set_standard_digital_out(self, n, b):
        if type(b) is not bool or not 0 <= n <= 7:
            raise ProgramFault("an output 0 to 7 is True or False")
        self.controller.put_out(b)

    def get_standard_digital_in(self, n):
        if not 0 <= n <= 7:
            raise ProgramFault("there are inputs 0 to 7")
        return self.controller.answered()


BUILTINS = {
    name: getattr(Machine, name)
    for name in ("movej", "movel", "set_tcp", "sleep", "popup", "textmsg", "set_standard_digital_out",
                 "get_standard_digital_in")
}  # fmt: skip
