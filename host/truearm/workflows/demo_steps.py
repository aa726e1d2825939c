"""Common parts of every ``truearm demo``: its timed steps, the recording in virtual time, and the facts to report."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from truearm.errors import IncompleteError, LinkError
from truearm.files.robot_file import RobotChoice
from truearm.progress import step
from truearm.text import counted
from truearm.units import NS, US
from truearm.workflows.session_observations import Say
from truearm.workflows.simulated_robot import SimulatedRobot, TruthOptions, simulated_robot, with_repeatability

if TYPE_CHECKING:
    from truearm.findings import Finding
    from truearm.kinds.table import ObservationTable
    from truearm.model.robot import Robot
    from truearm.model.workspace import Branch
    from truearm.results import Estimate, PredictedError
    from truearm.session.observations import SyncResult
    from truearm.types import BallBar, Floats, Plan, Rig
    from truearm_sim.simbox import SimulatedBox
    from truearm_sim.world import World


@dataclass(frozen=True)
class Subject:
    """The robot calibrated by the demo: its name, its true state in the lab, and the rig of its ball-bars."""

    choice: RobotChoice
    simulated: SimulatedRobot
    rig: Rig

    @property
    def robot(self) -> Robot:
        """The model to be calibrated."""
        return self.simulated.robot

    @property
    def fitted(self) -> BallBar:
        """The bar with the shells to fit."""
        return list(self.rig.bars.values())[0]

    @property
    def judging(self) -> BallBar:
        """The bar with the shells for judging."""
        return list(self.rig.bars.values())[1]


def subject(choice: RobotChoice, branch: Branch | None, truth: TruthOptions, seed: int) -> Subject:
    """Return the robot with its hidden truth, in front of the simulator's rig. Raises InputError."""
    from truearm_sim.world import standard_rig

    simulated = simulated_robot(choice, truth, seed, branch)
    return Subject(choice, simulated, with_repeatability(standard_rig(simulated.robot), truth))


@dataclass(frozen=True)
class DemoCalibration:
    """What every experiment identifies."""

    subject: Subject
    rig: Rig
    estimate: Estimate
    longitude: Floats  # (n,) rad, of the sphere about its chuck, for the identified robot
    predicted: PredictedError | None
    findings: tuple[Finding, ...]


def identified(
    out: Path,
    table: ObservationTable,
    subject: Subject,
    rig: Rig,
    estimate: Estimate,
    hold_out: Sequence[str],
    prior: str,
) -> DemoCalibration:
    """Return an identification from the demo's session, and write result.json."""
    from truearm.estimate.prediction import predicted_point_error
    from truearm.files.result_document import result_of
    from truearm.files.result_file import RobotFrames, write_result
    from truearm.report.result_findings import result_findings
    from truearm.workflows.calibration_report import longitudes
    from truearm.workflows.identify import examine, with_average
    from truearm.workflows.inputs import Sources, hashed_inputs

    chain = subject.robot.chain
    estimate, examination = examine(chain, rig, table, estimate)
    estimate = with_average(chain, rig, table, estimate, examination)
    predicted = predicted_point_error(chain, rig, table, estimate)
    inputs = hashed_inputs(Sources((out / "session.mcap",), {"": out / "rig.toml"}), subject.choice)
    frames = RobotFrames.of(chain)
    result = result_of(estimate, table, frames, predicted, inputs=inputs, held_out_by=hold_out, prior=prior)
    write_result(out / "result.json", result)
    findings = tuple(result_findings(result.document))
    return DemoCalibration(subject, rig, estimate, longitudes(chain, rig, table, estimate), predicted, findings)


def write_page(
    out: Path,
    found: DemoCalibration,
    table: ObservationTable,
    what: str,
    facts: tuple[tuple[str, str], ...],
    steps: Steps,
    command: str,
    prior: str = "none",
) -> Path:
    """Write report.html with pictures and tables, everything inline; ``command`` is the one that was typed."""
    from truearm.report.calibration_page import CalibrationPage, render

    page = CalibrationPage(
        title=f"{robot_title(found.subject)}, {what}",
        subtitle="simulated robot, real firmware, wire, recorder and estimator",
        estimate=found.estimate,
        table=table,
        longitude=found.longitude,
        facts=facts,
        steps=tuple(steps.done),
        command=command,
        prior=prior,
        predicted=found.predicted,
        findings=found.findings,
    )
    path = out / "report.html"
    path.write_text(render(page), encoding="utf-8")
    return path


@dataclass(frozen=True)
class ClockTruth:
    """The clock fit compared with the simulator's truth.

    Largest error and largest bound [ns], and whether all errors are within their bounds.
    """

    error_ns: float
    bound_ns: float
    within: bool


class Steps:
    """Names and durations [s] of the steps; ``say`` is called as each ends."""

    def __init__(self, say: Say) -> None:
        self.done: list[tuple[str, float]] = []
        self._say = say

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        started = time.perf_counter()
        yield
        self.done.append((name, time.perf_counter() - started))
        self._say(f"{name:<42}{self.done[-1][1]:7.1f} s")

    @property
    def total_s(self) -> float:
        return sum(seconds for _, seconds in self.done)


