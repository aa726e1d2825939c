"""``truearm demo``: a calibrated robot from a simulated box, with one command.

Simulate → record → sync → identify → validate → one HTML page, each hop through the real thing: the firmware in MicroPython, the wire,
the session file, the clocks. What is found is judged by rows that were not fitted, and against the simulator's truth.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, assert_never

import typer

from truearm.cli.options import SeedOption, out_folder
from truearm.cli.output import print_lines
from truearm.workflows.demo_steps import Steps, clock_truth, observe, record_virtually, visits_in_words, write_setup

if TYPE_CHECKING:
    from truearm.record.status import Status

MARK = ".truearm-demo"  # in a folder that the demo made and may write again
RATE_HZ = 500.0  # the dwells stand still; a thousand takes ten seconds longer and finds the same


class DemoRig(StrEnum):
    """What measures the simulated robot."""

    ballbar = "ballbar"
    line = "line"
    both = "both"


def what_is_planned(rig: DemoRig, poses: int) -> str:
    """What the robot visits, in words."""
    match rig:
        case DemoRig.ballbar:
            return f"{poses} poses on the shells of each bar"
        case DemoRig.line:
            return "lines where the design errs"
        case DemoRig.both:
            return f"{poses} poses with each bar, and lines"
        case _:
            assert_never(rig)


def demo(
    out: Annotated[Path, out_folder("session, tables, result and report")] = Path("out/demo"),
    poses: Annotated[
        int, typer.Option(metavar="N", min=90, max=5000, help="Dwells with each bar: 46 cm to fit, 61 cm to validate.")
    ] = 800,
    seed: SeedOption = 1,
    rate: Annotated[float, typer.Option(metavar="HZ", help="Samples a second of each channel.")] = RATE_HZ,
    rig: Annotated[
        DemoRig, typer.Option(help="What measures: the ball-bar, lines driven along a line device, or both at once.")
    ] = DemoRig.ballbar,
) -> None:
    """Calibrate a simulated PUMA 560 with a ball-bar or a line device, from the firmware to the report.

    The box runs the real firmware in MicroPython (in CPython, and it says so, where there is none), in virtual time.

    \b
    Example:
      truearm demo --out out/demo
      truearm demo --rig line --out out/line
    """
    from truearm.cli import demo_text
    from truearm.files.disk import own_folder
    from truearm.workflows import demo_ball_bar, demo_lines
    from truearm.workflows.record import nearest_osr
    from truearm.workflows.simulate import find_interpreter
    from truearm_sim import micropython
    from truearm_sim.simbox import SimulatedBox
    from truearm_sim.world import World, standard_plan

    osr = nearest_osr(rate)
    own_folder(out, MARK)
    interpreter = find_interpreter()
    if interpreter is None:
        typer.echo(f"No MicroPython here: the firmware runs in CPython instead ({micropython.BY_HAND}).")
    else:
        typer.echo(f"Firmware in {interpreter}")
    steps = Steps(typer.echo)
    with steps.step(f"plan {what_is_planned(rig, poses)}"):
        match rig:
            case DemoRig.ballbar:
                world = World(seed, standard_plan(poses, seed))
            case DemoRig.line | DemoRig.both:
                world = demo_lines.world_of(rig is DemoRig.both, poses, seed)
            case _:
                assert_never(rig)
        write_setup(out, world)
    plan = world.controller.plan
    box = SimulatedBox(world, interpreter, seed=seed)
    try:
        name = f"record {visits_in_words(plan)}, {world.duration / 60:.0f} minutes of robot time"
        with steps.step(name), _progress(world.duration) as progress:
            record_virtually(out, plan, world, box, osr, seed, progress)
        with steps.step("sync: clocks, dwells, observations"):
            result = observe(out)
        truth = clock_truth(result, box)
    finally:
        box.close()
    match rig:
        case DemoRig.ballbar:
            with steps.step("identify, validate"):
                found = demo_ball_bar.calibrate(out, result.table)
            with steps.step("report"):
                page = demo_ball_bar.write_page(out, found, result, truth, steps)
            found_lines, used = demo_text.ball_bar_lines(found), f"{len(result.table)} dwells used"
        case DemoRig.line | DemoRig.both:
            with steps.step("identify, validate"):
                lines = demo_lines.calibrate(rig is DemoRig.both, out, result.table)
            with steps.step("report"):
                page = demo_lines.write_page(out, lines, result, truth, steps)
            found_lines, used = demo_text.line_lines(lines), demo_text.used(result.table)
        case _:
            assert_never(rig)
    print_lines([*demo_text.recording_lines(result, truth, steps, used), *found_lines, f"\nreport          {page}"])


@contextmanager
def _progress(duration_s: float) -> Iterator[Callable[[Status], None] | None]:
    """A bar on a terminal; nothing elsewhere."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as display:
        task = display.add_task("recording", total=duration_s)
        yield lambda status: display.update(task, completed=status.elapsed_s)
