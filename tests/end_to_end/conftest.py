"""Sessions from the simulated lab: the firmware in a real MicroPython, the recorder in virtual time."""

import io
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from truearm.cli.main import main
from truearm.kinds.rig_file import format_rig
from truearm.kinds.table import ObservationTable
from truearm.record import links
from truearm.record.recorder import RecordOptions, RecordSummary, record
from truearm.record.session_writer import SessionWriter
from truearm.types import Floats, Plan, Rig
from truearm.workflows.record import plan_rows
from truearm_sim import micropython
from truearm_sim.arm import Arm
from truearm_sim.lab import Lab
from truearm_sim.robot import quantised
from truearm_sim.simbox import Fault, SimulatedBox
from truearm_sim.world import Setup, World, standard_plan


@contextmanager
def noise_alone() -> Iterator[None]:
    """Let ``identify`` in this process state errors by noise alone, as a plan's forecast does, without faults that may be there."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("truearm.workflows.identify.examine", lambda *given: None)
        yield


@dataclass
class Recorded:
    """A recorded session and its truth."""

    path: Path
    summary: RecordSummary
    world: World
    lab: Lab
    sent: list[bytes]  # every piece of data that the link delivered to the recorder


def truearm_process(*arguments: object, timeout_s: float = 120) -> subprocess.CompletedProcess[str]:
    """Run the command line in a separate process, for what requires one: real time, signals, the complete demo."""
    command = [sys.executable, "-m", "truearm", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout_s)


def truearm(*arguments: object) -> subprocess.CompletedProcess[str]:
    """Run the command line in this process, which has already imported everything."""
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        code = main([str(a) for a in arguments])
    return subprocess.CompletedProcess(arguments, code, out.getvalue(), err.getvalue())


def interpreter():
    found = micropython.find()
    assert found is not None, "no MicroPython: run make micropython"
    return found


class TappedLink:
    """The box's link, with a copy of the data it delivered."""

    def __init__(self, link):
        self.name, self._link, self.delivered = link.name, link, []

    def read(self, timeout_s):
        arrivals = self._link.read(timeout_s)
        self.delivered += [data for _, data in arrivals]
        return arrivals

    def write(self, data):
        return self._link.write(data)

    def close(self):
        self._link.close()


@contextmanager
def lab_with(world: World, seed: int | None = None, **box: Any) -> Iterator[Lab]:
    """Return a lab with a box in MicroPython; ``box``: what else a SimulatedBox takes."""
    seed = world.seed if seed is None else seed
    simulated = SimulatedBox(world, **{"interpreter": interpreter(), "seed": seed, **box})
    try:
        yield Lab(world, simulated, seed)
    finally:
        simulated.close()


def recorded_with_plan(lab: Lab, path: Path, link: Any = None, **options: Any) -> RecordSummary:
    """Record a lab with plan and rig of its world; ``link``: in place of the box's; ``options`` of RecordOptions."""
    setup = {"plan": plan_rows(lab.world.controller.plan), "rig_toml": format_rig(lab.world.rig).encode()}
    writer, options = SessionWriter(path, lab.clock, overwrite=True), RecordOptions(**(setup | options))
    return record(link or lab.box_link, writer, lab.clock, robot=lab.robot_link, options=options)


def record_session(
    path: Path,
    poses: int,
    *,
    faults: Sequence[Fault] = (),
    seed: int = 1,
    osr: int = 4096,
    duration_s: float | None = None,
    rig: Rig | None = None,
    arm: Arm | None = None,
    plan: Plan | None = None,
    params: Floats | None = None,
    robot_delay_s: float = 0.0,
) -> Recorded:
    """Record ``poses`` with each bar of the rig, or another plan; ``params`` (p,): another true robot."""
    plan = standard_plan(poses, seed, rig) if plan is None else plan
    world = World(seed, plan, rig, params, arm=arm, setup=Setup(robot_delay_s=robot_delay_s))
    with lab_with(world, faults=faults) as lab:
        link = TappedLink(lab.box_link)
        summary = recorded_with_plan(lab, path, link, osr=osr, duration_s=duration_s)
    return Recorded(path, summary, world, lab, link.delivered)


def measured_by_bars(world):
    """Return the true lengths of the world's dwells, including repeatability, as rows with the joint readings."""
    dwells, plan = world.controller.dwells, world.controller.plan
    names = {name: getattr(plan, name)[plan.dwells] for name in ("bar", "chuck", "sphere")}
    q = quantised(world.controller.q_held[dwells])
    return ObservationTable(q=q, kind="ball_bar", value=world.truth.length, **names)


@pytest.fixture(scope="session")
def short_session(tmp_path_factory) -> Recorded:
    """Return ninety dwells with each bar at 254 Hz, without faults."""
    return record_session(tmp_path_factory.mktemp("session") / "short.mcap", 90, osr=16384)


@pytest.fixture
def no_ports(monkeypatch):
    """Simulate a computer with nothing plugged in."""
    monkeypatch.setattr(links.list_ports, "comports", lambda: [])