def robot_title(subject: Subject) -> str:
    """Return the robot's name for a page."""
    name = subject.robot.chain.name
    return "PUMA 560" if name == "puma560" else name


def write_setup(out: Path, world: World) -> None:
    """Write plan.csv and rig.toml, as a user would have them."""
    from truearm.files.plan_file import write_plan
    from truearm.files.rig_file import write_rig

    write_plan(out / "plan.csv", world.controller.plan)
    write_rig(out / "rig.toml", world.rig)


def record_virtually(
    out: Path,
    plan: Plan,
    world: World,
    box: SimulatedBox,
    osr: int,
    seed: int,
    step_ns: int | None = None,
    model: str = "",
) -> None:
    """Run the recorder on the lab's links and clock and write session.mcap.

    ``step_ns``: the longest step of the box's time; None: the lab's own. ``model``: the robot, or its file.
    """
    from truearm.interrupt import asked_to_stop
    from truearm.record.recorder import Hooks, RecordOptions, record
    from truearm.record.session_writer import SessionWriter
    from truearm.workflows.record import plan_rows
    from truearm.workflows.session_parts import SETUP
    from truearm_sim.confirming import Confirming
    from truearm_sim.lab import STEP_NS, Lab

    lab = Lab(world, box, seed, STEP_NS if step_ns is None else step_ns)
    writer = SessionWriter(out / "session.mcap", lab.clock, overwrite=True)
    # An exception in the middle of a grant would leave the box's process waiting for its counterpart.
    name = f"recording {counted(round(world.duration / 60), 'minute')} in virtual time"
    with asked_to_stop() as interrupted, step(name) as advance:
        summary = record(
            lab.box_link,
            writer,
            lab.clock,
            robot=lab.robot_link,
            options=RecordOptions(
                plan=plan_rows(plan),
                rig_toml=(out / "rig.toml").read_bytes(),
                osr=osr,
                head=[(SETUP, {"model": model})],
            ),
            hooks=Hooks(
                interrupted=interrupted,
                progress=lambda status: advance(status.elapsed_s / world.duration),
                operator=Confirming(lab),
            ),
        )
    if summary.file_losses:
        raise IncompleteError("; ".join(summary.file_losses))
    if interrupted():  # also while the file was being completed, when the recorder no longer asks
        raise KeyboardInterrupt
    if summary.reason != "robot closed":
        raise LinkError(f"the simulated recording ended early: {summary.reason}, {summary.text}")


def observe(out: Path, robot: Robot) -> SyncResult:
    """Return the observations of session.mcap, and write them as observations.csv."""
    from truearm.files.observation_table import write_table
    from truearm.workflows.session_observations import observations_of_session

    result = observations_of_session(out / "session.mcap")
    write_table(out / "observations.csv", result.table, robot.chain.joint_units)
    return result


def clock_truth(result: SyncResult, box: SimulatedBox) -> ClockTruth:
    """Compare the device clock with the simulator's truth at a thousand times of the session."""
    import numpy as np

    from truearm_sim.lab import HOST_AT_START_NS

    (clock,) = result.survey.clocks.values()
    (report,) = result.clock_reports
    t_us = np.linspace(*report.device_us, 1000).astype(np.int64)
    host_ns, bound_ns = clock.to_host_ns(t_us)
    error_ns = host_ns - (HOST_AT_START_NS + NS.of(box.true_s(t_us.astype(float))))
    return ClockTruth(float(np.abs(error_ns).max()), float(bound_ns.max()), bool(np.all(np.abs(error_ns) <= bound_ns)))


def visits_in_words(plan: Plan) -> str:
    """Describe the number of dwells and drives in a plan."""
    dwells, drives = int(plan.dwells.sum()), int(plan.lines.sum())
    return " and ".join(
        [counted(dwells, "dwell")] * (dwells > 0)
        + [counted(drives, "drive along a line", "drives along lines")] * (drives > 0)
    )


def recording_facts(result: SyncResult, truth: ClockTruth) -> tuple[tuple[str, str], ...]:
    """Return label and value of facts about the recording."""
    losses, (clock,) = result.losses, result.clock_reports
    rejected = ", ".join(f"{n} {reason}" for reason, n in sorted(result.reasons.items())) or "none"
    return (
        ("dwells rejected", rejected),
        ("samples", f"{result.samples_seen:,} received, {result.samples_used:,} used"),
        ("samples lost", f"{losses.samples_lost + losses.samples_overrun}"),
        ("frames lost", f"{losses.frames_lost}"),
        ("clock exchanges", f"{clock.exchanges:,}"),
        ("box's crystal against the host", f"{clock.rate_ppm:+.3f} ppm"),
        ("clock error, reported bound", f"{US.text(NS.to_si(truth.bound_ns), '.0f')}"),
        ("clock error against the simulator's truth", f"{US.text(NS.to_si(truth.error_ns), '.0f')} at most"),
    )
