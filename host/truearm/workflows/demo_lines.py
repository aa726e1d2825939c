"""``truearm demo --experiment line|both``: Renders' experiment, lines measured in motion, alone or with the ball-bar.

Four lines, planned for a region, are driven there and back for the identification. A fifth, drawn at random in the
region, is used for judging (Renders 1991, III-E). The simulated robot's readings are delayed; the identification is not
told and has to find the delay.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from truearm.estimate.solvers import Prior
from truearm.units import MS, NS
from truearm.workflows import demo_steps
from truearm.workflows.demo_steps import ClockTruth, DemoCalibration, Steps, Subject, recording_facts

if TYPE_CHECKING:
    from truearm.kinds.table import ObservationTable
    from truearm.model.robot import Robot
    from truearm.results import Estimate
    from truearm.session.observations import SyncResult
    from truearm.types import Plan
    from truearm_sim.world import World

N_LINES = 4
CHECK = "check"  # the line used for judging
REGION = (0.2, -0.35, 0.05), (0.7, 0.35, 0.6)
REGION_REACH = 0.92  # m, reach of the arm that this region fits
LENGTH = 0.5  # m, of its lines
CANDIDATES = 30
DRAW = 1000  # random seed of the line used for judging, added to the planner's own
SPEED = 0.1  # m/s
ROBOT_DELAY_S = 8e-3
RATE_HZ, RATE_OF_BOTH_HZ = 125.0, 50.0  # joint readings per second; at 125, 1.5 hours would take longer to record


def world_of(with_bar: bool, poses: int, seed: int, subject: Subject) -> World:
    """Return the robot that drives planned lines, after ``poses`` dwells with each bar if ``with_bar``."""
    from dataclasses import replace

    from truearm.files.plan_file import concatenate
    from truearm_sim.line_plan import line_rig
    from truearm_sim.world import Setup, World, standard_plan

    simulated, robot = subject.simulated, subject.robot
    plan, rig = planned_lines(seed, robot), line_rig()
    if with_bar:
        plan, rig = concatenate(standard_plan(poses, seed, subject.rig, robot), plan), line_rig(subject.rig)
    rig = replace(rig, time_offset_sigma=None)
    return World(
        seed,
        plan,
        rig,
        simulated.params,
        simulated.arm,
        robot,
        Setup(robot_rate=RATE_OF_BOTH_HZ if with_bar else RATE_HZ, robot_delay_s=ROBOT_DELAY_S),
    )


def planned_lines(seed: int, robot: Robot) -> Plan:
    """Return lines as ``truearm plan line`` plans them on the design, and one more in their region."""
    from dataclasses import replace

    import numpy as np

    from truearm.files.plan_file import concatenate
    from truearm.plan.ball_bar_plan import make_site
    from truearm.plan.bar_paths import Pace
    from truearm.plan.branches import branch_of
    from truearm.plan.cartesian_lines import Shape, candidate_lines
    from truearm.plan.collision_shapes import Sizes
    from truearm.plan.first_rig import reach
    from truearm.plan.forecast import Known
    from truearm.plan.line_plan import LinesWanted, plan_lines
    from truearm.plan.measurement_limits import Limits
    from truearm.plan.region import Region
    from truearm_sim.line_plan import JOINT_SPEED, MAGNET, TARGETS, line_rig, lines_plan, with_ways
    from truearm_sim.true_robot import PAPER

    branch = branch_of(robot)
    size = 1.0 if robot.chain.name == PAPER else reach(robot, branch) / REGION_REACH
    region, shape = Region(*(size * np.array(REGION))), Shape(min(LENGTH, size * LENGTH), speed=SPEED)
    known = replace(Known.design(robot, line_rig()), branch=branch)
    site = make_site(known, Limits(), Sizes(), seed)
    wanted = LinesWanted(N_LINES, shape=shape, n_candidates=CANDIDATES, seed=seed)
    planned = plan_lines(site, known, wanted, Pace(), region, MAGNET)
    one = candidate_lines(site, shape, 1, np.array(TARGETS[MAGNET].xyz), JOINT_SPEED, region, seed + DRAW)
    return concatenate(*with_ways(site, [planned.visits, lines_plan(one.q[0, [0, -1]], CHECK, SPEED, True)]))


@dataclass(frozen=True)
class LineCalibration(DemoCalibration):
    """The results identified from lines, and the other fit used for comparison."""

    with_bar: bool
    table: ObservationTable
    other: Estimate  # row by row for lines alone; the ball-bar's alone if both are used


def _prior(with_bar: bool) -> Prior:
    """Return the prior: lines alone do not determine all free parameters; together with a ball-bar none is needed."""
    return Prior.NONE if with_bar else Prior.WIDE


def calibrate(with_bar: bool, out: Path, table: ObservationTable, subject: Subject) -> LineCalibration:
    """Fit four lines, and with them the shells of the first bar, judge by the rest, and write result.json."""
    import numpy as np

    from truearm.estimate.identify import SolverOptions, identify
    from truearm.estimate.prior import wide_prior
    from truearm.files.rig_file import read_rig

    robot, rig = subject.robot, read_rig(out / "rig.toml")
    chain, free, judging = robot.chain, robot.free, subject.judging.name
    judges = (table.line == CHECK) | (table.bar == judging)
    if not with_bar:
        prior = wide_prior(chain)
        estimate, other = (
            identify(
                chain,
                rig,
                table,
                free=free,
                hold_out=judges,
                prior_sigma=prior,
                options=SolverOptions(solver=solver),
            )
            for solver in ("map", "recursive")
        )
    else:
        estimate = identify(chain, rig, table, free=free, hold_out=judges)
        other = identify(chain, rig, table, free=free, hold_out=np.asarray(table.bar != subject.fitted.name))
    hold_out = [f"line={CHECK}", *[f"bar={judging}"] * with_bar]
    found = demo_steps.identified(out, table, subject, rig, estimate, hold_out, _prior(with_bar))
    return LineCalibration(**vars(found), with_bar=with_bar, table=table, other=other)


def write_page(
    out: Path, found: LineCalibration, result: SyncResult, truth: ClockTruth, steps: Steps, command: str
) -> Path:
    """Write report.html; ``command`` is the one that was typed."""
    what = f"calibration by lines{' and ball-bar' * found.with_bar}"
    facts = (*recording_facts(result, truth), ("delay of the robot's readings", delay_words(found.estimate)))
    return demo_steps.write_page(out, found, result.table, what, facts, steps, command, _prior(found.with_bar))


def delay_words(estimate: Estimate) -> str:
    """Describe τ and its standard deviation, next to the truth, which includes the shortest network delay."""
    from truearm_sim.latency import FROM_ROBOT

    k = estimate.parameter_names.index("time_offset")
    truth = ROBOT_DELAY_S + NS.to_si(FROM_ROBOT.least)
    return f"{MS.of(estimate.value[k]):.2f} ± {MS.text(estimate.sigma[k], '.2f')} found, {MS.text(truth, '.2f')} true"
