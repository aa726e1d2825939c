"""Simulate a box and a robot, in real time on ports of this machine or in virtual time into a session file."""

from __future__ import annotations

import json
import shlex
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from truearm.box.condition import LVDT_DRIFT
from truearm.disk import check_writable, own_folder, write_atomic
from truearm.errors import Argument, IncompleteError, InputError, LinkError, PlanError
from truearm.kinds.rig_file import read_rig, write_rig
from truearm.model.robot import Branch, Robot
from truearm.model.robot_file import RobotChoice
from truearm.plan.branches import branch_of
from truearm.plan.plan_file import check_against_rig, check_robot, read_plan, write_plan
from truearm.progress import asked_to_stop, step
from truearm.record.recorder import RecordOptions, record
from truearm.record.session_writer import SessionWriter
from truearm.text import counted
from truearm.types import Floats, Plan, Rig
from truearm.units import MM
from truearm.workflows.record import nearest_osr, plan_rows
from truearm.workflows.recorded_session import SETUP
from truearm.workflows.requests import FAST_RATE_HZ, SimulateOptions, TruthOptions
from truearm_sim import micropython, node
from truearm_sim.arm import WORN, Arm
from truearm_sim.chip import ChipBox
from truearm_sim.confirming import Confirming
from truearm_sim.hardware import PowerOn
from truearm_sim.joint_errors import GearError, JointError, Sag
from truearm_sim.lab import STEP_NS, Lab
from truearm_sim.line_plan import drawn_line_plan, line_rig
from truearm_sim.ports import Port, Terminal
from truearm_sim.rtde_server import RtdeServer
from truearm_sim.serve import EMULATED, Pace, serve
from truearm_sim.simbox import FAULTS, Fault, SimulatedBox
from truearm_sim.stage import LARGEST, Stage
from truearm_sim.thermal import Thermal
from truearm_sim.true_robot import Tolerance, true_params
from truearm_sim.vmbox import VmBox
from truearm_sim.world import RobotInput, Setup, World, standard_plan, standard_rig

CHIP_STEP_NS = 20_000_000
DELAYED = (
    "the emulated chip is slower than real time on this computer, so the simulated time falls behind: this recording is no "
    "measure of the box's clock. For that, simulate in virtual time (option fast)"
)
RTDE_JOINTS = 6
SESSION = "session.mcap"
MARK = ".truearm-simulated"  # in a folder that simulate created and may overwrite

# protocols of the robot: scheme of the address, default port, readings per second
PROTOCOLS = {"lines": ("tcp", 7008, 50.0), "rtde": ("rtde", 30004, 500.0)}

TRUTH_FORMAT = "truearm-truth"

Say = Callable[[str], None]  # called with a line of progress or a warning


class Hardware(NamedTuple):
    """What runs as the box; the longest step of its time [ns] (None: any) in virtual time, its pace in real time."""

    power_on: PowerOn
    longest_step_ns: int | None
    pace: Pace


def simulate_box_and_robot(options: SimulateOptions, say: Say) -> None:
    """Serve until the robot's program has ended and the recorder has gone; ``say`` is called with one line at a time.

    Raises InputError, and LinkError if the ports are not available.
    """
    scheme, usual_port, rate = PROTOCOLS[options.protocol]
    world, machine, box = _lab(options, rate, say)
    robot_port = usual_port if options.robot_port is None else options.robot_port
    remedy = "other ports with ", Argument("port"), " and ", Argument("robot_port")
    with _listening(options, box, robot_port, remedy) as (box_port, device, listener):
        robot_end = RtdeServer(listener, rate) if options.protocol == "rtde" else listener
        plan, rig, session = (shlex.quote(str(options.out / name)) for name in ("plan.csv", "rig.toml", SESSION))
        say(f"{_visits_of(world)}. Record them with\n")
        say(
            f"  truearm record --box {device} --address {scheme}://127.0.0.1:{listener.number} "
            f"--plan {plan} --rig {rig} --out {session}\n"
        )
        goes_on = "; its controller goes on, so end the recording with q" if options.protocol == "rtde" else ""
        ended = f"the robot's program has ended{goes_on}"
        started = partial(say, "connected: time starts")
        serve(world, box, box_port, robot_end, started=started, ended=partial(say, ended), pace=machine.pace)


