"""A route in URScript.

The format follows Universal Robots' script manual for programs sent to a controller (port 30002): ``def`` in the first
column, everything else indented, ``end`` in the first column. The program runs once ``end`` has arrived. A ``movel`` to
joints moves straight in space to where the controller's own model places them: in the planned configuration, and to the
calibrated arm's own pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import assert_never

from truearm.plan.route_stops import SETTLE, SLOW, TIMEOUT, Stop, Task, identifier
from truearm.types import Move

ACCELERATION = 0.5  # m/s² at a line's ends


def text(stops: Sequence[Stop], task: Task) -> str:
    """Return a function; joints in rad, digital lines by standard number."""
    lines = [f"def {identifier(task.name)}():", *_switched(task, False)[:1]]
    if any(task.tool):
        lines.append(f"  set_tcp(p[{', '.join(f'{v:.6f}' for v in task.tool)}, 0, 0, 0])")
    for number, stop in enumerate(stops):
        lines.append(f"  # row {number}: {stop.move}")
        if stop.before:
            lines.append(_ask(stop.before))
        at_stop = [_ask(stop.there)] if stop.there else []
        match stop.move:
            case Move.LINE:
                lines += [*_line(stop, task), *at_stop]
            case Move.VIA:
                lines += [_move(stop), *at_stop]
            case Move.DWELL:
                lines += [_move(stop), *at_stop, *_at_pose(task)]
            case _:
                assert_never(stop.move)
    return "\n".join([*lines, "end", ""])


def _move(stop: Stop) -> str:
    pace = f"t={stop.seconds:.3f}" if stop.seconds > 0.0 else f"a={SLOW}, v={SLOW}"
    return f"  movej({_joints(stop)}, {pace})"


def _line(stop: Stop, task: Task) -> list[str]:
    drive = f"  movel({_joints(stop)}, a={ACCELERATION}, v={stop.speed:.5f})"
    return [*_at_rest(task), drive, *_switched(task, False)]


def _joints(stop: Stop) -> str:
    return f"[{', '.join(f'{v:.6f}' for v in stop.q)}]"


def _ask(text: str) -> str:
    return f'  popup("{text}", title="truearm", blocking=True)'


def _at_pose(task: Task) -> list[str]:
    return [*_at_rest(task), f"  sleep({task.dwell:.3f})", *_switched(task, False)]


def _at_rest(task: Task) -> list[str]:
    return [f"  sleep({SETTLE})", *_switched(task, True)]


def _switched(task: Task, level: bool) -> list[str]:
    """Return the statements that set the output and, if there is an input, wait until it follows."""
    out = f"  set_standard_digital_out({task.signals.output}, {level})"
    if task.signals.input is None:
        return [out]
    return [
        out,
        "  waited = 0.0",
        f"  while get_standard_digital_in({task.signals.input}) != {level} and waited < {TIMEOUT}:",
        "    sleep(0.008)",
        "    waited = waited + 0.008",
        "  end",
    ]
