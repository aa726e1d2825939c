"""``truearm demo --rig ballbar``: Goswami's experiment, shells of one bar to fit and of another to judge by."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from truearm.workflows.demo_steps import VALIDATED, ClockTruth, Steps, recording_facts

if TYPE_CHECKING:
    from truearm.model.robot import Robot
    from truearm.session.observations import SyncResult
    from truearm.types import Estimate, Floats, ObservationTable, PredictedError, Rig


@dataclass(frozen=True)
class BallBarCalibration:
    """The identified robot: the paper's 36 free parameters, and all 54 free, which shows the rank."""

    robot: Robot
    rig: Rig
    estimate: Estimate
    all_free: Estimate
    longitude: Floats  # (n,) rad, of the sphere about its chuck, identified robot
    predicted: PredictedError | None


def calibrate(out: Path, table: ObservationTable) -> BallBarCalibration:
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
    return BallBarCalibration(robot, rig, estimate, all_free, longitudes(chain, rig, table, estimate), predicted)


def write_page(out: Path, found: BallBarCalibration, result: SyncResult, truth: ClockTruth, steps: Steps) -> Path:
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
