"""``truearm demo``: a calibrated robot from a simulated box, with one command.

Simulate → record → sync → identify → validate → one HTML page, each hop through the real thing: the firmware in MicroPython, the wire,
the session file, the clocks. What is found is judged by rows that were not fitted, and against the simulator's truth.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from truearm.commands.options import SeedOption
from truearm.errors import LinkError

if TYPE_CHECKING:
    from truearm.commands.page import Judged
    from truearm.model.robot import Robot
    from truearm.record.status import Status
    from truearm.sync.pipeline import SyncResult
    from truearm.types import Estimate, Floats, ObservationTable, Plan, Rig
    from truearm_sim.simbox import SimulatedBox
    from truearm_sim.world import World

MARK = ".truearm-demo"  # in a folder that the demo made and may write again
FITTED, VALIDATED = "bar46", "bar61"
RATE_HZ = 500.0  # the dwells stand still; a thousand takes ten seconds longer and finds the same


@dataclass(frozen=True)
class ClockTruth:
    """The clock fit against the simulator's truth: largest error and largest bound [ns], and whether all errors are within theirs."""

    error_ns: float
    bound_ns: float
    within: bool


class Steps:
    """Names and seconds of the steps, printed as they end."""

    def __init__(self) -> None:
        self.done: list[tuple[str, float]] = []

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        started = time.perf_counter()
        yield
        self.done.append((name, time.perf_counter() - started))
        typer.echo(f"{name:<42}{self.done[-1][1]:7.1f} s")

    @property
    def total_s(self) -> float:
        return sum(seconds for _, seconds in self.done)


def demo(
    out: Annotated[Path, typer.Option(metavar="FOLDER", help="Where everything is written.")] = Path("out/demo"),
    poses: Annotated[
        int, typer.Option(metavar="N", min=90, max=5000, help="Dwells with each bar: 46 cm to fit, 61 cm to validate.")
    ] = 800,
    seed: SeedOption = 1,
    rate: Annotated[float, typer.Option(metavar="HZ", help="Samples a second of each channel.")] = RATE_HZ,
) -> None:
    """Calibrate a simulated PUMA 560 with a ball-bar, from the firmware to the report.

    The box runs the real firmware in MicroPython (in CPython, and it says so, where there is none), in virtual time.

    \b
    Example:
      truearm demo --out out/demo
    """
    from truearm.commands.recording import nearest_osr
    from truearm.commands.simulate import find_interpreter
    from truearm.files.disk import own_folder
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
    with steps.step(f"plan {poses} poses on the shells of each bar"):
        plan = standard_plan(poses, seed)
        world = World(seed, plan)
        write_setup(out, plan, world)
    box = SimulatedBox(world, interpreter, seed=seed)
    try:
        with steps.step(f"record {len(plan)} dwells, {world.duration / 60:.0f} minutes of robot time"):
            record_virtually(out, plan, world, box, osr, seed)
        with steps.step("sync: clocks, dwells, observations"):
            result = observe(out)
        truth = clock_truth(result, box)
    finally:
        box.close()
    with steps.step("identify, validate"):
        found = calibrate(out, result.table)
    with steps.step("report"):
        page = write_page(out, found, result, truth, steps)
    say_result(found, result, truth, steps, page)


def write_setup(out: Path, plan: Plan, world: World) -> None:
    """plan.csv and rig.toml, as a person would have them."""
    from truearm.files.plan import write_plan
    from truearm.files.rig import write_rig

    write_plan(out / "plan.csv", plan)
    write_rig(out / "rig.toml", world.rig)


def record_virtually(out: Path, plan: Plan, world: World, box: SimulatedBox, osr: int, seed: int) -> None:
    """The recorder on the lab's links and clock: session.mcap."""
    from truearm.commands.interrupt import asked_to_stop
    from truearm.commands.recording import plan_rows
    from truearm.record.recorder import record
    from truearm.record.session_writer import SessionWriter
    from truearm_sim.lab import Lab

    lab = Lab(world, box, seed)
    writer = SessionWriter(out / "session.mcap", lab.clock, overwrite=True)
    # An exception in the middle of a grant would leave the box's process waiting for its other half.
    with asked_to_stop() as interrupted, _progress(world.duration) as progress:
        summary = record(
            lab.box_link,
            writer,
            lab.clock,
            robot=lab.robot_link,
            plan=plan_rows(plan),
            rig_toml=(out / "rig.toml").read_bytes(),
            osr=osr,
            interrupted=interrupted,
            progress=progress,
        )
    if summary.reason == "interrupted":
        raise KeyboardInterrupt
    if summary.reason != "robot closed":
        raise LinkError(f"the simulated recording ended early: {summary.reason}, {summary.text}")


def observe(out: Path) -> SyncResult:
    """The observations of session.mcap, also written as observations.csv."""
    from truearm.commands.session import observations_of_session
    from truearm.files.robot import joint_units, load_robot
    from truearm.files.table import write_table

    result = observations_of_session(out / "session.mcap")
    write_table(out / "observations.csv", result.table, joint_units(load_robot("puma560").chain))
    return result


def clock_truth(result: SyncResult, box: SimulatedBox) -> ClockTruth:
    """The device clock at a thousand times of the session against the simulator's truth."""
    import numpy as np

    from truearm_sim.lab import HOST_AT_START_NS

    (clock,) = result.survey.clocks.values()
    (report,) = result.clock_reports
    t_us = np.linspace(*report.device_us, 1000).astype(np.int64)
    host_ns, bound_ns = clock.to_host_ns(t_us)
    error_ns = host_ns - (HOST_AT_START_NS + 1e9 * box.true_s(t_us.astype(float)))
    return ClockTruth(float(np.abs(error_ns).max()), float(bound_ns.max()), bool(np.all(np.abs(error_ns) <= bound_ns)))


