"""``truearm demo``: a calibrated robot from a simulated box, with one command.

Simulate → record → sync → identify → validate → one HTML page, each hop through the real thing: the firmware in MicroPython, the wire,
the session file, the clocks. What is found is judged by rows that were not fitted, and against the simulator's truth.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from truearm.cli.options import SeedOption
from truearm.units import MM
from truearm.workflows.demo_steps import (
    FITTED,
    VALIDATED,
    ClockTruth,
    Steps,
    clock_truth,
    observe,
    record_virtually,
    recording_facts,
    say_clock,
    say_samples,
    visits_in_words,
    write_setup,
)

if TYPE_CHECKING:
    from truearm.model.robot import Robot
    from truearm.session.pipeline import SyncResult
    from truearm.types import Estimate, Floats, ObservationTable, PredictedError, Rig

MARK = ".truearm-demo"  # in a folder that the demo made and may write again
RATE_HZ = 500.0  # the dwells stand still; a thousand takes ten seconds longer and finds the same


class DemoRig(StrEnum):
    """What measures the simulated robot."""

    ballbar = "ballbar"
    line = "line"
    both = "both"


WHAT = {
    DemoRig.ballbar: "{poses} poses on the shells of each bar",
    DemoRig.line: "lines where the design errs",
    DemoRig.both: "{poses} poses with each bar, and lines",
}


def demo(
    out: Annotated[Path, typer.Option(metavar="FOLDER", help="Where everything is written.")] = Path("out/demo"),
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
    from truearm.cli.simulate import find_interpreter
    from truearm.files.disk import own_folder
    from truearm.workflows import demo_lines
    from truearm.workflows.record import nearest_osr
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
    steps = Steps()
    with steps.step(f"plan {WHAT[rig].format(poses=poses)}"):
        if rig is DemoRig.ballbar:
            world = World(seed, standard_plan(poses, seed))
        else:
            world = demo_lines.world_of(rig.value, poses, seed)
        write_setup(out, world)
    plan = world.controller.plan
    box = SimulatedBox(world, interpreter, seed=seed)
    try:
        with steps.step(f"record {visits_in_words(plan)}, {world.duration / 60:.0f} minutes of robot time"):
            record_virtually(out, plan, world, box, osr, seed)
        with steps.step("sync: clocks, dwells, observations"):
            result = observe(out)
        truth = clock_truth(result, box)
    finally:
        box.close()
    if rig is not DemoRig.ballbar:
        with steps.step("identify, validate"):
            lines = demo_lines.calibrate(rig.value, out, result.table)
        with steps.step("report"):
            page = demo_lines.write_page(out, lines, result, truth, steps)
        demo_lines.say_result(lines, result, truth, steps, page)
        return
    with steps.step("identify, validate"):
        found = calibrate(out, result.table)
    with steps.step("report"):
        page = write_page(out, found, result, truth, steps)
    say_result(found, result, truth, steps, page)


@dataclass(frozen=True)
class Calibration:
    """The identified robot: the paper's 36 free parameters, and all 54 free, which shows the rank."""

    robot: Robot
    rig: Rig
    estimate: Estimate
    all_free: Estimate
    longitude: Floats  # (n,) rad, of the sphere about its chuck, identified robot
    predicted: PredictedError | None


def calibrate(out: Path, table: ObservationTable) -> Calibration:
    """Fit the 46 cm shells, judge by the 61 cm ones; writes result.json."""
    from truearm.estimate.identify import identify
    from truearm.estimate.prediction import predicted_point_error
    from truearm.files.result_file import RobotFrames, document_of, write_result
    from truearm.files.rig_file import read_rig
    from truearm.files.robot_file import RobotChoice, load_robot
    from truearm.workflows.calibration_report import longitudes
    from truearm.workflows.inputs import Sources, hashed_inputs

    robot, rig = load_robot("puma560"), read_rig(out / "rig.toml")
    chain, held_out = robot.chain, table.bar == VALIDATED
    estimate = identify(chain, rig, table, free=robot.free, hold_out=held_out)
    all_free = identify(chain, rig, table, hold_out=held_out)
    frames = RobotFrames(chain.name, chain.base_frame, chain.end_frame, chain.joint_units)
    inputs = hashed_inputs(Sources((out / "session.mcap",), {"": out / "rig.toml"}), RobotChoice("puma560"))
    predicted = predicted_point_error(chain, rig, table, estimate)
    document = document_of(estimate, table, frames, inputs, [f"bar={VALIDATED}"], "none", predicted)
    write_result(out / "result.json", document)
    return Calibration(robot, rig, estimate, all_free, longitudes(chain, rig, table, estimate), predicted)


def write_page(out: Path, found: Calibration, result: SyncResult, truth: ClockTruth, steps: Steps) -> Path:
    """report.html: pictures and tables, everything inline."""
    from truearm.report.calibration_page import CalibrationPage, render

    page = CalibrationPage(
        title="PUMA 560, ball-bar calibration",
        subtitle="simulated robot, real firmware, wire, recorder and estimator",
        estimate=found.estimate,
        table=result.table,
        longitude=found.longitude,
        facts=(
            ("dwells used", f"{len(result.table)} of {len(result.dwells)}"),
            *recording_facts(result, truth),
            ("rank with all 54 parameters free", f"{found.all_free.rank}"),
        ),
        steps=tuple(steps.done),
        command=f"truearm demo --out {out}",
        validation=found.estimate.held_out,
        predicted=found.predicted,
    )
    path = out / "report.html"
    path.write_text(render(page), encoding="utf-8")
    return path


def say_result(found: Calibration, result: SyncResult, truth: ClockTruth, steps: Steps, page: Path) -> None:
    """The demo's last words."""
    estimate = found.estimate
    n_free, n_fitted = int(estimate.free.sum()), int(estimate.fitted.sum())
    expected = MM.of(found.rig.bars[FITTED].sigma * (1.0 - estimate.rank / n_fitted) ** 0.5)
    say = typer.echo
    say_samples(result, steps, f"{len(result.table)} dwells used")
    say_clock(truth)
    say(
        f"parameters      rank {found.all_free.rank} of {len(estimate.free)}; {n_free} free, {estimate.status}",
        nl=False,
    )
    say(f" in {estimate.iterations} iterations")
    say(
        f"46 cm shells    {MM.text(estimate.rms_before['m'], '.3f')} RMS before, {MM.text(estimate.rms_after['m'], '.4f')} after",
        nl=False,
    )
    say(f" ({n_fitted} dwells; noise alone would leave {expected:.4f})")
    before, after = estimate.held_out_before, estimate.held_out
    if before is not None and after is not None:
        say(
            f"61 cm shells    {MM.text(before.figures['m'].rms, '.3f')} RMS before, {MM.text(after.figures['m'].rms, '.4f')} after",
            nl=False,
        )
        say(f" ({after.n} dwells that were not fitted)")
    say(f"\nreport          {page}")
