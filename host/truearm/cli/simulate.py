"""``truearm simulate``: simulate a box and any robot, in real time behind local ports or in virtual time into a session file."""

from __future__ import annotations

import queue
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from truearm.cli.options import (
    BaseOption,
    BranchOption,
    PlanOption,
    SeedOption,
    TipOption,
    branch_given,
    out_folder,
)
from truearm.cli.project import ProjectCommand, typed
from truearm.cli.truth_options import (
    DEFAULT_MODEL,
    DEFAULT_PERIODS,
    DEFAULT_STIFFNESS,
    GearErrorOption,
    GearPeriodsOption,
    MassesOption,
    ModelOption,
    RepeatabilityOption,
    StiffnessOption,
    ToleranceOption,
    TruthForceOption,
    TruthOutOption,
    TruthSeedOption,
    WornOption,
    truth_of,
)
from truearm.errors import InputError
from truearm.units import MS

FAST_RATE_HZ = 500.0


class SimulateCommand(ProjectCommand):
    """Takes the project's plan unless poses, lines, a robot or a stage are asked for, and its rig with a plan only."""

    def invoke(self, ctx: Any) -> Any:
        """Run the command."""
        other = any(typed(ctx, name) is not None for name in ("poses", "lines", "model", "stage"))
        if other:
            ctx.params["plan"] = typed(ctx, "plan")
        if other or ctx.params.get("plan") is None:
            ctx.params["rig"] = typed(ctx, "rig")
        return super().invoke(ctx)


