"""``truearm demo``: a calibrated robot from a simulated box, with one command.

Simulate → record → sync → identify → validate → one HTML page, each step through the real code: the firmware in MicroPython, the wire,
the session file, the clocks. What is found is judged by rows that were not fitted, and against the simulator's truth.
"""

from __future__ import annotations

import shlex
from enum import StrEnum
from functools import partial
from json import loads
from pathlib import Path
from typing import Annotated, assert_never

import typer

from truearm.bounds import REPEATABILITY, SEED, Within
from truearm.cli.command import command
from truearm.cli.options import branch_given
from truearm.cli.output import print_result
from truearm.cli.truth_options import DEFAULT_MODEL, DEFAULT_PERIODS, DEFAULT_STIFFNESS, truth_of
from truearm.text import counted
from truearm.units import MM

MARK = ".truearm-demo"  # marks a folder that the demo created and may overwrite
RATE_HZ = 500.0  # the robot stands still in a dwell; 1000 Hz takes ten seconds longer and gives the same


class Experiment(StrEnum):
    """What measures the simulated robot."""

    ballbar = "ballbar"
    line = "line"
    both = "both"


def what_is_planned(experiment: Experiment, poses: int) -> str:
    """What the robot visits, in words."""
    match experiment:
        case Experiment.ballbar:
            return f"{poses} poses on the shells of each bar"
        case Experiment.line:
            return "lines where the nominal robot is inaccurate"
        case Experiment.both:
            return f"{poses} poses with each bar, and lines"
        case _:
            assert_never(experiment)


@command()
def demo(
    context: typer.Context,
    *,
    out: Path = Path("out/demo"),
    poses: Annotated[int, Within(90, 5000)] = 800,
    seed: Annotated[int, SEED] = 1,
    rate: float = RATE_HZ,
    experiment: Experiment = Experiment.ballbar,
    model: str = DEFAULT_MODEL,
    base: str | None = None,
    tip: str | None = None,
    branch: str | None = None,
    worn: bool = False,
    tolerance: str | None = None,
    repeatability_mm: Annotated[float | None, REPEATABILITY, MM] = None,
    gear_error_mrad: Annotated[float, Within(0.0)] = 0.0,
    gear_periods_deg: str = DEFAULT_PERIODS,
    masses_kg: str | None = None,
    stiffness_nm_rad: Annotated[float, Within(1.0)] = DEFAULT_STIFFNESS,
    truth_out: Path | None = None,
    truth_seed: Annotated[int | None, SEED] = None,
    force: bool = False,
    json: bool = False,
) -> None:
    """Calibrate a simulated robot (default: the PUMA 560) with a ball-bar or a line device, from the firmware to the report.

    The box runs the real firmware in MicroPython, in virtual time. Without MicroPython the firmware runs in CPython, with
    a note.

    Example:
      truearm demo --out out/demo
      truearm demo --experiment line --out out/line
      truearm demo --model ur5e --poses 200 --out out/ur5e

    Options
    -------
    out : FOLDER
        Folder to write: session, tables, result and report.
    poses : N
        Dwells with each of two bars. Those of the first bar are fitted, those of the second are held out.
    experiment
        What measures the robot: the ball-bar, lines driven along a line device, or both.

    Expert options
    --------------
    force
        Overwrite the file of --truth-out if truearm wrote it. Files of the same command in the folder of --out are
        overwritten in any case.
    rate : HZ
        Samples per second of each channel.
    """
    from truearm.cli import demo_text
    from truearm.files.disk import check_writable, own_folder
    from truearm.files.robot_file import RobotChoice
    from truearm.workflows import demo_ball_bar, demo_lines
    from truearm.workflows.demo_steps import (
        Steps,
        clock_truth,
        observe,
        record_virtually,
        visits_in_words,
        write_setup,
    )
    from truearm.workflows.demo_steps import subject as robot_subject
    from truearm.workflows.record import nearest_osr
    from truearm.workflows.simulate import find_interpreter
    from truearm.workflows.simulated_robot import write_truth
    from truearm_sim import micropython
    from truearm_sim.simbox import SimulatedBox
    from truearm_sim.world import World, standard_plan

    say = partial(typer.echo, err=json)
    command_line = shlex.join(["truearm", *(context.obj or [])])
    osr = nearest_osr(rate)
    truth = truth_of(locals())
    subject = robot_subject(RobotChoice(model, base, tip), branch_given(branch), truth, seed)
    simulated, robot = subject.simulated, subject.robot
    if truth_out is not None:
        check_writable(truth_out, force, inputs=subject.choice.files, kind="truth")
    own_folder(out, MARK)
    interpreter = find_interpreter()
    if interpreter is None:
        say(f"MicroPython not found: the firmware runs in CPython instead ({micropython.BY_HAND}).")
    else:
        say(f"Firmware in {interpreter}")
    steps = Steps(say)
    with steps.step(f"plan {what_is_planned(experiment, poses)}"):
        match experiment:
            case Experiment.ballbar:
                plan = standard_plan(poses, seed, subject.rig, robot)
                world = World(seed, plan, subject.rig, simulated.params, arm=simulated.arm, robot=robot)
            case Experiment.line | Experiment.both:
                world = demo_lines.world_of(experiment is Experiment.both, poses, seed, subject)
            case _:
                assert_never(experiment)
        write_setup(out, world)
        if truth_out is not None:
            write_truth(truth_out, world, robot, truth, seed)
    plan = world.controller.plan
    box = SimulatedBox(world, interpreter, seed=seed)
    try:
        name = f"record {visits_in_words(plan)}, {counted(round(world.duration / 60), 'minute')} of robot time"
        with steps.step(name):
            record_virtually(out, plan, world, box, osr, seed)
        with steps.step("sync: clocks, dwells, observations"):
            result = observe(out, robot)
        clock = clock_truth(result, box)
    finally:
        box.close()
    match experiment:
        case Experiment.ballbar:
            with steps.step("identify, validate"):
                found = demo_ball_bar.calibrate(out, result.table, subject)
            with steps.step("report"):
                page = demo_ball_bar.write_page(out, found, result, clock, steps, command_line)
            found_lines, used = demo_text.ball_bar_lines(found), f"{len(result.table)} dwells used"
        case Experiment.line | Experiment.both:
            with steps.step("identify, validate"):
                lines = demo_lines.calibrate(experiment is Experiment.both, out, result.table, subject)
            with steps.step("report"):
                page = demo_lines.write_page(out, lines, result, clock, steps, command_line)
            found_lines, used = demo_text.line_lines(lines), demo_text.used(result.table)
        case _:
            assert_never(experiment)
    print_result(
        {"report": str(page), "result": loads((out / "result.json").read_bytes())},
        [*demo_text.recording_lines(result, clock, steps, used), *found_lines, f"\nreport          {page}"],
        json,
    )