def simulate_fast(options: SimulateOptions, say: Say) -> None:
    """Record everything in virtual time, into session.mcap in the folder. Raises InputError."""
    if options.protocol != "lines" or options.pty:
        raise InputError(
            Argument("fast"), " opens no ports; leave out ", Argument("protocol"), " and ", Argument("pty")
        )
    _, _, rate = PROTOCOLS[options.protocol]
    world, machine, box = _lab(options, rate, say, fast=True)
    started = time.perf_counter()
    osr = nearest_osr(FAST_RATE_HZ if options.rate is None else options.rate)
    with closing(box):
        name = Path(options.robot.robot or "").name
        record_virtually(options.out, world, box, osr, options.seed, machine.longest_step_ns, name)
    say(f"{_visits_of(world)}, recorded in {time.perf_counter() - started:.1f} s: {options.out / SESSION}")


def write_setup(out: Path, world: World) -> None:
    """Write plan.csv and rig.toml, as a user would have them."""
    write_plan(out / "plan.csv", world.controller.plan)
    write_rig(out / "rig.toml", world.rig)


def record_virtually(
    out: Path, world: World, box: SimulatedBox, osr: int, seed: int, step_ns: int | None = None, model: str = ""
) -> None:
    """Run the recorder on the lab's links and clock and write session.mcap.

    ``step_ns``: the longest step of the box's time; None: the lab's own. ``model``: the robot, or its file.
    """
    lab = Lab(world, box, seed, STEP_NS if step_ns is None else step_ns)
    writer = SessionWriter(out / SESSION, lab.clock, overwrite=True)
    # An exception in the middle of a grant would leave the box's process waiting for its counterpart.
    name = f"recording {counted(round(world.duration / 60), 'minute')} in virtual time"
    rig_toml, head = (out / "rig.toml").read_bytes(), [(SETUP, {"model": model})]
    options = RecordOptions(plan=plan_rows(world.controller.plan), rig_toml=rig_toml, osr=osr, head=head)
    with asked_to_stop() as interrupted, step(name) as advance:
        operator, robot = Confirming(lab, advance), lab.robot_link
        summary = record(
            lab.box_link, writer, lab.clock, robot=robot, options=options, operator=operator, interrupted=interrupted
        )
    if summary.file_losses:
        raise IncompleteError("; ".join(summary.file_losses))
    if interrupted():  # also while the file was being completed, when the recorder no longer asks
        raise KeyboardInterrupt
    if summary.reason != "robot closed":
        raise LinkError(f"the simulated recording ended early: {summary.reason}, {summary.text}")


def simulate_stage(options: SimulateOptions, say: Say, typed: Callable[[], list[str]]) -> None:
    """Serve a box with sensors on a movable carriage until q is typed; ``typed`` returns the lines since the last call.

    A line is a position in mm. Raises InputError, and LinkError if the port is not available.
    """
    machine = hardware(options.level, say)
    stage, faults = Stage(options.seed), [parse_fault(fault) for fault in options.fault]
    span = f"-{MM.of(LARGEST):.0f} to {MM.text(LARGEST, '.0f')}"
    box = SimulatedBox(stage, power_on=machine.power_on, faults=faults, seed=options.seed)

    def set_by_hand() -> bool:
        for line in (text.strip() for text in typed()):
            if line == "q":
                return True
            try:
                place = MM.to_si(float(line.replace(",", ".")))
                stage.move_to(place)
                say(f"the carriage goes to {MM.text(place, '.4f')}")
            except ValueError:
                say(f"{line[:40]!r} is not a position; type one from {span}, or q")
        return False

    with _listening(options, box, 0, ("another port with ", Argument("port"))) as (box_port, device, unused):
        say(f"Gauge a sensor with\n\n  truearm box gauge lvdt --box {device}\n")
        say(f"and set the reference here: type a position from {span}; q ends.")
        serve(stage, box, box_port, unused, stop=set_by_hand, pace=machine.pace)


