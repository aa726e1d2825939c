"""The moves of a URScript, each with its targets and its tool."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple, TypeVar

import numpy as np

from truearm.correct.programs.data import Form, Literal, Place, Scope
from truearm.correct.programs.order import MOST_ORIGINS, MOST_SETTINGS, UNKNOWN, closure, preceding
from truearm.correct.programs.poses import check_reach, poses_of
from truearm.correct.programs.program import IDENTITY, Goal, Move, Program, Surroundings, Target
from truearm.correct.programs.reading import MOST_TARGETS, Uncertain, arithmetic, only
from truearm.correct.programs.tokens import NUMBER, Source, Tokens, is_bracketed, is_word, separated
from truearm.correct.programs.urscript_names import MOVES, WORDS, Border, Call, Entry, Routine, Script, read_names
from truearm.types import Floats
from truearm.units import DEG

Origins = frozenset[Entry | None]
T = TypeVar("T")


class Value(NamedTuple):
    """What an argument may be.

    Poses that ``get_inverse_kin`` turns into joint readings have the ``tool`` in force there, its ``near``, and the bytes
    (``span``) of its argument, unless a name has the joint readings.
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
        """Return the pose (4, 4) that it is. Raises Uncertain for a list without p, which no controller takes for one."""
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
        return only([value.pose() for value in values], Uncertain("several", name="it"))

    def tool(self, call: Call) -> Floats:
        """Return the tool (4, 4) in force at a call. Raises Uncertain."""
        setters = self.setters.get(call) or UNKNOWN
        return self.script.once(
            setters, lambda: only([self.set_tool(setter) for setter in _in_order(setters)], Uncertain("several-tools"))
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
