"""``truearm simulate``: a box and a robot in real time behind ports of this machine, to try everything without hardware."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from truearm.cli.options import PlanOption, SeedOption, out_folder
from truearm.units import MS


def simulate(
    out: Annotated[Path, out_folder("plan.csv and rig.toml")] = Path("out/simulated"),
    port: Annotated[
        int, typer.Option(metavar="PORT", min=0, max=65535, help="TCP port of the box; 0 takes a free one.")
    ] = 7007,
    robot: Annotated[
        str, typer.Option(metavar="KIND", help="What the robot speaks: lines (JSON) or rtde (Universal Robots).")
    ] = "lines",
    robot_port: Annotated[
        int | None,
        typer.Option(
            metavar="PORT", min=0, max=65535, help="TCP port of the robot, 7008 or 30004; 0 takes a free one."
        ),
    ] = None,
    pty: Annotated[bool, typer.Option("--pty", help="The box behind a pseudo-terminal, as a serial device.")] = False,
    poses: Annotated[int, typer.Option(metavar="N", min=9, max=5000, help="Poses with each of the two bars.")] = 72,
    lines: Annotated[
        int,
        typer.Option(
            metavar="N", min=0, max=50, help="Lines past a line device, there and back; 0: a ball-bar instead."
        ),
    ] = 0,
    plan: PlanOption = None,
    rig_file: Annotated[
        Path | None, typer.Option(metavar="FILE", help="The rig of --plan (.toml); default: the simulator's own.")
    ] = None,
    robot_delay_ms: Annotated[
        float, typer.Option(min=0.0, max=1000.0, metavar="MS", help="How late the robot's readings are.")
    ] = 0.0,
    trigger: Annotated[
        int | None,
        typer.Option(
            min=0, max=15, metavar="INPUT", help="The robot's digital input that the box's trigger output toggles."
        ),
    ] = None,
    worn: Annotated[
        bool, typer.Option("--worn", help="An arm with backlash, slow to settle, that swings, with noisy readings.")
    ] = False,
    seed: SeedOption = 1,
    level: Annotated[
        str,
        typer.Option(metavar="LEVEL", help="vm: the firmware in MicroPython; chip: its image in an RP2040 emulator."),
    ] = "vm",
    fault: Annotated[
        list[str] | None,
        typer.Option(metavar="SECONDS:KIND", help="Something that goes wrong; repeatable. An unknown KIND lists them."),
    ] = None,
) -> None:
    """Simulate a sensor box and a robot in real time, on this machine's loopback.

    The firmware's own files run in a real MicroPython (in CPython, and it says so, where there is none), or with --level chip in an
    emulated RP2040, whose time may fall behind the wall clock's on a slow machine. Time starts with the first connection. Ends when the
    robot's program has ended and the recorder has gone, or with Ctrl-C.

    Example: truearm simulate, and in another terminal the truearm record line that it prints. With a plan of your own:
    truearm simulate --plan plan.csv --rig-file rig.toml
    """
    from truearm.workflows.simulate import SimulateOptions, simulate_box_and_robot

    options = SimulateOptions(
        folder=out,
        port=port,
        robot=robot,
        robot_port=robot_port,
        pty=pty,
        poses=poses,
        lines=lines,
        plan=plan,
        rig=rig_file,
        robot_delay_s=MS.to_si(robot_delay_ms),
        trigger=trigger,
        worn=worn,
        seed=seed,
        level=level,
        faults=tuple(fault or ()),
    )
    simulate_box_and_robot(options, typer.echo)