@contextmanager
def _listening(
    options: SimulateOptions, box: SimulatedBox, robot_port: int, remedy: tuple[str | Argument, ...]
) -> Iterator[tuple[Port | Terminal, str, Port]]:
    """Open the box's port, with its name, and another port; closes them and the box. Raises LinkError."""
    with closing(box):
        try:
            box_port = Terminal() if options.pty else Port.listen("127.0.0.1", options.port)
            robot_listener = Port.listen("127.0.0.1", robot_port)
        except OSError as exc:
            raise LinkError(f"cannot listen: {exc.strerror}; choose ", *remedy) from exc
        device = box_port.path if isinstance(box_port, Terminal) else f"socket://127.0.0.1:{box_port.number}"
        with closing(robot_listener), closing(box_port):
            yield box_port, device, robot_listener


def _lab(
    options: SimulateOptions, rate: float, say: Say, *, fast: bool = False
) -> tuple[World, Hardware, SimulatedBox]:
    """Return the world, the hardware behind its box, and the box; writes plan, rig and truth. Raises InputError."""
    folder, seed, truth = options.out, options.seed, options.truth
    faults = [parse_fault(text) for text in options.fault]
    robot, params, arm = simulated_robot(options.robot, truth, seed, options.branch)
    joints = len(robot.chain.joints)
    if options.protocol == "rtde" and joints != RTDE_JOINTS:
        text = f" rtde: a controller of {RTDE_JOINTS} joints, {robot.chain.name} has {joints}"
        raise InputError(Argument("protocol"), text)
    plan, rig = visits(options, robot)
    thermal = None if options.warming is None else Thermal(drift=options.warming, gain_drift=LVDT_DRIFT)
    if thermal is not None and options.rig is None:
        rig = thermal.declared(rig)
    if options.truth_out is not None:
        read = [path for path in (options.plan, options.rig, *options.robot.files) if path is not None]
        check_writable(options.truth_out, options.force, inputs=read, kind="truth")
    robot_input = None if options.trigger is None else RobotInput(options.trigger)
    setup = Setup(robot_rate=rate, robot_delay_s=options.robot_delay, robot_input=robot_input, thermal=thermal)
    world = World(seed, plan, rig, params, arm, robot, setup)
    own_folder(folder, MARK)
    machine = hardware(options.level, say, fast=fast)
    write_setup(folder, world)
    if options.truth_out is not None:
        document = truth_document(world, robot, truth, seed)
        write_atomic(options.truth_out, json.dumps(document, indent=1) + "\n")
    return world, machine, SimulatedBox(world, power_on=machine.power_on, faults=faults, seed=seed)


def _visits_of(world: World) -> str:
    """Return the robot, its visits, and their duration."""
    plan = world.controller.plan
    dwells, driven = int(plan.dwells.sum()), int(plan.lines.sum())
    counts = [counted(dwells, "pose")] * (dwells > 0) + [f"{counted(driven, 'drive')} along lines"] * (driven > 0)
    visited = " and ".join(counts)
    return f"{world.chain.name}: {visited}, {counted(round(world.duration / 60), 'minute')} of robot time"


@step("preparing the poses")
def visits(options: SimulateOptions, robot: Robot) -> tuple[Plan, Rig]:
    """Return what the robot visits and its surroundings, from files if given, else drawn at random.

    Raises InputError, and PlanError if the plan is for another robot, or if the robot has no branch to draw poses from.
    """
    lines, plan_file, rig_file = options.lines, options.plan, options.rig
    if plan_file is None and rig_file is not None:
        raise InputError("needs-option", place=Argument("rig"), needed=Argument("plan"))
    if lines and plan_file is not None:
        raise InputError("exclusive", first=Argument("lines"), second=Argument("plan"))
    repeatability, name = options.truth.repeatability, robot.chain.name
    rig = line_rig() if lines else standard_rig(robot) if rig_file is None else read_rig(rig_file)
    if rig_file is None and repeatability is not None:
        rig = replace(rig, bars={bar.name: replace(bar, sigma=repeatability) for bar in rig.bars.values()})
    if plan_file is None:
        if lines:
            return drawn_line_plan(lines, options.seed, rig, robot=robot).of_robot(name), rig
        return standard_plan(options.poses, options.seed, rig, robot).of_robot(name), rig
    plan = read_plan(plan_file)
    check_robot(plan, name, str(plan_file), "; choose the robot to simulate with ", Argument("model"))
    if plan.q.shape[1] != len(robot.chain.joints):
        raise PlanError("other-robot", place=plan_file, joints=plan.q.shape[1], expected=len(robot.chain.joints))
    check_against_rig(plan, rig, str(plan_file))
    return plan, rig


