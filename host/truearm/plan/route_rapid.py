"""A route in RAPID.

The signals ``doTruearm`` and ``diTruearm`` are defined in the controller's configuration. Lines are driven to
robtargets that the controller computes from the planned joints (``CalcRobT``), and therefore in the planned
configuration and by its own model.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import assert_never

from truearm.plan.route_stops import SETTLE, TIMEOUT, Stop, Task, identifier
from truearm.types import Move
from truearm.units import DEG, MM, MM_S

TOOL = "toTruearm"


def text(stops: Sequence[Stop], task: Task) -> str:
    """Return a module; joints in degrees."""
    lines_too = any(stop.move is Move.LINE for stop in stops)
    tool = TOOL if lines_too else "tool0"
    lines = [f"MODULE {identifier(task.name)}", *_data(task, lines_too), "  PROC main()", *_begin(lines_too)]
    for number, stop in enumerate(stops):
        lines.append(f"    ! row {number}: {stop.move}")
        if stop.before:
            lines += _ask(stop.before)
        at_stop = _ask(stop.there) if stop.there else []
        match stop.move:
            case Move.LINE:
                lines += [*_line(stop, task), *at_stop]
            case Move.VIA:
                lines += [_move(stop, tool), *at_stop]
            case Move.DWELL:
                lines += [_move(stop, tool), *at_stop, *_at_pose(task)]
            case _:
                assert_never(stop.move)
    return "\n".join([*lines, "  ENDPROC", "ENDMODULE", ""])


def _data(task: Task, lines_too: bool) -> list[str]:
    place = ",".join(f"{MM.of(v):.3f}" for v in task.tool)
    tool = [
        "  ! Set the tool's own mass [kg] and its centre before you drive.",
        f"  PERS tooldata {TOOL}:=[TRUE,[[{place}],[1,0,0,0]],[1,[0,0,50],[1,0,0,0],0,0,0]];",
    ]
    return tool * lines_too + ["  VAR bool late;"] * (task.signals.input is not None)


def _begin(lines_too: bool) -> list[str]:
    return ["    ConfL \\Off;"] * lines_too + ["    SetDO doTruearm, 0;"]


def _move(stop: Stop, tool: str) -> str:
    pace = f"v1000 \\T:={stop.seconds:.3f}" if stop.seconds > 0.0 else "v50"
    return f"    MoveAbsJ {_joints(stop)} \\NoEOffs, {pace}, fine, {tool};"


def _line(stop: Stop, task: Task) -> list[str]:
    speed = f"[{MM_S.of(stop.speed):.2f},500,5000,1000]"
    drive = f"    MoveL CalcRobT({_joints(stop)}, {TOOL}), {speed}, fine, {TOOL};"
    return [*_at_rest(task), drive, *_switched(task, 0)]


def _joints(stop: Stop) -> str:
    return f"[[{','.join(f'{v:.5f}' for v in DEG.of(stop.q))}],[9E9,9E9,9E9,9E9,9E9,9E9]]"


def _ask(text: str) -> list[str]:
    return [f'    TPWrite "{text}";', "    Stop;"]


def _at_pose(task: Task) -> list[str]:
    return [*_at_rest(task), f"    WaitTime {task.dwell:.3f};", *_switched(task, 0)]


def _at_rest(task: Task) -> list[str]:
    return [f"    WaitTime \\InPos, {SETTLE};", *_switched(task, 1)]


def _switched(task: Task, level: int) -> list[str]:
    """Return the statements that set the output and, if there is an input, wait until it follows."""
    out = f"    SetDO doTruearm, {level};"
    if task.signals.input is None:
        return [out]
    return [out, f"    WaitDI diTruearm, {level} \\MaxTime:={TIMEOUT} \\TimeFlag:=late;"]
