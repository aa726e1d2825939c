"""The effect of URScript's own functions on a program's moves (Universal Robots, script manual 5.x).

``pose_trans(A, B)`` is A·B; ``pose_add(A, B)`` adds positions and multiplies rotations; ``get_inverse_kin`` returns the
joints that a pose requires. A function that is not listed may move the robot, and is reported.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from truearm.files.programs.dataflow import Flow, length_of_texts
from truearm.files.programs.environment import TOOL
from truearm.files.programs.sent_moves import text_of, why_sent
from truearm.files.programs.syntax import (
    Block,
    Call,
    Expression,
    Form,
    Number,
    Routine,
    Taught,
    Text,
    Truth,
)
from truearm.files.programs.urscript_poses import PURE, SIX, as_pose, items_of, list_made, unknown_in
from truearm.files.programs.urscript_words import AIMLESS, DISTANCES, EFFECTS, MOVES, OVERWRITES, QUIET, STRAIGHT
from truearm.files.programs.values import (
    NOWHERE,
    Fields,
    Listed,
    Pose,
    Solved,
    Unknown,
    Value,
    Values,
    combined,
    computed,
    first_unknown,
    numbers_of,
    origin_of,
    taught_pose,
)
from truearm.files.programs.work import LETTERS, Work

_SENDERS = ("socket_send_line", "socket_send_string")
_WHERE_IT_IS = frozenset({"get_actual_joint_positions", "get_target_joint_positions"})
TRACKED = "tracked conveyor"  # variable names contain no spaces


class UrScript(NamedTuple):
    """The meaning of URScript. ``harmless``: external functions that, according to the user, do not move the robot."""

    harmless: frozenset[str] = frozenset()
    effects: frozenset[str] = EFFECTS
    distances: frozenset[str] = DISTANCES

    def changed_by(self, call: Call) -> Sequence[Expression]:
        """Return the object of a method call, such as a list (``path.insert(0, p)``); arguments are copies."""
        return call.arguments[:1] if call.function.startswith(".") else ()

    def literal(self, of: Taught) -> Value:
        """Return a literal: p[…] is a pose, […] six joint readings or six numbers."""
        return taught_pose(of) if of.form is Form.POSE else of

    def call(self, flow: Flow, call: Call, arguments: Sequence[Values], named: Mapping[str, Values]) -> Values | None:
        """Apply a built-in function and return its result; None for any other function."""
        name, at = call.function, call.start
        if name in MOVES:
            _move(flow, call, arguments, named)
            return (Truth(True),)
        if name.startswith(("track_conveyor", "frame_tracking_enable")):
            flow.set(TRACKED, (Unknown(f"it moves relative to what {name} tracks", at),), "global")
        if name in ("stop_conveyor_tracking", "frame_tracking_disable"):
            flow.set(TRACKED, (NOWHERE,), "global")
        if name in AIMLESS:
            flow.uncertain(
                name, at, call.end, f"{name} moves the robot without a target; there is nothing to correct in it"
            )
            return (Truth(True),)
        if name in _SENDERS or name == "str_cat":
            flow.work.spend(length_of_texts([*arguments, *named.values()]) // LETTERS)
        if name in _SENDERS and name not in self.harmless:
            why = why_sent(value for values in (*arguments, *named.values()) for value in values)
            if why is not None:
                flow.uncertain(name, at, call.end, why, "harmless")
        if name == "str_cat" and arguments:
            return combined(at, lambda *given: text_of(given, at), arguments)
        if name == "set_tcp":
            given = arguments[0] if arguments else named.get("pose", ())
            flow.set(TOOL, tuple(_tool(value, at) for value in given))
            return (Truth(True),)
        if name == "get_tcp_offset":
            return flow.get(TOOL) or (Unknown("the tool is not known", at),)
        if name == "struct":
            return (Fields(tuple(named), tuple(named.values())),)
        if name == "get_inverse_kin":
            return _solved(flow, call, arguments, named)
        if name == "make_list":
            made = list_made(arguments, named, at)
            flow.work.spend(sum(len(one.items) for one in made if isinstance(one, Listed)))
            return made
        if name in PURE:
            values = [*arguments, *named.values()]
            return flow.posed(at, lambda *given: PURE[name](given, at), values) if values else None
        if name.startswith("."):
            return (Unknown("the result of a method or remote procedure is known only at run time", at),)
        if name in QUIET or name in self.harmless:
            return (
                Unknown(f"the result of {name} is known only at run time; correct the target where it is made", at),
            )
        return None

    def item(self, of: Value, at: Value | str, place: int) -> Values:
        """Return an element of a list or pose, counted from 0, or a field of a struct; nothing beyond its end."""
        if isinstance(of, Unknown):
            return (of,)
        if isinstance(of, Fields) and isinstance(at, str) and at in of.names:
            return of.items[of.names.index(at)]
        items = items_of(of)
        if items is None or isinstance(at, str):
            return (Unknown("an element or field cannot be traced", place, origin=origin_of((of,))),)
        if isinstance(at, Number):
            k = int(at.value)
            return items[k] if 0 <= k < len(items) else ()
        return tuple(dict.fromkeys(value for item in items for value in item))

    def changed(self, of: Value, at: Value | str, new: Values, place: int) -> Value:
        """Return a list or struct with another item."""
        if isinstance(of, Fields) and isinstance(at, str) and at in of.names:
            k = of.names.index(at)
            return Fields(of.names, (*of.items[:k], new, *of.items[k + 1 :]))
        items = items_of(of)
        if items is None or not isinstance(at, Number) or not 0 <= int(at.value) < len(items):
            lost = Unknown("the assignment to an element cannot be traced", place)
            return computed(first_unknown((of,)) or lost, origin_of((of, *new)))
        k = int(at.value)
        return Listed((*items[:k], new, *items[k + 1 :]), isinstance(of, Pose) or (isinstance(of, Listed) and of.pose))


def analyse(work: Work, block: Block, tool: Values, harmless: frozenset[str]) -> Flow:
    """Follow a program; ``tool`` is active until it sets another."""
    routines = [one for one in block if isinstance(one, Routine)]
    flow = Flow(work, UrScript(harmless), routines)
    for name in flow.routines.by_name:
        if name in OVERWRITES:
            raise work.source.wrong(
                flow.routines.by_name[name].start, f"{name} is a function of the language and cannot be defined"
            )
    flow.environment.set((0, TOOL), tool)
    flow.run(block)
    flow.end_threads(None)
    for routine in routines:
        if routine.name not in flow.called:
            flow.environment.begin({})
            flow.enter(routine, None, (), {})
            flow.environment.end()
    return flow


def _move(flow: Flow, call: Call, arguments: Sequence[Values], named: Mapping[str, Values]) -> None:
    expressions = dict(call.named)
    targets = []
    for k, names in enumerate(MOVES[call.function]):
        name = next((one for one in names if one in named), None) if named else None
        if name is not None:
            targets.append((named[name], expressions[name]))
        elif k < len(arguments):
            targets.append((arguments[k], call.arguments[k]))
        else:
            flow.uncertain(call.function, call.start, call.end, "it has no target")
            return
    asked = [(tuple(_target(value, call.start) for value in values), place) for values, place in targets]
    flow.goes_to(call, asked, flow.get(TOOL) or (), flow.get(TRACKED) or (NOWHERE,), straight=call.function in STRAIGHT)


def _target(value: Value, at: int) -> Value:
    """Return a pose, joints or solved joints, if the value is one."""
    if isinstance(value, Taught | Pose | Solved | Unknown):
        return value
    if not isinstance(value, Listed):
        return Unknown("its target is neither a pose nor joint readings", at)
    if value.pose:
        return as_pose(value, at)
    numbers = numbers_of(value)
    if any(one.form is Form.POSE for one in value.origin):
        return Unknown("its joint readings are computed from the numbers of a pose", at)
    if numbers is not None and len(numbers) == SIX and all(map(math.isfinite, numbers)):
        return Taught(Form.COMPUTED, f"[{','.join(map(repr, numbers))}]", at)
    return unknown_in(value) or Unknown("its joint readings are not six plain numbers in one list", at)


def _tool(value: Value, at: int) -> Value:
    found = as_pose(value, at)
    return Unknown("the tool of set_tcp is known only at run time", at) if isinstance(found, Unknown) else found


def _solved(flow: Flow, call: Call, arguments: Sequence[Values], named: Mapping[str, Values]) -> Values:
    at = call.start
    poses = arguments[0] if arguments else named.get("x", ())
    nears = arguments[1] if len(arguments) > 1 else named.get("qnear", ())
    said = call.arguments[1] if len(arguments) > 1 else dict(call.named).get("qnear")
    if isinstance(said, Call) and said.function in _WHERE_IT_IS:
        nears = ()  # the controller uses these without qnear
    given = named.get("tcp", arguments[4] if len(arguments) > 4 else ())
    if not given or given == (Text("active_tcp"),):
        tools = flow.get(TOOL) or ()
    else:
        tools = tuple(_tool(value, at) for value in given)

    def solved(pose: Value, near: Value, tool: Value) -> Value:
        there, joints = as_pose(pose, at), _near(near, at)
        for one in (there, joints, tool):
            if isinstance(one, Unknown):
                return one
        assert isinstance(there, Pose)
        assert isinstance(tool, Pose)
        assert not isinstance(joints, Unknown)
        return Solved(there, joints, tool)

    return combined(at, solved, [poses, nears or (Truth(False),), tools])


def _near(value: Value, at: int) -> Taught | tuple[float, ...] | Unknown | None:
    """Return the joint readings of a qnear, which select one of the arm's configurations; None without one."""
    if isinstance(value, Taught) and value.form is Form.JOINTS:
        return value
    if isinstance(value, Truth):
        return None
    if isinstance(value, Solved):
        return value.near
    numbers = numbers_of(value)
    if numbers is None or len(numbers) != SIX or isinstance(value, Taught):
        return Unknown("its qnear is known only at run time, so its configuration is not known", at)
    return numbers
