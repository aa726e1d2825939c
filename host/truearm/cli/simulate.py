"""``truearm simulate``: a box and a robot in real time behind ports of this machine, to try everything without hardware."""

from __future__ import annotations

import shlex
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from truearm.cli.options import SeedOption
from truearm.errors import InputError, LinkError
from truearm.units import MS

CHIP_STEP_NS = 20_000_000  # an emulated chip may be slower than the wall clock
N_JOINTS = 6
MARK = ".truearm-simulated"  # in a folder that simulate made and may write again

# what the robot may speak: scheme of its address, usual port, readings a second
ROBOTS = {"lines": ("tcp", 7008, 50.0), "rtde": ("rtde", 30004, 500.0)}

if TYPE_CHECKING:
    from truearm.types import Plan, Rig
    from truearm_sim.hardware import PowerOn
    from truearm_sim.micropython import Interpreter
    from truearm_sim.simbox import Fault


def simulate(
    folder: Annotated[
        Path, typer.Option("--out", metavar="FOLDER", help="Where plan.csv and rig.toml are written.")
    ] = Path("out/simulated"),
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
    plan_file: Annotated[
        Path | None, typer.Option("--plan", metavar="FILE", help="What the robot visits instead (.csv).")
    ] = None,
    rig_file: Annotated[
        Path | None,
        typer.Option("--rig-file", metavar="FILE", help="The rig of that plan (.toml); default: the simulator's own."),
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
    from truearm.files.disk import own_folder
    from truearm.files.plan_file import write_plan
    from truearm.files.rig_file import write_rig
    from truearm_sim.arm import WORN
    from truearm_sim.ports import Port, Terminal
    from truearm_sim.rtde_server import RtdeServer
    from truearm_sim.serve import serve
    from truearm_sim.simbox import SimulatedBox
    from truearm_sim.world import World

    if robot not in ROBOTS:
        raise InputError(f"--robot {robot!r} is not known; it is one of {', '.join(ROBOTS)}")
    scheme, usual_port, rate = ROBOTS[robot]
    faults = [parse_fault(text) for text in fault or []]
    plan, rig = visits(poses, lines, seed, plan_file, rig_file)
    arm = WORN if worn else None
    world = World(
        seed, plan, rig, robot_rate=rate, arm=arm, robot_delay_s=MS.to_si(robot_delay_ms), robot_input=trigger
    )
    own_folder(folder, MARK)
    power_on = hardware(level)
    write_plan(folder / "plan.csv", plan)
    write_rig(folder / "rig.toml", world.rig)
    box = SimulatedBox(world, power_on=power_on, faults=faults, seed=seed)
    try:
        box_port = Terminal() if pty else Port.listen("127.0.0.1", port)
        listener = Port.listen("127.0.0.1", usual_port if robot_port is None else robot_port)
    except OSError as exc:
        raise LinkError(f"cannot listen: {exc.strerror}; choose other ports with --port and --robot-port") from exc
    robot_end = RtdeServer(listener, rate) if robot == "rtde" else listener
    device = box_port.path if isinstance(box_port, Terminal) else f"socket://127.0.0.1:{box_port.number}"
    dwells, driven = int(plan.dwells.sum()), int(plan.lines.sum())
    what = " and ".join([f"{dwells} poses"] * (dwells > 0) + [f"{driven} drives along lines"] * (driven > 0))
    typer.echo(f"{what}, {world.duration / 60:.0f} minutes. Record them with\n")
    typer.echo(
        f"  truearm record --device {device} --robot {scheme}://127.0.0.1:{listener.number} "
        f"--plan {shlex.quote(str(folder / 'plan.csv'))} --rig {shlex.quote(str(folder / 'rig.toml'))} "
        f"--out {shlex.quote(str(folder / 'session.mcap'))}\n"
    )
    try:
        slow = CHIP_STEP_NS if level == "chip" else None
        goes_on = "; its controller goes on, so end the recording with q" if robot == "rtde" else ""
        serve(
            world,
            box,
            box_port,
            robot_end,
            started=lambda: typer.echo("connected: time starts"),
            ended=lambda: typer.echo(f"the robot's program has ended{goes_on}"),
            longest_step_ns=slow,
        )
    finally:
        box.close()
        box_port.close()
        robot_end.close()


def visits(poses: int, lines: int, seed: int, plan_file: Path | None, rig_file: Path | None) -> tuple[Plan, Rig]:
    """What the robot visits and what stands around it: files where they are given, else drawn. Raises InputError."""
    from truearm.files.plan_file import read_plan
    from truearm.files.rig_file import read_rig
    from truearm_sim.line_plan import drawn_line_plan, line_rig
    from truearm_sim.world import standard_plan, standard_rig

    rig = read_rig(rig_file) if rig_file is not None else line_rig() if lines else standard_rig()
    if plan_file is None:
        if rig_file is not None:
            raise InputError("--rig-file needs the --plan that was made for it")
        return drawn_line_plan(lines, seed) if lines else standard_plan(poses, seed), rig
    if lines:
        raise InputError("--lines draws lines and --plan reads what the robot visits: give one of them")
    plan = read_plan(plan_file)
    if plan.q.shape[1] != N_JOINTS:
        raise InputError(f"{plan_file}: has {plan.q.shape[1]} joints, the simulated PUMA 560 has {N_JOINTS}")
    return plan, rig


def hardware(level: str) -> PowerOn:
    """What runs behind the box; says on the terminal what it is. Raises InputError, and LinkError where the emulator is missing."""
    from truearm_sim import micropython, node
    from truearm_sim.chip import ChipBox
    from truearm_sim.vmbox import VmBox

    if level == "vm":
        interpreter = find_interpreter()
        typer.echo(f"firmware: {interpreter or 'CPython; no MicroPython was found (' + micropython.BY_HAND + ')'}")
        return partial(VmBox, interpreter)
    if level != "chip":
        raise InputError(f"--level {level!r}: there are vm and chip")
    node.ready()
    typer.echo(f"firmware: {node.image()} in an emulated RP2040")
    return ChipBox


def find_interpreter() -> Interpreter | None:
    """The MicroPython to run the firmware in. Raises InputError if the one that was named cannot be used."""
    from truearm_sim import micropython

    try:
        return micropython.find()
    except micropython.InterpreterError as exc:
        raise InputError(str(exc)) from exc


def parse_fault(text: str) -> Fault:
    """A fault written SECONDS:KIND. Raises InputError."""
    from truearm_sim.simbox import FAULTS, Fault

    seconds, _, kind = text.partition(":")
    try:
        return Fault(float(seconds), kind)
    except ValueError:
        raise InputError(f"--fault {text!r}: write SECONDS:KIND, with KIND one of {', '.join(FAULTS)}") from None
