"""The effect of RAPID's instructions and functions on a program's moves (ABB, technical reference manual 3HAC050917).

An instruction that is not listed (``rapid_words``) may move the robot, and is reported.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from itertools import count

from truearm.errors import ProgramError
from truearm.files.programs.choices import ABSENT, PRESENT, asked_of, present
from truearm.files.programs.dataflow import Flow, length_of_texts
from truearm.files.programs.environment import Key
from truearm.files.programs.numeric_functions import OF_RAPID, applied, length_of
from truearm.files.programs.rapid import LATE_BOUND, Module
from truearm.files.programs.rapid_expressions import PASSED
from truearm.files.programs.rapid_poses import (
    NO_AXIS,
    inverted,
    items_of,
    multiplied,
    object_of,
    offset,
    offset_along_tool,
    oriented,
    target_of,
    tool_of,
)
from truearm.files.programs.rapid_rules import PREDEFINED, check_rules
from truearm.files.programs.rapid_words import (
    AIMLESS,
    BY_JOINTS,
    BY_NAME,
    FUNCTIONS,
    MOVES,
    QUIET,
    READERS,
    SEARCHES,
    SENDERS,
    STRAIGHT,
)
from truearm.files.programs.sent_moves import why_sent
from truearm.files.programs.syntax import Call, Expression, Number, Taught, Truth
from truearm.files.programs.tree_walks import root_of
from truearm.files.programs.values import (
    NOWHERE,
    Listed,
    Pose,
    Unknown,
    Value,
    Values,
    computed,
    counts,
    distinct,
    joined,
    origin_of,
)
from truearm.files.programs.work import LETTERS, Work

DISPLACED = "program displacement"
LOCKED = "axis 4 locked"
CONFIGURATIONS = ("confj", "confl")  # whether they are monitored in joint moves, and in the others
_STATES = (DISPLACED, LOCKED, *CONFIGURATIONS)  # of the controller


_FIELDS: Mapping[str, int] = {
    **{"trans": 0, "rot": 1, "robconf": 2, "extax": 3, "robax": 0, "x": 0, "y": 1, "z": 2, "robhold": 0, "tframe": 1, "tload": 2},
    **{"ufprog": 1, "ufmec": 2, "uframe": 3, "oframe": 4, "q1": 0, "q2": 1, "q3": 2, "q4": 3, "cf1": 0, "cf4": 1, "cf6": 2, "cfx": 3},
    **{f"rax_{k}": k - 1 for k in range(1, 7)},
    **{f"eax_{letter}": k for k, letter in enumerate("abcdef")},
}  # fmt: skip
NO_AXES = tuple(f"[{','.join([none] * 6)}]]" for none in ("9E9", "9E+09"))  # as most editors write them
_TOOL, _OBJECT = "tool0", "wobj0"


@dataclass(frozen=True)
class Rapid:
    """The meaning of RAPID.

    ``fields``: places of components in records; ``harmless``: external routines that do not move the robot;
    ``constants``: their names; ``asked``: optional parameters of routines that some calls give and others do not.
    """

    fields: Mapping[str, int]
    harmless: frozenset[str] = frozenset()
    constants: frozenset[str] = frozenset()
    effects: frozenset[str] = frozenset()  # its functions have none
    distances: frozenset[str] = frozenset({"distance"})
    asked: frozenset[tuple[str, str]] = frozenset()

    def changed_by(self, call: Call) -> Sequence[Expression]:
        """Return the arguments to which an instruction may assign: all except constants and read-only ones."""
        if call.function in SEARCHES:
            return call.arguments[1:2]
        if call.function in READERS:
            return ()
        given = (*call.arguments, *(argument for _, argument in call.named))
        return tuple(one for one in given if root_of(one) not in self.constants)

    def literal(self, of: Taught) -> Value:
        """Return a literal robtarget or jointtarget unchanged."""
        return of

    def call(self, flow: Flow, call: Call, arguments: Sequence[Values], named: Mapping[str, Values]) -> Values | None:
        """Apply an instruction or function of the language and return its result; None for any other."""
        name, at = call.function, call.start
        if name in MOVES:
            self._move(flow, call, arguments, named)
            return ()
        if name in BY_NAME:
            flow.uncertain(
                name, at, call.end, f"{name} changes data or calls a routine by a name that is known only at run time"
            )
            return ()
        if name in AIMLESS:
            flow.uncertain(name, at, call.end, f"{name} moves the robot without a target that is in the program")
            return ()
        if name in ("pdispon", "pdispset", "eoffson", "eoffsset"):
            flow.set(DISPLACED, (Unknown(f"{name} displaces the program at run time", at),), "global")
            return ()
        if name in ("pdispoff", "eoffsoff"):
            flow.set(DISPLACED, (NOWHERE,), "global")
            return ()
        if name == "singarea":
            why = r"SingArea\LockAxis4 turns the tool away from the target where axis 4 is not at 0 or 180 deg there"
            flow.set(LOCKED, (Unknown(why, at),) if "lockaxis4" in named else (NOWHERE,), "global")
            return ()
        if name == "moveextj" and name not in self.harmless:
            why = "MoveExtJ moves external axes, which may carry the robot"
            flow.uncertain(name, at, call.end, why, "harmless")
            return ()
        if name == LATE_BOUND:
            flow.uncertain(name, at, call.end, "the routine that %…% calls is known only at run time")
            return ()
        if name in CONFIGURATIONS:
            flow.set(name, (Truth("off" not in named),), "global")
            return ()
        if name == PASSED:
            return arguments[0]
        if name == PRESENT and arguments and self._is_asked(flow, call.arguments[0]):
            return distinct(tuple(present(arguments[0])))
        if name == "offs" and len(arguments) == 4:
            return flow.posed(at, lambda *given: offset(given, at), arguments)
        if name == "orientzyx" and len(arguments) == 3:
            return flow.posed(at, lambda *given: oriented(given, at), arguments)
        if name == "reltool" and len(arguments) == 4:
            turns = [named.get(key, (Number(0.0),)) for key in ("rx", "ry", "rz")]
            return flow.posed(at, lambda *given: offset_along_tool(given, at), [*arguments, *turns])
        if name in OF_RAPID and not named:
            return flow.posed(at, lambda *given: applied(name, OF_RAPID[name], given, at), arguments)
        if name == "dim" and arguments[1:] == [(Number(1.0),)]:
            return distinct(tuple(length_of(one, at) for one in arguments[0]))
        if name == "posemult" and len(arguments) == 2:
            return flow.posed(at, lambda *given: multiplied(given, at), arguments)
        if name == "poseinv" and len(arguments) == 1:
            return flow.posed(at, lambda *given: inverted(given, at), arguments)
        if name in SENDERS and name not in self.harmless:
            flow.work.spend(length_of_texts([*arguments, *named.values()]) // LETTERS)
            sent = why_sent(value for values in (*arguments, *named.values()) for value in values)
            if sent is not None:
                flow.uncertain(name, at, call.end, sent, "harmless")
        if name == "calcjointt":
            why = "its joint readings come from CalcJointT and are known only at run time; move to the robtarget with MoveJ"
            return (Unknown(why, at),)
        if name in QUIET or name in FUNCTIONS or name in self.harmless:
            return (
                Unknown(f"the result of {name} is known only at run time; correct the target where it is made", at),
            )
        return None

    def _is_asked(self, flow: Flow, parameter: Expression) -> bool:
        """Return whether some calls of the routine being executed give this optional parameter and others do not."""
        routine = flow.stack[-1].routine
        return routine is not None and (routine.name, root_of(parameter)) in self.asked

    def item(self, of: Value, at: Value | str, place: int) -> Values:
        """Return an element of an array, counted from 0, or a component of a record; nothing beyond its end."""
        if isinstance(of, Unknown):
            return (of,)
        items = items_of(of)
        k = self.fields.get(at) if isinstance(at, str) else int(at.value) if isinstance(at, Number) else None
        if items is None or (isinstance(at, str) and k is None):
            return (Unknown("an element or component cannot be traced", place, origin=origin_of((of,))),)
        if k is not None:
            return items[k] if 0 <= k < len(items) else ()
        return tuple(dict.fromkeys(value for item in items for value in item))

    def changed(self, of: Value, at: Value | str, new: Values, place: int) -> Value:
        """Return an array or record with another item."""
        items = items_of(of)
        k = self.fields.get(at) if isinstance(at, str) else int(at.value) if isinstance(at, Number) else None
        if items is None or k is None or not 0 <= k < len(items):
            lost = of if isinstance(of, Unknown) else Unknown("the assignment to an element cannot be traced", place)
            return computed(lost, origin_of((of, *new)))
        return Listed((*items[:k], new, *items[k + 1 :]))

    def _move(self, flow: Flow, call: Call, arguments: Sequence[Values], named: Mapping[str, Values]) -> None:
        move, name, at = MOVES[call.function], call.function, call.start
        if len(arguments) <= max(*move.targets, move.tool, 0) or not arguments:
            flow.uncertain(name, at, call.end, "arguments are missing")
            return
        if "corr" in named:
            flow.uncertain(name, at, call.end, r"\Corr changes the path at run time")
        tools = tuple(tool_of(value, at) for value in arguments[move.tool])
        given = named.get("wobj", (ABSENT,))  # or an optional parameter that is passed on but was not given
        objects = tuple(NOWHERE if value == ABSENT else object_of(value, at) for value in given)
        for state in (DISPLACED, LOCKED):
            objects = tuple(value for value in flow.get(state) or () if isinstance(value, Unknown)) + objects
        free = Truth(False) in (flow.get(CONFIGURATIONS[name not in BY_JOINTS]) or ())
        targets = [
            (tuple(self._beside(target_of(value, at), at, free) for value in arguments[k]), call.arguments[k])
            for k in move.targets
        ]
        flow.goes_to(call, targets, tools, objects, straight=name in STRAIGHT)

    def _beside(self, target: Value, at: int, free: bool) -> Value:
        """Return a target, unless an external axis of it may move the robot's base; ``free``: in any configuration."""
        if isinstance(target, Pose) and free:
            target = target._replace(free=True)
        like = target.like if isinstance(target, Pose) else None
        if like is None or like.text.replace(" ", "").endswith(NO_AXES):
            return target
        used = (f"eax_{letter}" for letter, axis in zip("abcdef", like.values[11:], strict=False) if axis < NO_AXIS)
        first = next((axis for axis in used if axis not in self.harmless), None)
        return (
            target if first is None else Unknown(f"its external axis {first} may move the robot's base", at, "harmless")
        )


