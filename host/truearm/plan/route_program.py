"""A route as a program in URScript or RAPID, or as a table (CSV) for other controllers.

The first move, from anywhere, is slow. The others are straight in joint space and take the seconds of the route. At a
pose an output ("at rest") is set for the dwell. A line is driven straight in space at the planned speed, with the
output set. With an ``input`` the program also waits until the box has answered, at most TIMEOUT, and until the answer
is cleared. Before leaving a pairing or a line it stops until bar or device is removed, and at the next one until it is
mounted.

URScript follows Universal Robots' script manual for programs sent to port 30002: ``def`` and ``end`` in the first
column, everything else indented; it runs once ``end`` has arrived. A ``movel`` to joints goes straight in space to
where the controller's own model places them, in the planned configuration.

RAPID's signals ``doTruearm`` and ``diTruearm`` are defined in the controller's configuration. Lines go to robtargets
that the controller computes from the planned joints (``CalcRobT``), and so in the planned configuration.

A further language also has its suffix in ``options.LANGUAGES``, which ``--help`` reads.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from truearm.errors import PlanError
from truearm.plan.options import LANGUAGES, TABLE, languages_help
from truearm.plan.route import SETTLE, SLOW, TIMEOUT, Stop, Task, identifier
from truearm.types import Floats, Move
from truearm.units import DEG, MM, MM_S

N_AXES = 6
TOOL = "toTruearm"  # in RAPID, of a program with lines


def program(stops: Sequence[Stop], suffix: str, task: Task) -> str:
    """Return the program for a suffix of LANGUAGES. Raises PlanError for others, and for an arm without six joints."""
    check_language(suffix, len(stops[0].q))
    if suffix == TABLE:
        return table_text(stops, task)
    return program_text(RAPID if suffix == ".mod" else URSCRIPT, stops, task)


def check_language(suffix: str, n_joints: int) -> None:
    """Raise PlanError for a suffix that is not in LANGUAGES, or whose language is not for arms of so many joints."""
    if suffix not in LANGUAGES:
        raise PlanError(f"programs cannot be written as {suffix or 'a file without suffix'!r}; use {languages_help()}")
    if suffix != TABLE and n_joints != N_AXES:
        raise PlanError(
            f"{LANGUAGES[suffix]} programs have six joints, the robot has {n_joints}; "
            f"give a program that ends in {TABLE}: a table of all stops"
        )


@dataclass(frozen=True)
class Language:
    """The statements of a language, to be formatted with a stop's ``joints``, ``seconds`` and ``speed`` and the task.

    ``start``: the first move, from anywhere. ``ask``: show ``text`` and wait for the operator. ``answer``: wait until
    the input follows the output. ``program``: return the whole text with the statements, which may contain lines.
    """

    indent: str
    remark: str
    joints: Callable[[Floats], str]
    start: str
    move: str
    line: str
    settle: str
    dwell: str
    ask: tuple[str, ...]
    output: str
    answer: tuple[str, ...]
    program: Callable[[Task, list[str], bool], list[str]]


def program_text(language: Language, stops: Sequence[Stop], task: Task) -> str:
    """Return a program."""
    has_lines = any(stop.move == Move.LINE for stop in stops)
    switching = [language.output, *(language.answer if task.signals.input is not None else ())]
    on, off = ([line.format(level=level, signals=task.signals) for line in switching] for level in (True, False))
    statements: list[str] = []
    for number, stop in enumerate(stops):
        departing, arriving = (
            [line.format(text=text) for line in language.ask if text] for text in (stop.before, stop.there)
        )
        is_line, is_dwell = stop.move == Move.LINE, stop.move == Move.DWELL
        drive = language.line if is_line else language.move if stop.seconds > 0.0 else language.start
        values = {
            "seconds": stop.seconds,
            "speed": stop.speed,
            "mm_s": MM_S.of(stop.speed),
            "tool": TOOL if has_lines else "tool0",
        }
        statements += [f"{language.remark} row {number}: {stop.move}", *departing]
        statements += [language.settle, *on] if is_line else []
        statements.append(drive.format(joints=language.joints(stop.q), **values))
        statements += off if is_line else []
        statements += arriving
        statements += [language.settle, *on, language.dwell.format(dwell=task.dwell), *off] if is_dwell else []
    return "\n".join([*language.program(task, [language.indent + line for line in statements], has_lines), ""])


def _urscript(task: Task, statements: list[str], has_lines: bool) -> list[str]:
    tool = f"  set_tcp(p[{', '.join(f'{v:.6f}' for v in task.tool)}, 0, 0, 0])"
    begin = [f"  {URSCRIPT.output.format(level=False, signals=task.signals)}", *[tool] * any(task.tool)]
    return [f"def {identifier(task.name)}():", *begin, *statements, "end"]


def _rapid(task: Task, statements: list[str], has_lines: bool) -> list[str]:
    place = ",".join(f"{MM.of(v):.3f}" for v in task.tool)
    tool = [
        "  ! Set the tool's own mass [kg] and its centre before you drive.",
        f"  PERS tooldata {TOOL}:=[TRUE,[[{place}],[1,0,0,0]],[1,[0,0,50],[1,0,0,0],0,0,0]];",
    ]
    data = tool * has_lines + ["  VAR bool late;"] * (task.signals.input is not None)
    begin = ["  PROC main()", *["    ConfL \\Off;"] * has_lines, "    SetDO doTruearm, 0;"]
    return [f"MODULE {identifier(task.name)}", *data, *begin, *statements, "  ENDPROC", "ENDMODULE"]


URSCRIPT = Language(
    indent="  ",
    remark="#",
    joints=lambda q: f"[{', '.join(f'{v:.6f}' for v in q)}]",
    start=f"movej({{joints}}, a={SLOW}, v={SLOW})",
    move="movej({joints}, t={seconds:.3f})",
    line="movel({joints}, a=0.5, v={speed:.5f})",
    settle=f"sleep({SETTLE})",
    dwell="sleep({dwell:.3f})",
    ask=('popup("{text}", title="truearm", blocking=True)',),
    output="set_standard_digital_out({signals.output}, {level})",
    answer=(
        "waited = 0.0",
        f"while get_standard_digital_in({{signals.input}}) != {{level}} and waited < {TIMEOUT}:",
        "  sleep(0.008)",
        "  waited = waited + 0.008",
        "end",
    ),
    program=_urscript,
)
RAPID = Language(
    indent="    ",
    remark="!",
    joints=lambda q: f"[[{','.join(f'{v:.5f}' for v in DEG.of(q))}],[9E9,9E9,9E9,9E9,9E9,9E9]]",
    start="MoveAbsJ {joints} \\NoEOffs, v50, fine, {tool};",
    move="MoveAbsJ {joints} \\NoEOffs, v1000 \\T:={seconds:.3f}, fine, {tool};",
    line=f"MoveL CalcRobT({{joints}}, {TOOL}), [{{mm_s:.2f}},500,5000,1000], fine, {TOOL};",
    settle=f"WaitTime \\InPos, {SETTLE};",
    dwell="WaitTime {dwell:.3f};",
    ask=('TPWrite "{text}";', "Stop;"),
    output="SetDO doTruearm, {level:d};",
    answer=(f"WaitDI diTruearm, {{level:d}} \\MaxTime:={TIMEOUT} \\TimeFlag:=late;",),
    program=_rapid,
)


def table_text(stops: Sequence[Stop], task: Task) -> str:
    """Return every stop as a row of CSV, numbered as in the plan file.

    The columns are the action there or on the way, the operator's task, the seconds of the move (empty for a line) and
    of the dwell, the speed of a line, and the joints [rad]. No cell contains commas, quotes or line feeds.
    """
    titles = ["pose", "move", "before", "there", "move_s", "dwell_s", "speed_mm_s"]
    rows = [[*titles, *(f"q{i + 1}_rad" for i in range(len(stops[0].q)))]]
    for number, stop in enumerate(stops):
        is_line = stop.move == Move.LINE
        pace = ["" if is_line else f"{stop.seconds:.3f}", f"{task.dwell:g}" if stop.move == Move.DWELL else "0"]
        speed = f"{MM_S.of(stop.speed):g}" if is_line else ""
        rows.append([str(number), stop.move, stop.before, stop.there, *pace, speed, *map(repr, stop.q.tolist())])
    return "".join(",".join(cells) + "\n" for cells in rows)
