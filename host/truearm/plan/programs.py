"""A route as a program: CSV for any controller, URScript, RAPID.

Every move but the first, which starts anywhere and is slow, is straight in joint space and takes the seconds of the route, so that neither a joint nor the bar goes faster than
planned. At a pose the program says "at rest" on an output, waits for the dwell, and takes the word back before it moves on;
with an ``input`` it also waits until the box has answered, at most TIMEOUT, and until the answer is gone. Before a new pairing
it stops and says what to mount.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from truearm.errors import PlanError
from truearm.plan.route import Stop, csv_of

TIMEOUT = 5.0  # s that the box has to answer
SETTLE = 0.3  # s between arriving and saying so
N_AXES = 6
SLOW = 0.2  # rad/s, rad/s² of the first move, from wherever the arm stands; RAPID: 50 mm/s
DIALECTS = {".csv": "stops", ".script": "URScript", ".mod": "RAPID"}


class Signals(NamedTuple):
    """Digital lines of the controller to and from the box: numbers (UR) or names (RAPID's ``doTruearm``, ``diTruearm``)."""

    output: int = 0
    input: int | None = None


def program(stops: Sequence[Stop], dwell: float, suffix: str, name: str, signals: Signals | None = None) -> str:
    """The text for a file's suffix, one of DIALECTS. Raises PlanError for another one, and for an arm of other than six joints."""
    makers: dict[str, Callable[[Sequence[Stop], float, str, Signals], str]] = {
        ".csv": csv_text,
        ".script": urscript,
        ".mod": rapid,
    }
    check_suffix(suffix)
    if suffix != ".csv" and len(stops[0].q) != N_AXES:
        raise PlanError(f"{DIALECTS[suffix]} programs have six joints, the robot has {len(stops[0].q)}; use .csv")
    return makers[suffix](stops, dwell, name, signals or Signals())


def check_suffix(suffix: str) -> None:
    """Raise PlanError for a suffix that is none of DIALECTS."""
    if suffix not in DIALECTS:
        known = ", ".join(f"{end} ({what})" for end, what in DIALECTS.items())
        raise PlanError(f"no program is written as {suffix or 'a file without suffix'!r}; use {known}")


def csv_text(stops: Sequence[Stop], dwell: float, name: str, signals: Signals) -> str:
    """Every stop a row: its pose in the plan (empty: a via point), what to mount, seconds of move and dwell, joints [rad]."""
    rows = [["stop", "pose", "mount", "move_s", "dwell_s", *(f"q{i + 1}_rad" for i in range(len(stops[0].q)))]]
    for number, stop in enumerate(stops):
        pose, rest = ("", 0.0) if stop.pose < 0 else (str(stop.pose), dwell)
        rows.append([str(number), pose, stop.mount, f"{stop.seconds:.3f}", f"{rest:g}", *map(repr, stop.q.tolist())])
    return csv_of(rows)


def urscript(stops: Sequence[Stop], dwell: float, name: str, signals: Signals) -> str:
    """A URScript function; joints in rad, lines by standard digital numbers."""
    out = signals.output
    lines = [f"def {_identifier(name)}():", f"  set_standard_digital_out({out}, False)"]
    for stop in stops:
        if stop.mount:
            lines.append(f'  popup("Next: {stop.mount}", title="truearm", blocking=True)')
        pace = f"t={stop.seconds:.3f}" if stop.seconds > 0.0 else f"a={SLOW}, v={SLOW}"
        lines.append(f"  movej([{', '.join(f'{v:.6f}' for v in stop.q)}], {pace})")
        if stop.mount:
            lines.append(f'  popup("Here: {stop.mount}", title="truearm", blocking=True)')
        if stop.pose >= 0:
            lines += [f"  # pose {stop.pose}", f"  sleep({SETTLE})", f"  set_standard_digital_out({out}, True)"]
            lines += _ur_wait(signals.input, True)
            lines += [f"  sleep({dwell:.3f})", f"  set_standard_digital_out({out}, False)"]
            lines += _ur_wait(signals.input, False)
    return "\n".join([*lines, "end", f"{_identifier(name)}()", ""])


def _ur_wait(line: int | None, level: bool) -> list[str]:
    if line is None:
        return []
    return [
        "  waited = 0.0",
        f"  while get_standard_digital_in({line}) != {level} and waited < {TIMEOUT}:",
        "    sleep(0.008)",
        "    waited = waited + 0.008",
        "  end",
    ]


def rapid(stops: Sequence[Stop], dwell: float, name: str, signals: Signals) -> str:
    """A RAPID module; joints in degrees, signals ``doTruearm`` and ``diTruearm`` of the controller's configuration."""
    lines = [f"MODULE {_identifier(name)[:32]}", "  PROC main()", "    ConfJ \\Off;", "    SetDO doTruearm, 0;"]
    for stop in stops:
        if stop.mount:
            lines += [f'    TPWrite "Next: {stop.mount}";', "    Stop;"]
        joints = ",".join(f"{v:.5f}" for v in np.rad2deg(stop.q))
        target = f"[[{joints}],[9E9,9E9,9E9,9E9,9E9,9E9]]"
        pace = f"v1000 \\T:={stop.seconds:.3f}" if stop.seconds > 0.0 else "v50"
        lines.append(f"    MoveAbsJ {target} \\NoEOffs, {pace}, fine, tool0;")
        if stop.mount:
            lines += [f'    TPWrite "Here: {stop.mount}";', "    Stop;"]
        if stop.pose >= 0:
            lines += [f"    ! pose {stop.pose}", f"    WaitTime \\InPos, {SETTLE};", "    SetDO doTruearm, 1;"]
            lines += _rapid_wait(signals.input, 1)
            lines += [f"    WaitTime {dwell:.3f};", "    SetDO doTruearm, 0;", *_rapid_wait(signals.input, 0)]
    flag = ["  VAR bool late;"] if signals.input is not None else []
    return "\n".join([lines[0], *flag, *lines[1:], "  ENDPROC", "ENDMODULE", ""])


def _rapid_wait(line: int | None, level: int) -> list[str]:
    return [] if line is None else [f"    WaitDI diTruearm, {level} \\MaxTime:={TIMEOUT} \\TimeFlag:=late;"]


def _identifier(name: str) -> str:
    """A name that both languages take."""
    text = re.sub(r"\W", "_", name, flags=re.ASCII) or "truearm_plan"
    return text if text[0].isalpha() else f"p_{text}"
