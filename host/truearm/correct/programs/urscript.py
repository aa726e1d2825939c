"""The moves of a URScript, each with its targets and its tool."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, TypeVar

import numpy as np

from truearm.correct.programs.expressions import sum_or_product
from truearm.correct.programs.poses import check_reach
from truearm.correct.programs.program import (
    IDENTITY,
    MOST_TARGETS,
    Datum,
    Form,
    Goal,
    Literal,
    Memo,
    Move,
    Place,
    Program,
    Step,
    Surroundings,
    Target,
    Uncertain,
    Uses,
)
from truearm.correct.programs.tokens import DEEPEST, Source, Token, Tokens, closing, is_bracketed, is_word, separated
from truearm.correct.programs.urscript_names import (
    LANGUAGE,
    POSE_FUNCTIONS,
    Routine,
    Script,
    Statement,
    call_of,
    calls_in,
    certain,
    find,
    read_names,
)
from truearm.correct.programs.urscript_tools import Event, Tools
from truearm.correct.programs.urscript_words import AIMLESS, MOVES, STRAIGHT
from truearm.model.poses import frame_of, inverted
from truearm.types import Floats
from truearm.units import DEG

SIX = 6
CURRENT_JOINTS = frozenset(("get_actual_joint_positions", "get_target_joint_positions"))  # as qnear: no choice
T = TypeVar("T")


class Factor(NamedTuple):
    """A pose of a product: constant (4, 4), or the numbers of a literal in the text, reached by the names ``uses``."""

    constant: Floats = IDENTITY
    literal: Literal | None = None
    uses: Uses = ()
    is_inverse: bool = False

    @property
    def pose(self) -> Floats:
        """Its pose (4, 4)."""
        pose = self.constant if self.literal is None else frame_of(self.literal.numbers)  # type: ignore[arg-type]
        return inverted(pose) if self.is_inverse else pose


Product = tuple[Factor, ...]


class Readings(NamedTuple):
    """Six joint readings [rad]; ``literal``: their numbers in the text; computed ones have no bytes in it."""

    literal: Literal
    uses: Uses = ()


@dataclass(eq=False)
class _Reader:
    """Evaluates the expressions of a script. Values of names are kept: each name is evaluated once."""

    script: Script
    literals: dict[Place, Literal] = field(default_factory=dict)
    memo: Memo = field(default_factory=Memo)
    depth: int = 0

    def through(self, datum: Datum, evaluate: Callable[[Tokens, Statement], T]) -> T:
        """Return what a name with one value stands for."""
        certain(self.script, datum)
        if len(datum.values) != 1:
            raise Uncertain("several" if datum.values else "no-value", name=datum.name)
        return self.memo.get((datum, evaluate.__name__), lambda: self.deeper(datum, evaluate, *datum.values[0]))

    def through_all(self, datum: Datum, evaluate: Callable[[Tokens, Statement], list[T]]) -> list[T]:
        """Return all that a name may stand for."""
        certain(self.script, datum)
        if not datum.values:
            raise Uncertain("no-value", name=datum.name)

        def results() -> list[T]:
            alternatives: list[T] = []
            for tokens, statement in datum.values:
                alternatives += self.deeper(datum, evaluate, tokens, statement)
                check_number(alternatives)
            return alternatives

        return self.memo.get((datum, evaluate.__name__), results)

    def deeper(self, datum: Datum, evaluate: Callable[..., T], tokens: Tokens, statement: object) -> T:
        """Evaluate the value of a name, unless names lead to names without end."""
        if self.depth > DEEPEST:
            raise Uncertain("deep")
        self.depth += 1
        try:
            return evaluate(tokens, statement)
        finally:
            self.depth -= 1

    def number(self, tokens: Tokens, statement: Statement, depth: int = 0) -> float:
        """Return the value of a constant expression. Raises Uncertain."""
        if depth > DEEPEST:
            raise Uncertain("deep")
        if len(tokens) == 1 and tokens[0].kind == "number":
            return float(tokens[0].text)
        if is_bracketed(tokens, 0, "("):
            return self.number(tokens[1:-1], statement, depth + 1)
        total = sum_or_product(tokens, lambda operand: self.number(operand, statement, depth + 1))
        if total is not None:
            return total
        call = call_of(tokens)
        if call and call.function == "d2r" and len(call.positional) == 1 and "d2r" not in self.script.routines:
            return float(DEG.to_si(self.number(call.positional[0], statement, depth + 1)))
        datum = find(self.script, tokens[0].text, statement) if len(tokens) == 1 else None
        if datum is None:
            raise Uncertain("run-time")
        return self.through(datum, self.number)

    def six(self, tokens: Tokens, statement: Statement, form: Form, start: int) -> Literal:
        """Return the six numbers in square brackets; the literal has no spans if they are computed."""
        place = Place(statement.file, start)
        if place not in self.literals:
            items = list(separated(tokens[1:-1], ","))
            if len(items) != SIX:
                raise Uncertain("type", type="list of six numbers")
            numbers = tuple(self.number(item, statement) for item in items)
            written = all(item[-1].kind == "number" and len(item) <= 2 for item in items)
            spans = tuple((item[0].start, item[-1].end) for item in items) if written else ()
            literal = Literal(place, tokens[-1].end, form, numbers, spans)
            check_reach(literal)
            self.literals[place] = literal
        return self.literals[place]

    def poses(self, tokens: Tokens, statement: Statement, depth: int = 0) -> list[Product]:
        """Return the products that an argument may be: one, or one for each element of a list. Raises Uncertain."""
        if depth > DEEPEST:
            raise Uncertain("deep")
        if is_word(tokens, 0, "p") and is_bracketed(tokens, 1, "["):
            literal = self.six(tokens[1:], statement, Form.VECTOR, tokens[0].start)
            if literal.spans:
                return [(Factor(literal=literal),)]
            return [(Factor(frame_of(literal.numbers)),)]  # type: ignore[arg-type]
        call = call_of(tokens)
        if call and call.function not in self.script.routines:
            arguments = [self.poses(argument, statement, depth + 1) for argument in call.positional]
            return _applied(call.function, arguments)
        if tokens and tokens[0].kind == "word" and (len(tokens) == 1 or is_bracketed(tokens, 1, "[")):
            return self.poses_of_name(tokens, statement)
        raise Uncertain("run-time")

    def poses_of_name(self, tokens: Tokens, statement: Statement) -> list[Product]:
        """Return the products that a name, or an element of it, may be."""
        datum = find(self.script, tokens[0].text, statement)
        if datum is None:
            raise Uncertain("undeclared", name=tokens[0].text)
        use = datum, statement.place(tokens[0])
        is_whole = len(tokens) == 1
        products = self.through_all(datum, self.poses) if is_whole else self.elements(datum, tokens[2:-1])
        return [tuple(f._replace(uses=(use, *f.uses)) if f.literal else f for f in product) for product in products]

    def elements(self, datum: Datum, index: Tokens) -> list[Product]:
        """Return the elements of a list of poses: one by a plain number, else all."""
        certain(self.script, datum)
        if len(datum.values) != 1 or not is_bracketed(datum.values[0][0], 0, "["):
            raise Uncertain("not-written")
        tokens, statement = datum.values[0]
        items = list(separated(tokens[1:-1], ","))
        if len(index) == 1 and index[0].kind == "number" and index[0].text.isdigit():
            items = items[int(index[0].text) :][:1]
        if not items:
            raise Uncertain("element", name=datum.name)
        check_number(items)
        return [product for item in items for product in self.deeper(datum, self.poses, item, statement)]

    def joints(self, tokens: Tokens, statement: Statement) -> list[Readings]:
        """Return the joint readings that an argument may be. Raises Uncertain."""
        if is_bracketed(tokens, 0, "["):
            return [Readings(self.six(tokens, statement, Form.RADIANS, tokens[0].start))]
        datum = find(self.script, tokens[0].text, statement) if len(tokens) == 1 else None
        if datum is None:
            raise Uncertain("run-time")
        use = datum, statement.place(tokens[0])
        several = self.through_all(datum, self.joints)
        return [Readings(readings.literal, (use, *readings.uses)) for readings in several]

    def pose(self, tokens: Tokens, statement: Statement) -> Floats:
        """Return the only pose (4, 4) of an expression. Raises Uncertain."""
        matrices = [_product(factors) for factors in self.poses(tokens, statement)]
        if any(not np.array_equal(matrix, matrices[0]) for matrix in matrices):
            raise Uncertain("several", name="it")
        return matrices[0]


def check_number(alternatives: Sequence[object]) -> None:
    """Raise Uncertain for too many alternatives of one argument."""
    if len(alternatives) > MOST_TARGETS:
        raise Uncertain("many", most=MOST_TARGETS)


def _applied(function: str, arguments: Sequence[list[Product]]) -> list[Product]:
    """Return a function of the language applied to poses."""
    if function not in POSE_FUNCTIONS or len(arguments) != 1 + (function != "pose_inv"):
        raise Uncertain("run-time")
    if function == "pose_inv":
        return [
            tuple(factor._replace(is_inverse=not factor.is_inverse) for factor in reversed(product))
            for product in arguments[0]
        ]
    first, second = arguments
    check_number(range(len(first) * len(second)))
    if function == "pose_trans":
        return [a + b for a in first for b in second]
    if len(second) != 1:
        raise Uncertain("several", name="an offset")
    step, turn = IDENTITY.copy(), IDENTITY.copy()  # positions are added, orientations are multiplied
    other = _product(second[0])
    step[:3, 3], turn[:3, :3] = other[:3, 3], other[:3, :3]
    if function == "pose_sub":
        step, turn = inverted(step), inverted(turn)
    return [(Factor(step), *product, Factor(turn)) for product in first]


def _product(factors: Sequence[Factor]) -> Floats:
    product = IDENTITY
    for factor in factors:
        product = product @ factor.pose
    return product


def _target(factors: Product) -> Target:
    """Return a product as the target of a move: its last literal receives the correction."""
    for index in range(len(factors) - 1, -1, -1):
        literal = factors[index].literal
        if literal is None or factors[index].is_inverse or sum(f.literal is literal for f in factors) > 1:
            continue
        left, right = (_product(part) for part in (factors[:index], factors[index + 1 :]))
        return Target(literal, left, right, factors[index].uses)
    raise Uncertain("not-written")


# moves


def read_urscript(files: Sequence[Source], surroundings: Surroundings) -> Program:
    """Read scripts that run together."""
    script = read_names(files, surroundings)
    reader = _Reader(script)

    def tool_pose(event: Event) -> Floats:
        call = call_of(event.tokens)
        try:
            return reader.pose(call.argument(0, "pose") if call else (), event.statement)
        except Uncertain as uncertain:
            raise uncertain.about("tool") from None

    finder = _MoveFinder(script, reader, Tools(script, tool_pose))
    finder.find()
    return script.program


@dataclass(eq=False)
class _MoveFinder:
    """Adds the moves of a script to its program."""

    script: Script
    reader: _Reader
    tools: Tools
    places: set[Place] = field(default_factory=set)

    def find(self) -> None:
        """Add all moves of functions that may be called, and what else may move the robot."""
        reached = self.reached()
        steps = self.script.program.steps
        for entry in self.script.outline:
            if isinstance(entry, Step):
                steps.append(entry)
            elif isinstance(entry, Statement) and (entry.routine is None or entry.routine in reached):
                for index, token in calls_in(entry.tokens):
                    self.add(entry, index, token)

    def reached(self) -> set[Routine]:
        """Return the functions that may be called: the outermost ones, and what these call."""
        routines = [routine for same_name in self.script.routines.values() for routine in same_name]
        called: dict[Routine | None, set[str]] = {}
        for statement in self.script.statements():
            names = {token.text for _, token in calls_in(statement.tokens)}
            called.setdefault(statement.routine, set()).update(names)
        waiting = [routine for routine in routines if routine.outer is None]
        waiting += [routine for name in called.get(None, ()) for routine in self.script.routines.get(name, ())]
        reached = set(waiting)
        while waiting:
            names = called.get(waiting.pop(), set())
            new = {routine for name in names for routine in self.script.routines.get(name, ())} - reached
            reached |= new
            waiting += new
        return reached

    def add(self, statement: Statement, index: int, token: Token) -> None:
        """Add a call if it moves the robot, or may."""
        program, place = self.script.program, statement.place(token)
        if token.text in self.script.routines or token.text not in LANGUAGE:
            program.steps.append(Step.CALL)
        if (token.text not in MOVES and token.text not in AIMLESS) or place in self.places:
            return
        self.places.add(place)
        end = closing(statement.tokens, index + 1)
        tokens = statement.tokens[index : end + 1] if end < len(statement.tokens) else [token]
        move = Move(token.text, place, tokens[-1].end, token.text in STRAIGHT)
        program.moves.append(move)
        program.steps.append(move)
        try:
            call = call_of(tokens)
            if call is None or token.text in AIMLESS:
                raise Uncertain("aimless" if token.text in AIMLESS else "arguments")
            if self.script.displaced is not None:
                raise self.script.displaced.again()
            for number, names in enumerate(MOVES[token.text]):
                move.goals += self.goals(statement, token, call.argument(number, *names))
            program.count(move)
        except Uncertain as uncertain:
            move.refuse(uncertain)

    def goals(self, statement: Statement, token: Token, argument: Tokens) -> list[Goal]:
        """Return the goals of one argument of a move. Raises Uncertain."""
        if not argument:
            raise Uncertain("arguments")
        span = argument[0].start, argument[-1].end
        tokens, where, uses = self.source(argument, statement)
        call = call_of(tokens)
        if call and call.function == "get_inverse_kin" and call.function not in self.script.routines:
            return self.solved_goals(tokens, where, uses)
        try:
            several = self.reader.joints(argument, statement)
        except Uncertain:
            if is_bracketed(tokens, 0, "["):
                raise
            products = self.reader.poses(argument, statement)
            tool = self.tools.in_force(statement, token)
            return [Goal(_target(product), tool, argument=span if len(products) == 1 else None) for product in products]
        return [Goal(Target(r.literal, uses=r.uses), argument=span if len(several) == 1 else None) for r in several]

    def source(self, argument: Tokens, statement: Statement) -> tuple[Tokens, Statement, Uses]:
        """Follow names to the call that gives a target: q = get_inverse_kin(…), movej(q)."""
        uses: list[tuple[Datum, Place]] = []
        tokens = argument
        for _ in range(DEEPEST):
            datum = find(self.script, tokens[0].text, statement) if len(tokens) == 1 else None
            if datum is None or datum.changes or len(datum.values) != 1 or datum.kind == "parameter":
                break
            uses.append((datum, statement.place(tokens[0])))
            tokens, statement = datum.values[0]  # type: ignore[assignment]
        return tokens, statement, tuple(uses)

    def solved_goals(self, tokens: Tokens, statement: Statement, uses: Uses) -> list[Goal]:
        """Return the goals of get_inverse_kin(x, qnear=…, tcp=…), reached by the names ``uses``."""
        call = call_of(tokens)
        assert call is not None
        for datum, _ in uses:
            certain(self.script, datum)
        argument, other_tool = call.argument(0, "x"), call.argument(4, "tcp")
        near = self.near(call.argument(1, "qnear"), statement)
        if not argument:
            raise Uncertain("arguments")
        if other_tool and other_tool[0].text.strip("\"'") != "active_tcp":
            tool = self.reader.pose(other_tool, statement)
        else:
            tool = self.tools.in_force(statement, tokens[0])
        products = self.reader.poses(argument, statement)
        alone = len(products) == 1 and not uses
        goals = []
        for product in products:
            target = _target(product)
            target = Target(target.literal, target.left, target.right, (*uses, *target.uses))
            span = (argument[0].start, argument[-1].end) if alone else None
            goals.append(Goal(target, tool, argument=span, near=near))
        return goals

    def near(self, tokens: Tokens, statement: Statement) -> tuple[float, ...]:
        """Return the joint readings [rad] of a qnear, none if it is missing or where the robot is. Raises Uncertain."""
        call = call_of(tokens)
        if not tokens or (call and call.function in CURRENT_JOINTS):
            return ()
        several = self.reader.joints(tokens, statement)
        if len(several) != 1:
            raise Uncertain("several", name="its qnear")
        self.script.program.harmless.update(place for _, place in several[0].uses)
        return several[0].literal.numbers


__all__ = ["read_urscript"]