@dataclass(frozen=True)
class Calibration:
    """The identified robot: the paper's 36 free parameters, and all 54 free, which shows the rank."""

    robot: Robot
    rig: Rig
    estimate: Estimate
    all_free: Estimate
    longitude: Floats  # (n,) rad, of the sphere about its chuck, identified robot
    judged: Judged


def calibrate(out: Path, table: ObservationTable) -> Calibration:
    """Fit the 46 cm shells, judge by the 61 cm ones; writes result.json."""
    from truearm.commands.inputs import hashed_inputs
    from truearm.commands.page import judge, longitudes
    from truearm.estimate.identify import identify
    from truearm.files.result import RobotFrames, document_of, write_result
    from truearm.files.rig import read_rig
    from truearm.files.robot import joint_units, load_robot

    robot, rig = load_robot("puma560"), read_rig(out / "rig.toml")
    chain, held_out = robot.chain, table.bar == VALIDATED
    estimate = identify(chain, rig, table, free=robot.free, hold_out=held_out)
    all_free = identify(chain, rig, table, hold_out=held_out)
    frames = RobotFrames(chain.name, chain.base_frame, chain.end_frame, joint_units(chain))
    inputs = hashed_inputs([out / "session.mcap"], "puma560", out / "rig.toml")
    judged = judge(chain, rig, table, estimate)
    document = document_of(estimate, table, frames, inputs, [f"bar={VALIDATED}"], "none", *judged)
    write_result(out / "result.json", document)
    return Calibration(robot, rig, estimate, all_free, longitudes(chain, rig, table, estimate), judged)


def write_page(out: Path, found: Calibration, result: SyncResult, truth: ClockTruth, steps: Steps) -> Path:
    """report.html: pictures and tables, everything inline."""
    from truearm.report.page import CalibrationPage, render

    page = CalibrationPage(
        title="PUMA 560, ball-bar calibration",
        subtitle="simulated robot, real firmware, wire, recorder and estimator",
        estimate=found.estimate,
        table=result.table,
        longitude=found.longitude,
        facts=facts(found, result, truth),
        steps=tuple(steps.done),
        command=f"truearm demo --out {out}",
        validation=found.estimate.held_out,
        predicted=found.judged.predicted,
    )
    path = out / "report.html"
    path.write_text(render(page), encoding="utf-8")
    return path


def facts(found: Calibration, result: SyncResult, truth: ClockTruth) -> tuple[tuple[str, str], ...]:
    """What is to be known of the recording, as label and value."""
    losses, (clock,) = result.losses, result.clock_reports
    rejected = ", ".join(f"{n} {reason}" for reason, n in sorted(result.reasons.items())) or "none"
    return (
        ("dwells used", f"{len(result.table)} of {len(result.dwells)}"),
        ("dwells rejected", rejected),
        ("samples", f"{result.samples_seen:,} received, {result.samples_used:,} used"),
        ("samples lost", f"{losses.samples_lost + losses.samples_overrun}"),
        ("frames lost", f"{losses.frames_lost}"),
        ("clock exchanges", f"{clock.exchanges:,}"),
        ("box's crystal against the host", f"{clock.rate_ppm:+.3f} ppm"),
        ("clock error, reported bound", f"{truth.bound_ns / 1e3:.0f} µs"),
        ("clock error against the simulator's truth", f"{truth.error_ns / 1e3:.0f} µs at most"),
        ("rank with all 54 parameters free", f"{found.all_free.rank}"),
    )


def say_result(found: Calibration, result: SyncResult, truth: ClockTruth, steps: Steps, page: Path) -> None:
    """The demo's last words."""
    estimate, losses = found.estimate, result.losses
    lost = losses.samples_lost + losses.samples_overrun
    n_free, n_fitted = int(estimate.free.sum()), int(estimate.fitted.sum())
    expected = 1e3 * found.rig.bars[FITTED].sigma * (1.0 - estimate.rank / n_fitted) ** 0.5
    say = typer.echo
    say(f"\n{'total':<42}{steps.total_s:7.1f} s\n")
    say(f"samples         {result.samples_seen:,} recorded, {lost} lost; {len(result.table)} dwells used")
    say(
        f"clock           largest error {truth.error_ns / 1e3:.0f} µs against the simulator's truth, "
        f"{'within' if truth.within else 'OUTSIDE'} its reported bound ({truth.bound_ns / 1e3:.0f} µs at most)"
    )
    say(
        f"parameters      rank {found.all_free.rank} of {len(estimate.free)}; {n_free} free, {estimate.status}",
        nl=False,
    )
    say(f" in {estimate.iterations} iterations")
    say(
        f"46 cm shells    {1e3 * estimate.rms_before:.3f} mm RMS before, {1e3 * estimate.rms_after:.4f} mm after",
        nl=False,
    )
    say(f" ({n_fitted} dwells; noise alone would leave {expected:.4f})")
    before, after = estimate.held_out_before, estimate.held_out
    if before is not None and after is not None:
        say(f"61 cm shells    {1e3 * before.rms:.3f} mm RMS before, {1e3 * after.rms:.4f} mm after", nl=False)
        say(f" ({after.n} dwells that were not fitted)")
    say(f"\nreport          {page}")


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
