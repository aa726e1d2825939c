"""URScript for tests: the subset that measuring and corrected programs use, executed; anything else is a fault.

It follows Universal Robots' script manual: a program sent to the controller's port begins with ``def`` in the first
column and ends with ``end`` there, all other lines are indented, and it runs when ``end`` has arrived. It is
independent of ``truearm.plan.route_program`` and of ``truearm.correct.programs``: each line becomes one of Python, in
which S has the variables of a call, G those of the program, F the functions, and P makes a pose.
"""

import copy
import re
from types import SimpleNamespace

import numpy as np
from scipy.spatial.transform import Rotation
from tests.host.controllers import ProgramFault, pose_from

TOKEN = re.compile(
    r"""("[^"\n]*"|'[^'\n]*')|((?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)|([A-Za-z_]\w*)|(==|!=|<=|>=|[-+*/%()\[\],:=<>.])|[ \t]+|(.)"""
)
KEYWORDS = {"def", "end", "while", "if", "else", "elif", "global", "local", "and", "or", "not", "True", "False", "return", "thread", "sec", "run", "join", "kill", "halt", "xor", "break", "continue"}  # fmt: skip
SAME = {"while", "if", "else", "elif", "and", "or", "not", "True", "False", "return", "break", "continue"}  # in Python
UNOBSERVED = {"join", "kill", "enter_critical", "exit_critical"}  # statements on threads, which do not run
MOST_STATEMENTS, MOST_MOVES = 100_000, 1_000  # beyond, a loop does not end


class Pose(list):
    """p[x, y, z, rx, ry, rz] in m and rad."""

    def __class_getitem__(cls, six):
        if len(six) != 6:
            raise ProgramFault("a pose has six numbers")
        return cls(six)

    def matrix(self):
        return pose_from(self[:3], Rotation.from_rotvec(self[3:]))

    @classmethod
    def of(cls, matrix):
        return cls((*matrix[:3, 3].tolist(), *Rotation.from_matrix(matrix[:3, :3]).as_rotvec().tolist()))


class Scope:
    """The variables of a call. A name without ``global`` or ``local`` is the program's if the program has it."""

    def __init__(self, program=None):
        vars(self)["_program"] = program

    def __getattr__(self, name):
        if self._program is None or name not in vars(self._program):
            raise ProgramFault(f"{name!r} is not known here")
        return vars(self._program)[name]

    def __setattr__(self, name, value):
        is_global = self._program is not None and name not in vars(self) and name in vars(self._program)
        vars(self._program if is_global else self)[name] = value


class Halted(Exception):
    """The end of the program."""


def logical_lines(text):
    """Return (number, text) of each non-empty line; text in an open bracket continues on the next."""
    out, open_brackets = [], 0
    for number, line in enumerate(text.splitlines(), start=1):
        line = re.sub(r"""("[^"\n]*"|'[^'\n]*')|#.*""", lambda m: m[1] or "", line).rstrip()
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
    if lines[-1][1] != "end" or any(not line.startswith((" ", "\t")) for _, line in lines[1:-1]):
        raise ProgramFault("all lines but the first def and the last end have to be indented")
    machine = Machine(controller)
    machine.check_name(lines[0][1][4:-3])
    machine.execute(lines[1:-1])
    return machine


def expression(tokens):
    """Return tokens (kinds of TOKEN's groups, text) in Python."""
    out, depth = [], 0
    for k, (kind, word) in enumerate(tokens):
        after = tokens[k + 1][1] if k + 1 < len(tokens) else ""
        depth += (word in "([") - (word in ")]")
        if word == "run":  # the thread's handle
            return [*out, "0"]
        if kind != 3 or word in SAME or (k and tokens[k - 1][1] == ".") or (depth and after == "="):
            out.append(word)
        elif word in KEYWORDS:
            out.append("!=" if word == "xor" else "!")
        else:
            out.append("P" if (word, after) == ("p", "[") else f"F.{word}" if after == "(" else f"S.{word}")
    return out


