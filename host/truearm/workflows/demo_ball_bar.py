"""``truearm demo --rig ballbar``: Goswami's experiment, with the shells of one bar to fit and of another to judge."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from truearm.workflows import demo_steps
from truearm.workflows.demo_steps import ClockTruth, DemoCalibration, Steps, Subject, recording_facts

if TYPE_CHECKING:
    from truearm.kinds.table import ObservationTable
    from truearm.results import Estimate
    from truearm.session.observations import SyncResult


@dataclass(frozen=True)
class BallBarCalibration(DemoCalibration):
    """The robot identified with its usual free parameters (the paper's 36), and with all of them free, which shows the
    rank.
    """

    all_free: Estimate


def calibrate(out: Path, table: ObservationTable, subject: Subject) -> BallBarCalibration:
    """Fit the shells of the first bar, judge by those of the second, and write result.json."""
    from truearm.estimate.identify import identify
    from truearm.estimate.prior import prior_named
    from truearm.files.rig_file import read_rig
    from truearm.workflows.identify import default_prior

    robot, rig, judging = subject.robot, read_rig(out / "rig.toml"), subject.judging.name
    chain, held_out, prior = robot.chain, table.bar == judging, default_prior(robot, "lm")
    estimate = identify(chain, rig, table, free=robot.free, hold_out=held_out, prior_sigma=prior_named(chain, prior))
    all_free = identify(chain, rig, table, hold_out=held_out)
    said = prior if robot.is_urdf else "none"
    found = demo_steps.identified(out, table, subject, rig, estimate, [f"bar={judging}"], said)
    return BallBarCalibration(**vars(found), all_free=all_free)


def write_page(
    out: Path, found: BallBarCalibration, result: SyncResult, truth: ClockTruth, steps: Steps, command: str
) -> Path:
    """Write report.html; ``command`` is the one that was typed."""
    facts = (
        ("dwells used", f"{len(result.table)} of {len(result.dwells) - result.n_mountings}"),
        *recording_facts(result, truth),
        (f"rank with all {len(found.all_free.free)} parameters free", f"{found.all_free.rank}"),
    )
    return demo_steps.write_page(out, found, result.table, "ball-bar calibration", facts, steps, command)
