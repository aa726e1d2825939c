"""``truearm demo --rig ballbar``: Goswami's experiment, with the shells of one bar to fit and of another to judge."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from truearm.workflows.demo_steps import ClockTruth, Steps, Subject, recording_facts, robot_title

if TYPE_CHECKING:
    from truearm.results import Estimate, PredictedError
    from truearm.session.observations import SyncResult
    from truearm.types import Floats, ObservationTable, Rig


@dataclass(frozen=True)
class BallBarCalibration:
    """The robot identified with its usual free parameters (the paper's 36), and with all of them free, which shows the
    rank.
    """

    subject: Subject
    rig: Rig
    estimate: Estimate
    all_free: Estimate
    longitude: Floats  # (n,) rad, of the sphere about its chuck, for the identified robot
    predicted: PredictedError | None


def calibrate(out: Path, table: ObservationTable, subject: Subject) -> BallBarCalibration:
    """Fit the shells of the first bar, judge by those of the second, and write result.json."""
    from truearm.estimate.identify import identify
    from truearm.estimate.prediction import predicted_point_error
    from truearm.estimate.prior import prior_named
    from truearm.files.result_document import document_of
    from truearm.files.result_file import RobotFrames, write_result
    from truearm.files.rig_file import read_rig
    from truearm.workflows.calibration_report import longitudes
    from truearm.workflows.identify import default_prior
    from truearm.workflows.inputs import Sources, hashed_inputs
    from truearm.workflows.selection import default_free

    robot, rig, judging = subject.robot, read_rig(out / "rig.toml"), subject.judging.name
    chain, held_out, prior = robot.chain, table.bar == judging, default_prior(robot, "lm")
    estimate = identify(
        chain, rig, table, free=default_free(robot), hold_out=held_out, prior_sigma=prior_named(chain, prior)
    )
    all_free = identify(chain, rig, table, hold_out=held_out)
    frames = RobotFrames(chain.name, chain.base_frame, chain.end_frame, chain.joint_units)
    inputs = hashed_inputs(Sources((out / "session.mcap",), {"": out / "rig.toml"}), subject.choice)
    predicted = predicted_point_error(chain, rig, table, estimate)
    document = document_of(
        estimate, table, frames, inputs, [f"bar={judging}"], prior if robot.is_urdf else "none", predicted
    )
    write_result(out / "result.json", document)
    return BallBarCalibration(subject, rig, estimate, all_free, longitudes(chain, rig, table, estimate), predicted)


def write_page(
    out: Path, found: BallBarCalibration, result: SyncResult, truth: ClockTruth, steps: Steps, command: str
) -> Path:
    """Write report.html with pictures and tables, everything inline."""
    from truearm.report.calibration_page import CalibrationPage, render

    page = CalibrationPage(
        title=f"{robot_title(found.subject)}, ball-bar calibration",
        subtitle="simulated robot, real firmware, wire, recorder and estimator",
        estimate=found.estimate,
        table=result.table,
        longitude=found.longitude,
        facts=(
            ("dwells used", f"{len(result.table)} of {len(result.dwells) - result.n_mountings}"),
            *recording_facts(result, truth),
            (f"rank with all {len(found.all_free.free)} parameters free", f"{found.all_free.rank}"),
        ),
        steps=tuple(steps.done),
        command=command,
        validation=found.estimate.held_out,
        predicted=found.predicted,
    )
    path = out / "report.html"
    path.write_text(render(page), encoding="utf-8")
    return path
