"""``truearm simulate``, ``truearm demo``: a box and any robot without hardware, and what truearm does with them."""

from __future__ import annotations

import queue
import sys
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from truearm.cli.command import Answer, command
from truearm.cli.options import command_line, sources_of
from truearm.cli.output import print_lines
from truearm.cli.project import ProjectCommand, typed
from truearm.errors import InputError
from truearm.workflows.requests import FAST_RATE_HZ, SimulateOptions

DEMO = SimulateOptions(Path("out/demo"), poses=90, rate=FAST_RATE_HZ)
FULL_POSES = 800


class SimulateCommand(ProjectCommand):
    """Takes the project's plan unless poses, lines, a robot or a stage are asked for, and its rig with a plan only."""

    def invoke(self, ctx: Any) -> Any:
        """Run the command."""
        is_own_arm = any(typed(ctx, name) is not None for name in ("poses", "lines", "model", "stage"))
        if is_own_arm:
            ctx.params["plan"] = typed(ctx, "plan")
        if is_own_arm or ctx.params.get("plan") is None:
            ctx.params["rig"] = typed(ctx, "rig")
        return super().invoke(ctx)


@command(cls=SimulateCommand, fast_rate=f"{FAST_RATE_HZ:.0f}")
def simulate(request: SimulateOptions, *, fast: bool = False, stage: bool = False) -> None:
    """Simulate a sensor box and a robot, to rehearse a session on your own arm.

    The true robot differs from the nominal one by random errors, which are drawn from tolerances and hidden
    (--truth-out writes them). The simulation runs in real time behind local ports, or with --fast in virtual time
    straight into a session file. The box runs the real firmware in MicroPython (without it in CPython, with a note), or
    with --level chip in an emulated RP2040, which may be slower than real time. Time starts with the first connection.
    The simulation ends when the robot's program has ended and the recorder has disconnected, or with Ctrl-C.

    Example:
      truearm simulate     (and in another terminal the truearm record line that it prints)
      truearm simulate --model ur5e --plan plan.csv --rig rig.toml --fast --out rehearsal

    Options
    -------
    out : FOLDER
        Folder to write: plan.csv and rig.toml, with --fast session.mcap.
    fast
        Record in virtual time, directly into session.mcap. This takes seconds instead of minutes.
    poses : N
        Poses with each of the two bars.
    lines : N
        Number of lines along a line device, driven there and back. 0: use a ball-bar instead.
    rig : FILE
        The rig of --plan (.toml). Default: the simulator's own.
    fault : SECONDS:KIND
        Fault to simulate, such as 20:reboot (repeatable). KIND: short-write (of a frame), flip (a bit), lose or double
        (a data frame), text (between frames), stall (for 0.2 s), crash, reboot (power lost), hang (until the watchdog
        acts), bad-crc or converter-reset (of the converter), no-stop (no pulses of the magnetostrictive head).

    Expert options
    --------------
    rate : HZ
        With --fast: samples per second of each channel. Default: {fast_rate}.
    port : PORT
        TCP port of the box; 0 takes a free one.
    protocol
        Protocol of the robot: lines (JSON) or rtde (Universal Robots).
    robot_port : PORT
        TCP port of the robot; 0 takes a free one. Default: 7008, or 30004 with --protocol rtde.
    pty
        Put the box behind a pseudo-terminal, like a serial device.
    robot_delay_ms : MS
        Delay of the robot's joint readings.
    trigger : INPUT
        Digital input of the robot that the box's trigger output toggles.
    warming : K
        Warm up the laboratory, with bar and sensor, by this many kelvin; both have thermometers.
    force
        Overwrite the file of --truth-out if truearm wrote it. Files of the same command in the folder of --out are
        overwritten in any case.
    level
        vm: the firmware in MicroPython; chip: its image in an RP2040 emulator.
    stage
        Simulate the sensors without a robot, to rehearse truearm box gauge: they follow a reference position that you
        type in mm.
    """
    from truearm.workflows.simulate import simulate_box_and_robot, simulate_fast, simulate_stage

    if request.rate is not None and not fast:
        raise InputError("needs-option", place="--rate", needed="--fast")
    if stage and fast:
        raise InputError("--stage waits for what you type, in real time: leave out --fast")

    def say(line: str) -> None:
        print_lines([line])

    if stage:
        simulate_stage(request, say, _typed_lines())
    elif fast:
        simulate_fast(request, say)
    else:
        simulate_box_and_robot(request, say)


def _typed_lines() -> Callable[[], list[str]]:
    """Return a function that returns the lines typed since its last call."""
    lines: queue.SimpleQueue[str] = queue.SimpleQueue()

    def read() -> None:
        for line in sys.stdin:
            lines.put(line)

    threading.Thread(target=read, daemon=True).start()
    return lambda: [lines.get() for _ in range(lines.qsize())]


@command()
def demo(
    context: click.Context,
    request: SimulateOptions = DEMO,
    *,
    full: bool = False,
    open: bool = False,
    json: bool = False,
) -> Answer:
    """Calibrate a simulated robot (default: the PUMA 560) with a ball-bar or a line device, from the firmware to the
    report.

    Does what truearm simulate --fast and truearm identify do. The last bar and the last line are held out: their rows
    are not fitted, so they show how accurate the calibrated robot is.

    Example:
      truearm demo --out out/demo
      truearm demo --lines 5 --out out/line
      truearm demo --model ur5e --poses 200 --out out/ur5e

    Options
    -------
    out : FOLDER
        Folder to write: session, plan, rig, observations, result and report.
    poses : N
        Poses with each of the two bars.
    lines : N
        Number of lines along a line device, driven there and back. 0: use a ball-bar instead.
    full
        800 poses with each bar: 73 minutes of the robot's time.
    open
        Open the report in the browser.

    Expert options
    --------------
    plan : FILE
        Plan: what the robot visits (.csv).
    rig : FILE
        The rig of --plan (.toml). Default: the simulator's own.
    force
        Overwrite the file of --truth-out if truearm wrote it. Files of the same command in the folder of --out are
        overwritten in any case.
    rate : HZ
        Samples per second of each channel.
    """
    from truearm.finding_texts import Severity
    from truearm.plan.plan_file import read_plan
    from truearm.workflows.identify import DEFAULTS, IdentifyFiles, identify_files
    from truearm.workflows.selection import last_of_each
    from truearm.workflows.simulate import SESSION, simulate_fast

    request = replace(request, poses=FULL_POSES) if full else request
    simulate_fast(request, lambda text: print(text, file=sys.stderr if json else None, flush=True))
    folder = request.out
    table, page = folder / "observations.csv", folder / "report.html"
    sources = sources_of((folder / SESSION,))
    files = IdentifyFiles(
        request.robot, sources, (folder / "result.json",), table, page, command_line(context), force=True
    )
    identification = identify_files(files, last_of_each(read_plan(folder / "plan.csv")), DEFAULTS)
    answers = [
        finding
        for finding in identification.findings
        if finding.code == "simulated" or (finding.severity is Severity.RESULT and finding.code != "identified")
    ]
    if open:
        click.launch(str(page))
    return Answer(
        {"report": str(page), "result": identification.document}, findings=answers, written=[page], details_hint=""
    )