class Runner:
    """Runs statements that became Python. ``lines``: of the statements that moved, one line per move."""

    def __init__(self, controller, program):
        self.controller, self.routines, self.lines = controller, {}, []
        self.line, self.statements, self.program = 0, 0, program

    def run(self, code, names):
        """Run lines of Python with the names that they use."""
        names |= {
            "S": self.program,
            "F": Functions(self),
            "at": self.at,
            "routine": self.routine,
            "copy": copy.deepcopy,
        }
        try:
            exec(compile("\n".join(code), "program", "exec"), names)
        except Halted:
            pass
        except (SyntaxError, TypeError, AttributeError, LookupError, ValueError, RecursionError, ZeroDivisionError) as exc:  # fmt: skip
            raise ProgramFault(f"line {self.line}: {exc}") from exc
        self.at(0)

    def at(self, line):
        """Note the line of the next statement."""
        self.lines += [self.line] * (len(self.controller.moves) - len(self.lines))
        self.line, self.statements = line, self.statements + 1
        if self.statements > MOST_STATEMENTS or len(self.controller.moves) > MOST_MOVES:
            raise ProgramFault("a loop without end")

    def routine(self, name, parameters):
        """Return a decorator for the body of a routine, a function of its scope. Parameters: (name, by reference)."""

        def define(body):
            def call(*values):
                if len(values) != len(parameters):
                    raise ProgramFault(f"{name} takes {len(parameters)} arguments")
                line, scope = self.line, type(self.program)(self.program)
                for (parameter, is_shared), value in zip(parameters, values, strict=True):
                    vars(scope)[parameter] = value if is_shared else copy.deepcopy(value)
                value = body(scope)
                self.at(line)
                return value

            self.routines[name] = call

        return define


