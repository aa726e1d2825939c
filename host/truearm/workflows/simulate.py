"""The work of ``truearm simulate``: a box and a robot in real time behind ports of this machine."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, assert_never

from truearm.errors import Argument, InputError, LinkError
from truearm.workflows.session_observations import Say

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


class Level(StrEnum):
    """What the simulated box runs in."""

    VM = "vm"
    CHIP = "chip"


class Hardware(NamedTuple):
    """What runs behind the box, and the longest step of its time [ns] (None: any)."""

    power_on: PowerOn
    longest_step_ns: int | None


@dataclass(frozen=True)
class SimulateOptions:
    """What is simulated, and where it listens.

    ``robot`` is one of ROBOTS, ``level`` a Level. ``plan`` and ``rig`` are files that stand in for ``poses`` with each bar, or
    for ``lines``. ``faults`` are written SECONDS:KIND. A port of 0 is any free one.
    """

    folder: Path
    port: int = 7007
    robot: str = "lines"
    robot_port: int | None = None
    pty: bool = False
    poses: int = 72
    lines: int = 0
    plan: Path | None = None
    rig: Path | None = None
    robot_delay_s: float = 0.0
    trigger: int | None = None
    worn: bool = False
    seed: int = 1
    level: str = "vm"
    faults: tuple[str, ...] = ()


def simulate_box_and_robot(options: SimulateOptions, say: Say) -> None:
    """Serve until the robot's program has ended and the recorder has gone; ``say`` gets a line at a time.

    Raises InputError, and LinkError where the ports cannot be had.
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

    folder, seed = options.folder, options.seed
    if options.robot not in ROBOTS:
        raise InputError(Argument("robot"), f" {options.robot!r} is not known; it is one of {', '.join(ROBOTS)}")
    scheme, usual_port, rate = ROBOTS[options.robot]
    faults = [parse_fault(text) for text in options.faults]
    plan, rig = visits(options)
    arm = WORN if options.worn else None
    world = World(
        seed,
        plan,
        rig,
        robot_rate=rate,
        arm=arm,
        robot_delay_s=options.robot_delay_s,
        robot_input=options.trigger,
    )
    own_folder(folder, MARK)
    of_box = hardware(options.level, say)
    write_plan(folder / "plan.csv", plan)
    write_rig(folder / "rig.toml", world.rig)
    box = SimulatedBox(world, power_on=of_box.power_on, faults=faults, seed=seed)
    try:
        box_port = Terminal() if options.pty else Port.listen("127.0.0.1", options.port)
        listener = Port.listen("127.0.0.1", usual_port if options.robot_port is None else options.robot_port)
    except OSError as exc:
        ports = Argument("port"), " and ", Argument("robot_port")
        raise LinkError(f"cannot listen: {exc.strerror}; choose other ports with ", *ports) from exc
    robot_end = RtdeServer(listener, rate) if options.robot == "rtde" else listener
    device = box_port.path if isinstance(box_port, Terminal) else f"socket://127.0.0.1:{box_port.number}"
    dwells, driven = int(plan.dwells.sum()), int(plan.lines.sum())
    what = " and ".join([f"{dwells} poses"] * (dwells > 0) + [f"{driven} drives along lines"] * (driven > 0))
    say(f"{what}, {world.duration / 60:.0f} minutes. Record them with\n")
    say(
        f"  truearm record --device {device} --robot {scheme}://127.0.0.1:{listener.number} "
        f"--plan {shlex.quote(str(folder / 'plan.csv'))} --rig {shlex.quote(str(folder / 'rig.toml'))} "
        f"--out {shlex.quote(str(folder / 'session.mcap'))}\n"
    )
    try:
        goes_on = "; its controller goes on, so end the recording with q" if options.robot == "rtde" else ""
        serve(
            world,
            box,
            box_port,
            robot_end,
            started=lambda: say("connected: time starts"),
            ended=lambda: say(f"the robot's program has ended{goes_on}"),
            longest_step_ns=of_box.longest_step_ns,
        )
    finally:
        box.close()
        box_port.close()
        robot_end.close()


def visits(options: SimulateOptions) -> tuple[Plan, Rig]:
    """What the robot visits and what stands around it: files where they are given, else drawn. Raises InputError."""
    from truearm.files.plan_file import read_plan
    from truearm.files.rig_file import read_rig
    from truearm_sim.line_plan import drawn_line_plan, line_rig
    from truearm_sim.world import standard_plan, standard_rig

    lines, plan_file, rig_file = options.lines, options.plan, options.rig
    rig = read_rig(rig_file) if rig_file is not None else line_rig() if lines else standard_rig()
    if plan_file is None:
        if rig_file is not None:
            raise InputError(Argument("rig_file"), " needs the ", Argument("plan"), " that was made for it")
        return drawn_line_plan(lines, options.seed) if lines else standard_plan(options.poses, options.seed), rig
    if lines:
        raise InputError(
            Argument("lines"), " draws lines and ", Argument("plan"), " reads what the robot visits: give one of them"
        )
    plan = read_plan(plan_file)
    if plan.q.shape[1] != N_JOINTS:
        raise InputError(f"{plan_file}: has {plan.q.shape[1]} joints, the simulated PUMA 560 has {N_JOINTS}")
    return plan, rig


def hardware(level: str, say: Say) -> Hardware:
    """What runs behind the box; says what it is. Raises InputError, and LinkError where the emulator is missing."""
    from truearm_sim import micropython, node
    from truearm_sim.chip import ChipBox
    from truearm_sim.vmbox import VmBox

    if level not in tuple(Level):
        raise InputError(Argument("level"), f" {level!r}: there are {' and '.join(Level)}")
    match wanted := Level(level):
        case Level.VM:
            interpreter = find_interpreter()
            say(f"firmware: {interpreter or 'CPython; no MicroPython was found (' + micropython.BY_HAND + ')'}")
            return Hardware(partial(VmBox, interpreter), None)
        case Level.CHIP:
            node.ready()
            say(f"firmware: {node.image()} in an emulated RP2040")
            return Hardware(ChipBox, CHIP_STEP_NS)
        case _:
            assert_never(wanted)


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
        raise InputError(
            Argument("fault"), f" {text!r}: write SECONDS:KIND, with KIND one of {', '.join(FAULTS)}"
        ) from None
