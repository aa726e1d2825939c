"""URScript for tests: the subset that measuring and corrected programs use, executed; anything else is a fault.

It follows Universal Robots' script manual: a program sent to the controller's port begins with ``def`` in the first
column and ends with ``end`` there, all other lines are indented, and it runs when ``end`` has arrived. It is
independent of ``truearm.plan.route_urscript`` and of ``truearm.correct.programs``: tokens, grammar and meaning are
implemented again.
"""

import contextlib
import copy
import operator
import re
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation
from tests.host.controllers import ProgramFault, pose_from

TOKEN = re.compile(
    r"""(?P<string>"[^"\n]*"|'[^'\n]*')|(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)|(?P<pose>p(?=\[))|(?P<name>[A-Za-z_]\w*)
        |(?P<sign>==|!=|<=|>=|[-+*/%()\[\],:=<>.])|(?P<space>[ \t]+)""",
    re.VERBOSE,
)
KEYWORDS = {"def", "end", "while", "if", "else", "elif", "global", "local", "and", "or", "not", "True", "False", "return", "thread", "sec", "run", "join", "kill", "halt", "xor"}  # fmt: skip


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
            raise ProgramFault(f"{line[at:]!r} is not URScript")
        if match.lastgroup != "space":
            out.append((match.lastgroup, match[0]))
        at = match.end()
    return out


def without_comment(line):
    return re.sub(r"""("[^"\n]*"|'[^'\n]*')|#.*""", lambda m: m[1] or "", line)


def logical_lines(text):
    """Return (number, text) of each non-empty line; text in an open bracket continues on the next."""
    out, open_brackets = [], 0
    for number, line in enumerate(text.splitlines(), start=1):
        line = without_comment(line).rstrip()
        if open_brackets:
            out[-1] = (out[-1][0], f"{out[-1][1]} {line.strip()}")
        elif line and not line.lstrip().startswith("$"):  # a step of PolyScope's tree
            out.append((number, line))
        plain = re.sub(r"""("[^"\n]*"|'[^'\n]*')""", "", line)
        open_brackets += sum(plain.count(c) for c in "([") - sum(plain.count(c) for c in ")]")
    return out


def run_urscript(text, controller):
    """Execute a program as the receiving controller does. Its threads, which neither move nor assign, do not run."""
    lines = logical_lines(text)
    if not re.fullmatch(r"def [A-Za-z_]\w*\(\):", lines[0][1]):
        raise ProgramFault("the first line is not a def in the first column")
    if lines[0][1][4:-3] in KEYWORDS | set(BUILTINS):
        raise ProgramFault(f"{lines[0][1]} redefines what the language has")
    if lines[-1][1] != "end" or any(not line.startswith((" ", "\t")) for _, line in lines[1:-1]):
        raise ProgramFault("all lines but the first def and the last end have to be indented")
    machine = Machine(controller)
    with contextlib.suppress(Halted):
        machine.block([(i, tokens_of(line)) for i, line in lines[1:-1]])
    return machine


class Returned(Exception):
    """The end of a routine with a value."""


class Halted(Exception):
    """The end of the program."""


class Left(Exception):
    """The end of a loop's pass: break or continue."""


COMPARED = {"==": operator.eq, "!=": operator.ne, "<": operator.lt, ">": operator.gt, "<=": operator.le, ">=": operator.ge}  # fmt: skip
OPENING = {"while", "if", "def", "thread"}