class Machine(Runner):
    """The routines and the built-in functions."""

    def __init__(self, controller):
        super().__init__(controller, Scope())

    def execute(self, lines):
        """Translate lines (number, text) of a program and run them."""
        code, indent = [], 0
        for number, line in lines:
            tokens = [(m.lastindex, m[0]) for m in TOKEN.finditer(line) if m.lastindex]
            word = tokens[0][1]
            if word == "end":
                indent -= 1
                continue
            body = " " * (indent - (word in ("else", "elif")))
            if word not in ("else", "elif"):
                code.append(f"{body}at({number})")
            code += [body + part for part in self.translated(word, tokens)]
            if tokens[-1][1] == ":":
                indent += word not in ("else", "elif")
                code.append(" " * indent + "pass")
            if indent < 0:
                raise ProgramFault(f"line {number}: an end too many")
        if indent:
            raise ProgramFault("an end is missing")
        self.run(code, {"G": self.program, "P": Pose, "Halted": Halted})

    def translated(self, word, tokens):
        """Return a statement in Python."""
        if word in ("def", "thread"):
            self.check_name(tokens[1][1])
            return [
                f"@routine({tokens[1][1]!r}, {[(word, False) for kind, word in tokens[3:-2] if kind == 3]})",
                "def _(S):",
            ]
        if word == "halt" or word in UNOBSERVED:
            return ["raise Halted" if word == "halt" else "pass"]
        scope = word if word in ("global", "local") else ""
        tokens = tokens[bool(scope) :]
        depths = np.cumsum([(word in "([") - (word in ")]") for _, word in tokens])
        sign = next((k for k, (_, word) in enumerate(tokens) if word == "=" and not depths[k]), None)
        if sign is None:
            return [" ".join(expression(tokens))]
        self.check_name(tokens[0][1])
        left = " ".join(expression(tokens[:sign]))
        if scope:
            left = f"G.{tokens[0][1]}" if scope == "global" else f"vars(S)[{tokens[0][1]!r}]"
        return [f"{left} = copy({' '.join(expression(tokens[sign + 1 :]))})"]

    def check_name(self, name):
        if name in KEYWORDS or name in BUILTINS:
            raise ProgramFault(f"{name} redefines what the language has")

    def builtin(self, name):
        if name not in BUILTINS:
            raise ProgramFault(f"no function {name}")
        return getattr(self, name)

    # the manual's functions, with its argument names and defaults

    def joints(self, target):
        """Return joints for a target that is joints or a pose."""
        if isinstance(target, Pose):
            return self.controller.solved(target.matrix(), self.controller.q)
        if len(target) != 6:
            raise ProgramFault("a target has six joints")
        return np.array(target, dtype=float)

    def movej(self, q, a=1.4, v=1.05, t=0, r=0):
        there, here = self.joints(q), self.controller.q
        if t == 0 and here is not None:  # trapezoid, for the joint that turns most
            far = np.abs(there - here).max()
            t = far / v + v / a if far > v * v / a else 2.0 * np.sqrt(far / a)
        self.controller.move_joints(there, float(t))

    def movel(self, pose, a=1.2, v=0.25, t=0, r=0):
        there = pose.matrix() if isinstance(pose, Pose) else self.controller.pose_of(self.joints(pose))
        self.controller.move_line(there, v)

    movep = servoc = movel

    def optimovej(self, goal, a=1.0, v=1.0, r=0):
        self.movej(goal)

    def optimovel(self, goal, a=1.0, v=1.0, r=0):
        self.movel(goal)

    def movec(self, pose_via, pose_to, a=1.2, v=0.25, r=0, mode=0):
        """Drive through both points of the circle, not along the circle itself."""
        self.movel(pose_via, v=v)
        self.movel(pose_to, v=v)

    def servoj(self, q, a=0, v=0, t=0.002, lookahead_time=0.1, gain=300):
        self.controller.move_joints(self.joints(q), t)

    def get_inverse_kin(self, x, qnear=None, maxPositionError=1e-10, maxOrientationError=1e-10, tcp=None):
        near = self.controller.q if qnear is None else np.array(qnear)
        before = self.controller.tcp
        self.controller.tcp = before if tcp is None else tcp.matrix()
        q = self.controller.solved(x.matrix(), near)
        self.controller.tcp = before
        return q.tolist()

    def pose_trans(self, p_from, p_from_to):
        return Pose.of(p_from.matrix() @ p_from_to.matrix())

    def pose_inv(self, p_from):
        return Pose.of(np.linalg.inv(p_from.matrix()))

    def pose_add(self, p_1, p_2):
        turn = Rotation.from_rotvec(p_1[3:]) * Rotation.from_rotvec(p_2[3:])
        return Pose.of(pose_from(np.add(p_1[:3], p_2[:3]), turn))

    def get_actual_tcp_pose(self):
        return Pose.of(self.controller.pose_of(self.controller.q))

    def random(self):
        return 0.25

    def set_tcp(self, pose, tcp_name=""):
        self.controller.tcp = pose.matrix()

    def struct(self, **fields):
        return SimpleNamespace(**copy.deepcopy(fields))

    def get_list_length(self, of):
        return len(of)

    def d2r(self, d):
        return float(np.deg2rad(d))

    def sleep(self, t):
        self.controller.t += t

    sync = textmsg = set_payload = socket_send_string = lambda self, *values: None

    def popup(self, s, title="Popup", warning=False, error=False, blocking=False):
        if blocking is not True:
            raise ProgramFault("the operator is not waited for")
        self.controller.said.append((len(self.controller.moves), s))

    def set_standard_digital_out(self, n, b):
        if type(b) is not bool or not 0 <= n <= 7:
            raise ProgramFault("an output 0 to 7 is True or False")
        self.controller.put_out(b)

    def get_standard_digital_in(self, n):
        if not 0 <= n <= 7:
            raise ProgramFault("there are inputs 0 to 7")
        return self.controller.answered()


OWN = {"execute", "translated", "check_name", "builtin", "joints"}
BUILTINS = {name for name in vars(Machine) if not name.startswith("_")} - OWN


class Functions:
    """Looks up routines and built-in functions by name."""

    def __init__(self, machine):
        self.machine = machine

    def __getattr__(self, name):
        return self.machine.routines.get(name) or self.machine.builtin(name)