def analyse(work: Work, modules: Sequence[Module], given: Mapping[str, Listed], harmless: frozenset[str]) -> Flow:
    """Follow a program; ``given`` are tools and work objects declared elsewhere."""
    check_rules(work, modules)
    records = {
        name: k for module in modules for record in module.records.values() for k, (_, name) in enumerate(record)
    }
    clash = {
        name
        for module in modules
        for record in module.records.values()
        for k, (_, name) in enumerate(record)
        if records[name] != k or _FIELDS.get(name, k) != k
    }
    fields = {name: k for name, k in {**_FIELDS, **records}.items() if name not in clash}
    routines = [routine for module in modules for routine in module.routines]
    constants = {_TOOL, _OBJECT}
    constants |= {datum.name for module in modules for datum in module.data if datum.kind == "const"}
    for routine in routines:  # in a routine, a name may be another variable's
        constants -= {one.name for one in routine.parameters}
    constants = constants.difference(*(module.assigned for module in modules))
    known = frozenset(name.lower() for name in harmless), frozenset(constants)
    flow = Flow(work, Rapid(fields, *known, asked=asked_of(routines)), routines)
    for name in given:
        if name in PREDEFINED:
            raise ProgramError(f"{work.source.name}: {name} is predefined; leave it out of the options")
        if not any(name in module.names for module in modules):
            similar = get_close_matches(name, sorted(modules[0].names.difference(flow.routines.by_name)), n=1)
            flow.unused[name] = next(iter(similar), "")
    begins: Mapping[str, Value] = {_TOOL: NOWHERE, _OBJECT: NOWHERE, DISPLACED: NOWHERE, LOCKED: NOWHERE, **given}
    for name, value in begins.items():
        flow.environment.set((0, name), (value,))
    for name in CONFIGURATIONS:
        flow.environment.set((0, name), (Truth(True),))
    begin: dict[str, Values] = {}
    for module in modules:
        for datum in module.data:
            if datum.name in begin or datum.name in flow.routines.by_name:
                raise work.source.wrong(
                    datum.start, f"{datum.name} is declared twice in this file; put each module in its own file"
                )
            if datum.name in given:
                what = f"{datum.name} is declared in this program; leave its pose out of the options"
                raise work.source.wrong(datum.start, what)
            if datum.value is None:
                why = f"{datum.name} is declared without a value; declare it with its values"
                begin[datum.name] = (Unknown(why, datum.start),)
            else:
                begin[datum.name] = flow.value(datum.value)
            flow.environment.set((0, datum.name), begin[datum.name])
    kept = _assigned_elsewhere(modules)
    used = {name for one in routines for name in one.calls if name != one.name}
    # A run from the beginning resets them. One that continues after the last statement or ExitCycle does not.
    resets = not any(one.handlers or "exitcycle" in one.calls for one in routines)
    entries = sorted(
        (one for one in routines if one.name not in used or one.name == "main"),
        key=lambda one: (one.name in used, one.name != "main"),
    )
    begun = {one.name for one in entries}
    record: dict[Key, dict[Value, None]] = {}
    flow.environment.records.append(record)
    kept_keys = {(0, name) for name in kept}
    lost: set[Key] = set()  # what changes from run to run, and is not followed any more
    for turn in count():
        grown: set[Key] = set()
        for routine in entries:
            own: dict[Key, dict[Value, None]] = {}
            flow.environment.records.append(own)
            flow.environment.begin({})
            flow.enter(routine, None, (), {})
            ends = {(0, name): flow.environment.get((0, name)) or () for name in _STATES} if resets else {}
            flow.environment.end()
            flow.environment.records.pop()
            for key in kept_keys.intersection(own) - lost:
                # All values it ever had: the run may be stopped anywhere, or ended by ExitCycle.
                before = flow.environment.get(key)
                after = joined(before, ends.get(key, tuple(own[key])))
                if turn and counts(before, after):
                    why = f"{key[1]} changes from one run of the program to the next"
                    after = (Unknown(why, 0, "", origin_of(after)),)
                if after != before:
                    grown.add(key)
                flow.environment.set(key, after)
        if not grown:
            break
        if turn >= FEW_ROUNDS:
            new = grown if turn < MANY_ROUNDS else kept_keys - lost
            lost |= new
            for key in sorted(new):
                why = f"{key[1]} changes from one run of the program to the next"
                origin = origin_of(flow.environment.get(key) or ())
                flow.environment.set(key, (Unknown(why, 0, "", origin),))
    flow.environment.records.pop()
    flow.environment.begin_any_time(record)
    for routine in routines:  # code that may run at any time: traps, service routines, and what only such routines call
        if routine.name != "main" and (routine.name in begun or routine.name not in flow.called):
            flow.environment.begin({})
            flow.enter(routine, None, (), {})
            flow.environment.end()
    flow.environment.end()
    for call in flow.choices.never_followed():
        if call.function in (MOVES.keys() | AIMLESS) and call.start not in flow.motions:
            why = "whether it runs depends on an optional argument, and with the calls in this file it never does"
            flow.uncertain(call.function, call.start, call.end, why)
    return flow


FEW_ROUNDS, MANY_ROUNDS = 2, 8  # runs after which what still changes is given up, and then all that may change


def _assigned_elsewhere(modules: Sequence[Module]) -> tuple[str, ...]:
    """Return data that keep their value from one routine or run to the next, in the order of the text.

    These include the displacement and the monitored configurations.
    """
    return (
        *(datum.name for module in modules for datum in module.data if datum.kind != "const"),
        *_STATES,
    )