class Machine:
    """Variables, routines, and the built-in functions."""

    def __init__(self, controller):
        self.controller, self.routines = controller, {}
        self.scopes = [{}]  # the program's, then one for each call
        self.lines = []  # of the statements that moved, one line per move

    @property
    def variables(self):
        return self.scopes[-1]

    def block(self, lines):
        i = 0
        while i < len(lines):
            number = lines[i][0]
            try:
                i = self._statement(lines, i)
            except ProgramFault as exc:
                raise exc if "line" in str(exc) else ProgramFault(f"line {number}: {exc}") from exc
            self.lines += [number] * (len(self.controller.moves) - len(self.lines))

    def _statement(self, lines, i):
        """Execute the statement at a line; return the line after it."""
        tokens = lines[i][1]
        word = tokens[0][1] if tokens[0][0] == "name" else ""
        if word in ("while", "def", "thread"):
            end = self._end(lines, i)
            body = lines[i + 1 : end]
            if word == "while":
                self._while(tokens, body)
            else:
                self._define(tokens, body)
            return end + 1
        if word == "if":
            end = self._end(lines, i)
            self._if(lines[i : end + 1])
            return end + 1
        if word == "return":
            raise Returned(self._whole(tokens[1:]) if len(tokens) > 1 else None)
        if word in ("break", "continue"):
            raise Left(word)
        if word == "halt":
            raise Halted
        if word not in ("join", "kill", "enter_critical", "exit_critical"):
            self._simple(tokens)
        return i + 1

    def _end(self, lines, start):
        """Return the line of the end that closes the block opened at a line."""
        if lines[start][1][-1] != ("sign", ":"):
            raise ProgramFault("no colon at the end of the line")
        depth = 0
        for k in range(start, len(lines)):
            depth += lines[k][1][0][1] in OPENING
            depth -= lines[k][1] == [("name", "end")]
            if depth == 0:
                return k
        raise ProgramFault("an end is missing")

    def _while(self, tokens, body):
        turns = 0
        while self._whole(tokens[1:-1]) is True:
            turns += 1
            if turns > 1000:
                raise ProgramFault("a loop without end")
            try:
                self.block(body)
            except Left as left:
                if str(left) == "break":
                    return

    def _define(self, tokens, body):
        name, parameters = tokens[1][1], [word for kind, word in tokens[3:-2] if kind == "name"]
        if name in KEYWORDS | set(BUILTINS):
            raise ProgramFault(f"{name} redefines what the language has")
        self.routines[name] = parameters, body

    def _if(self, lines):
        depth, parts = 0, []
        for k, (_, tokens) in enumerate(lines):
            if depth == 1 and tokens[0][1] in ("elif", "else"):
                parts.append(k)
            depth += tokens[0][1] in OPENING
            depth -= tokens == [("name", "end")]
        parts = [0, *parts, len(lines) - 1]
        for start, end in pairwise(parts):
            tokens = lines[start][1]
            if tokens[0][1] == "else" or self._whole(tokens[1:-1]) is True:
                self.block(lines[start + 1 : end])
                return

    def _simple(self, tokens):
        scope = self.variables
        if tokens[0][1] in ("global", "local"):
            scope = self.scopes[0] if tokens[0][1] == "global" else scope
            tokens = tokens[1:]
        at = next((k for k, token in enumerate(tokens) if token == ("sign", "=")), None)
        if at is not None and tokens[0][0] == "name" and tokens[1][1] in ("=", "[", "."):
            name, path = tokens[0][1], tokens[1:at]
            if name in KEYWORDS | set(BUILTINS):
                raise ProgramFault(f"{name} is not a name for a variable")
            value = self._whole(tokens[at + 1 :])
            if not path:
                if name not in scope and name in self.scopes[0]:
                    scope = self.scopes[0]
                scope[name] = value
            elif path[0][1] == ".":
                self._known(name)[path[1][1]] = value
            else:
                self._put(name, int(self._whole(path[1:-1])), value)
            return
        self._whole(tokens)

    def _put(self, name, k, value):
        held = self._known(name)
        if isinstance(held, Pose):
            scope = self.variables if name in self.variables else self.scopes[0]
            scope[name] = Pose((*held.six[:k], value, *held.six[k + 1 :]))
        else:
            held[k] = value

    def _known(self, name):
        for scope in (self.variables, self.scopes[0]):
            if name in scope:
                return scope[name]
        raise ProgramFault(f"{name!r} is not known here")

    def _whole(self, tokens):
        value, at = self._either(tokens, 0)
        if at != len(tokens):
            raise ProgramFault(f"{tokens[at][1]!r} is not expected")
        return value

    # each of the following takes tokens and a position, and returns a value and the position after it

    def _either(self, tokens, at):
        value, at = self._comparison(tokens, at)
        while at < len(tokens) and tokens[at][1] in ("and", "or", "xor"):
            word = tokens[at][1]
            other, at = self._comparison(tokens, at + 1)
            if type(value) is not bool or type(other) is not bool:
                raise ProgramFault(f"{word} of what is not True or False")
            value = {"and": value and other, "or": value or other, "xor": value != other}[word]
        return value, at

    def _comparison(self, tokens, at):
        value, at = self._sum(tokens, at)
        if at < len(tokens) and tokens[at][1] in ("==", "!=", "<", ">", "<=", ">="):
            sign = tokens[at][1]
            other, at = self._sum(tokens, at + 1)
            if type(value) is not type(other):
                raise ProgramFault("a comparison of different kinds")
            value = COMPARED[sign](value, other)
        return value, at

    def _postfix(self, tokens, at):
        value, at = self._atom(tokens, at)
        while at < len(tokens) and tokens[at][1] in ("[", "."):
            if tokens[at][1] == ".":
                value, at = value[tokens[at + 1][1]], at + 2
                continue
            k, at = self._either(tokens, at + 1)
            if tokens[at][1] != "]":
                raise ProgramFault("an index is not closed")
            items = value.six if isinstance(value, Pose) else value
            if not 0 <= k < len(items):
                raise ProgramFault("an index beyond the list")
            value, at = items[int(k)], at + 1
        return value, at

    def _sum(self, tokens, at):
        value, at = self._product(tokens, at)
        while at < len(tokens) and tokens[at][1] in ("+", "-"):
            sign = -1.0 if tokens[at][1] == "-" else 1.0
            other, at = self._product(tokens, at + 1)
            value = value + sign * other
        return value, at

    def _product(self, tokens, at):
        value, at = self._postfix(tokens, at)
        while at < len(tokens) and tokens[at][1] in ("*", "/", "%"):
            sign = tokens[at][1]
            other, at = self._postfix(tokens, at + 1)
            value = value * other if sign == "*" else value / other if sign == "/" else value % other
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
        if word in ("-", "+"):
            value, at = self._atom(tokens, at + 1)
            return (-value if word == "-" else value), at
        if word == "run":  # the thread's handle
            return 0.0, len(tokens)
        if kind == "pose":
            six, at = self._list(tokens, at + 1)
            if len(six) != 6:
                raise ProgramFault("a pose has six numbers")
            return Pose(tuple(six)), at
        if word == "[":
            return self._list(tokens, at)
        if word == "(":
            value, at = self._either(tokens, at + 1)
            if at >= len(tokens) or tokens[at][1] != ")":
                raise ProgramFault("a bracket is not closed")
            return value, at + 1
        if word == "not":
            value, at = self._comparison(tokens, at + 1)
            return not value, at
        if kind == "name" and at + 1 < len(tokens) and tokens[at + 1][1] == "(":
            return self._call(tokens, at)
        if kind == "name":
            return self._known(word), at + 1
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
        if name not in BUILTINS and name not in self.routines and name != "struct":
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
        if name == "struct":
            return dict(named), at + 1
        if name in self.routines:
            return self._routine(name, values), at + 1
        try:
            return BUILTINS[name](self, *values, **named), at + 1
        except TypeError as exc:
            raise ProgramFault(f"{name}: {exc}") from exc

    def _routine(self, name, values):
        parameters, body = self.routines[name]
        if len(values) != len(parameters):
            raise ProgramFault(f"{name} takes {len(parameters)} arguments")
        self.scopes.append(dict(zip(parameters, values, strict=True)))
        try:
            self.block(body)
        except Returned as returned:
            return returned.args[0]
        finally:
            self.scopes.pop()
        return None

    # the manual's functions, with its argument names and defaults

    def _joints(self, target):
        """Return joints for a target that is joints or a pose."""
        if isinstance(target, Pose):
            return self.controller.solved(target.matrix(), self.controller.q)
        if len(target) != 6:
            raise ProgramFault("a target has six joints")
        return np.array(target)

    def movej(self, q, a=1.4, v=1.05, t=0, r=0):
        there, here = self._joints(q), self.controller.q
        if t == 0 and here is not None:  # trapezoid, for the joint that turns most
            far = np.abs(there - here).max()
            t = far / v + v / a if far > v * v / a else 2.0 * np.sqrt(far / a)
        self.controller.move_joints(there, float(t))

    def movel(self, pose, a=1.2, v=0.25, t=0, r=0):
        there = pose.matrix() if isinstance(pose, Pose) else self.controller.pose_of(self._joints(pose))
        self.controller.move_line(there, v)

    movep = movel

    def optimovej(self, goal, a=1.0, v=1.0, r=0):
        self.movej(goal)

    def optimovel(self, goal, a=1.0, v=1.0, r=0):
        self.movel(goal)

    def movec(self, pose_via, pose_to, a=1.2, v=0.25, r=0, mode=0):
        """Drive through both points of the circle, not along the circle itself."""
        self.movel(pose_via, v=v)
        self.movel(pose_to, v=v)

    def servoc(self, pose, a=1.2, v=0.25, r=0):
        self.movel(pose)

    def servoj(self, q, a=0, v=0, t=0.002, lookahead_time=0.1, gain=300):
        self.controller.move_joints(self._joints(q), t)

    def get_inverse_kin(self, x, qnear=None, maxPositionError=1e-10, maxOrientationError=1e-10, tcp=None):
        near = self.controller.q if qnear is None else np.array(qnear)
        before = self.controller.tcp
        self.controller.tcp = before if tcp is None else tcp.matrix()
        q = self.controller.solved(x.matrix(), near)
        self.controller.tcp = before
        return q.tolist()

    @staticmethod
    def _pose(matrix):
        return Pose((*matrix[:3, 3], *Rotation.from_matrix(matrix[:3, :3]).as_rotvec()))

    def pose_trans(self, p_from, p_from_to):
        return self._pose(p_from.matrix() @ p_from_to.matrix())

    def pose_inv(self, p_from):
        return self._pose(np.linalg.inv(p_from.matrix()))

    def rpy2rotvec(self, rpy):
        """Roll, pitch, yaw: about the fixed x, y, z."""
        roll, pitch, yaw = (Rotation.from_rotvec(angle * axis) for angle, axis in zip(rpy, np.eye(3), strict=True))
        return (yaw * pitch * roll).as_rotvec().tolist()

    def pose_add(self, p_1, p_2):
        turn = Rotation.from_rotvec(p_1.six[3:]) * Rotation.from_rotvec(p_2.six[3:])
        return Pose((*(a + b for a, b in zip(p_1.six[:3], p_2.six[:3], strict=True)), *turn.as_rotvec()))

    def pose_sub(self, p_to, p_from):
        turn = Rotation.from_rotvec(p_to.six[3:]) * Rotation.from_rotvec(p_from.six[3:]).inv()
        return Pose((*(a - b for a, b in zip(p_to.six[:3], p_from.six[:3], strict=True)), *turn.as_rotvec()))

    def get_actual_tcp_pose(self):
        return self._pose(self.controller.pose_of(self.controller.q))

    def get_tcp_offset(self):
        return self._pose(self.controller.tcp)

    def random(self):
        return 0.25

    def set_payload(self, mass, cog=None, inertia=None):
        pass

    def set_tcp(self, pose, tcp_name=""):
        self.controller.tcp = pose.matrix()

    def make_list(self, length, initial_value, capacity=None):
        return [copy.deepcopy(initial_value) for _ in range(int(length))]

    def length(self, of):
        return float(len(of))

    def d2r(self, d):
        return np.deg2rad(d)

    def settled(self, *values, **named):
        """Do what neither moves nor returns anything."""

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
    for name in ("movej", "movel", "movep", "movec", "servoj", "servoc", "optimovej", "optimovel", "get_inverse_kin", "pose_trans", "pose_inv", "pose_add", "rpy2rotvec",
                 "pose_sub", "get_actual_tcp_pose", "get_tcp_offset", "random", "set_payload", "set_tcp", "sleep", "popup", "textmsg", "set_standard_digital_out",
                 "get_standard_digital_in", "length", "make_list", "d2r")
}  # fmt: skip
BUILTINS["get_list_length"] = Machine.length
BUILTINS |= dict.fromkeys(
    ("sync", "stopj", "stopl", "set_gravity", "set_target_payload", "set_tool_voltage", "set_tool_communication", "set_tool_output_mode", "set_tool_digital_output_mode",
     "set_standard_analog_input_domain", "set_tool_analog_input_domain", "set_analog_outputdomain", "set_input_actions_to_default", "set_safety_mode_transition_hardness",
     "end_freedrive_mode", "end_force_mode", "end_screw_driving", "path_offset_disable"),
    Machine.settled,
)  # fmt: skip