def hardware(level: str, say: Say, *, fast: bool = False) -> Hardware:
    """Return what runs as the box, and report it.

    Raises LinkError, InputError if emulator or MicroPython cannot be used.
    """
    if level == "chip":
        node.ready()
        say(f"firmware: {node.image()} in an emulated RP2040")
        pace = replace(EMULATED, delayed=lambda: say(DELAYED))
        return Hardware(partial(ChipBox, prompt=not fast), CHIP_STEP_NS, pace)
    try:
        interpreter = micropython.find()
    except micropython.InterpreterError as exc:
        raise InputError(str(exc)) from exc
    say(f"firmware: {interpreter or 'CPython; no MicroPython was found (' + micropython.BY_HAND + ')'}")
    return Hardware(partial(VmBox, interpreter), None, Pace())


def parse_fault(text: str) -> Fault:
    """Parse a fault written SECONDS:KIND. Raises InputError."""
    seconds, _, kind = text.partition(":")
    try:
        return Fault(float(seconds), kind)
    except ValueError:
        form = f"SECONDS:KIND, with KIND one of {', '.join(FAULTS)}"
        raise InputError("wrong-value", place=Argument("fault"), value=text, form=form) from None


# the robot and its hidden truth


def simulated_robot(
    model: RobotChoice, truth: TruthOptions, seed: int, branch: Branch | None = None
) -> tuple[Robot, Floats, Arm]:
    """Return the robot in a branch, its true parameters (p,) and its arm; drawn from ``seed``, or the truth's own seed.

    Raises InputError, and RobotError as ``load_robot`` does.
    """
    robot = model.load()
    if branch is not None:
        robot = replace(robot, branch=branch_of(robot, branch))
    seed = seed if truth.truth_seed is None else truth.truth_seed
    chain = robot.chain
    params = true_params(robot, seed, None if truth.tolerance is None else Tolerance(*truth.tolerance))
    errors: list[JointError] = []
    if truth.gear_error:
        errors.append(GearError.drawn(truth.gear_error, truth.gear_periods, len(chain.joints), seed))
    if truth.masses is not None:
        if len(truth.masses) != len(chain.joints):
            form, masses = f"{len(chain.joints)} masses, one per joint", ",".join(f"{mass:g}" for mass in truth.masses)
            raise InputError("wrong-value", place=Argument("masses_kg"), value=masses, form=form)
        errors.append(Sag(chain, params, np.array(truth.masses), truth.stiffness_nm_rad))
    return robot, params, replace(WORN if truth.worn else Arm(), errors=tuple(errors))


def truth_document(world: World, robot: Robot, truth: TruthOptions, seed: int) -> dict[str, Any]:
    """Return the data for judging a calibration of this world.

    These are the true parameters next to the design, and the errors of joints, clocks and bars.
    """
    chain, arm, hidden = robot.chain, world.controller.arm, world.truth
    pairs = zip(chain.parameters, chain.params_nominal.tolist(), hidden.params.tolist(), strict=True)
    return {
        "format": TRUTH_FORMAT,
        "robot": chain.name,
        "seed": seed if truth.truth_seed is None else truth.truth_seed,
        "parameters": [{"name": p.name, "unit": p.unit, "design": d, "true": t} for p, d, t in pairs],
        "gear_error_rad": truth.gear_error,
        "gear_periods_rad": list(truth.gear_periods) if truth.gear_error else [],
        "masses_kg": None if truth.masses is None else list(truth.masses),
        "stiffness_nm_rad": None if truth.masses is None else truth.stiffness_nm_rad,
        "backlash_rad": list(arm.backlash),
        "reading_sigma_rad": arm.reading_sigma,
        "robot_delay_s": hidden.robot_delay,
        "bars": {name: {"zero_m": bar.zero, "repeatability_m": bar.sigma} for name, bar in world.rig.bars.items()},
        "clocks": {"device_ppm": hidden.clocks.device.ppm, "robot_ppm": hidden.clocks.robot.ppm},
    }