def simulate(
    out: Annotated[Path, out_folder("plan.csv and rig.toml, with --fast session.mcap")] = Path("out/simulated"),
    model: ModelOption = DEFAULT_MODEL,
    base: BaseOption = None,
    tip: TipOption = None,
    branch: BranchOption = None,
    fast: Annotated[
        bool,
        typer.Option(
            "--fast", help="Record in virtual time, directly into session.mcap. This takes seconds instead of minutes."
        ),
    ] = False,
    rate: Annotated[
        float | None,
        typer.Option(
            metavar="HZ", help=f"With --fast: samples per second of each channel. Default: {FAST_RATE_HZ:.0f}."
        ),
    ] = None,
    port: Annotated[
        int, typer.Option(metavar="PORT", min=0, max=65535, help="TCP port of the box; 0 takes a free one.")
    ] = 7007,
    protocol: Annotated[
        str, typer.Option(metavar="KIND", help="Protocol of the robot: lines (JSON) or rtde (Universal Robots).")
    ] = "lines",
    robot_port: Annotated[
        int | None,
        typer.Option(
            metavar="PORT",
            min=0,
            max=65535,
            help="TCP port of the robot; 0 takes a free one. Default: 7008, or 30004 with --protocol rtde.",
        ),
    ] = None,
    pty: Annotated[
        bool, typer.Option("--pty", help="Put the box behind a pseudo-terminal, like a serial device.")
    ] = False,
    poses: Annotated[int, typer.Option(metavar="N", min=9, max=5000, help="Poses with each of the two bars.")] = 72,
    lines: Annotated[
        int,
        typer.Option(
            metavar="N",
            min=0,
            max=50,
            help="Number of lines along a line device, driven there and back. 0: use a ball-bar instead.",
        ),
    ] = 0,
    plan: PlanOption = None,
    rig: Annotated[
        Path | None, typer.Option(metavar="FILE", help="The rig of --plan (.toml). Default: the simulator's own.")
    ] = None,
    robot_delay_ms: Annotated[
        float, typer.Option(min=0.0, max=1000.0, metavar="MS", help="Delay of the robot's joint readings.")
    ] = 0.0,
    trigger: Annotated[
        int | None,
        typer.Option(
            min=0, max=15, metavar="INPUT", help="Digital input of the robot that the box's trigger output toggles."
        ),
    ] = None,
    warming: Annotated[
        float | None,
        typer.Option(
            metavar="K",
            min=-20.0,
            max=20.0,
            help="Warm up the laboratory, with bar and sensor, by this many kelvin; both have thermometers.",
        ),
    ] = None,
    worn: WornOption = False,
    tolerance: ToleranceOption = None,
    repeatability: RepeatabilityOption = None,
    gear_error: GearErrorOption = 0.0,
    gear_periods: GearPeriodsOption = DEFAULT_PERIODS,
    masses: MassesOption = None,
    stiffness: StiffnessOption = DEFAULT_STIFFNESS,
    truth_out: TruthOutOption = None,
    truth_seed: TruthSeedOption = None,
    force: TruthForceOption = False,
    seed: SeedOption = 1,
    level: Annotated[
        str,
        typer.Option(metavar="LEVEL", help="vm: the firmware in MicroPython; chip: its image in an RP2040 emulator."),
    ] = "vm",
    stage: Annotated[
        bool,
        typer.Option(
            "--stage",
            help="Simulate the sensors without a robot, to rehearse truearm box gauge: they follow a reference position that you type in mm.",
        ),
    ] = False,
    fault: Annotated[
        list[str] | None,
        typer.Option(
            metavar="SECONDS:KIND",
            help="Fault to simulate, such as 20:reboot (repeatable). KIND: short-write (of a frame), flip (a bit), lose or double (a "
            "data frame), text (between frames), stall (for 0.2 s), crash, reboot (power lost), hang (until the watchdog acts), bad-crc or "
            "converter-reset (of the converter), no-stop (no pulses of the magnetostrictive head).",
        ),
    ] = None,
) -> None:
    """Simulate a sensor box and a robot, to rehearse a session on your own arm.

    The true robot differs from the nominal one by random errors, which are drawn from tolerances and hidden (--truth-out writes them). The
    simulation runs in real time behind local ports, or with --fast in virtual time straight into a session file. The box runs the
    real firmware in MicroPython (without it in CPython, with a note), or with --level chip in an emulated RP2040, which
    may be slower than real time. Time starts with the first connection. The simulation ends when the robot's program has ended and
    the recorder has disconnected, or with Ctrl-C.

    \b
    Example:
      truearm simulate     (and in another terminal the truearm record line that it prints)
      truearm simulate --model ur5e --plan plan.csv --rig rig.toml --fast --out rehearsal
    """
    from truearm.files.robot_file import RobotChoice
    from truearm.workflows.record import nearest_osr
    from truearm.workflows.simulate import (
        SimulateOptions,
        simulate_box_and_robot,
        simulate_fast,
        simulate_stage,
    )

    options = SimulateOptions(
        folder=out,
        model=RobotChoice(model, base, tip),
        branch=branch_given(branch),
        truth=truth_of(tolerance, gear_error, gear_periods, masses, stiffness, repeatability, worn, truth_seed),
        truth_out=truth_out,
        force=force,
        osr=nearest_osr(FAST_RATE_HZ if rate is None else rate),
        port=port,
        protocol=protocol,
        robot_port=robot_port,
        pty=pty,
        poses=poses,
        lines=lines,
        plan=plan,
        rig=rig,
        robot_delay_s=MS.to_si(robot_delay_ms),
        trigger=trigger,
        warming=warming,
        seed=seed,
        level=level,
        faults=tuple(fault or ()),
    )
    if rate is not None and not fast:
        raise InputError(
            "--rate has no effect without --fast: in real time, truearm record --rate sets it; leave it out"
        )
    if stage and fast:
        raise InputError("--stage waits for what you type, in real time: leave out --fast")
    if stage:
        simulate_stage(options, typer.echo, _typed_lines())
    elif fast:
        simulate_fast(options, typer.echo)
    else:
        simulate_box_and_robot(options, typer.echo)


def _typed_lines() -> Callable[[], list[str]]:
    """Return a function that returns the lines typed since its last call."""
    lines: queue.SimpleQueue[str] = queue.SimpleQueue()

    def read() -> None:
        for line in sys.stdin:
            lines.put(line)

    threading.Thread(target=read, daemon=True).start()
    return lambda: [lines.get() for _ in range(lines.qsize())]
