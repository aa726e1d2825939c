"""The simulated robot of ``truearm simulate`` and ``truearm demo``: a model named by the user, and its hidden truth."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from truearm.errors import Argument, InputError, PlanError
from truearm.files.disk import write_atomic
from truearm.files.robot_file import RobotChoice
from truearm.model.chain import point_forward
from truearm.plan.branches import branch_of
from truearm.units import MM
from truearm.workflows.requests import TruthOptions

if TYPE_CHECKING:
    from truearm.model.robot import Robot
    from truearm.model.workspace import Branch
    from truearm.types import Floats, Plan, Rig
    from truearm_sim.arm import Arm
    from truearm_sim.world import World

TRUTH_FORMAT = "truearm-truth"


@dataclass(frozen=True)
class SimulatedRobot:
    """A model, its true parameters (p,) and its arm."""

    robot: Robot
    params: Floats
    arm: Arm


def simulated_robot(model: RobotChoice, truth: TruthOptions, seed: int, branch: Branch | None = None) -> SimulatedRobot:
    """Return the robot, in the given branch, with its truth drawn from its own seed or this one.

    Raises InputError, and RobotError as ``load_robot`` does.
    """
    from truearm_sim.arm import WORN, Arm
    from truearm_sim.joint_errors import GearError, JointError, Sag
    from truearm_sim.true_robot import Tolerance, true_params

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
            form = f"{len(chain.joints)} masses, one per joint"
            raise InputError(
                "wrong-value",
                place=Argument("masses_kg"),
                value=",".join(f"{mass:g}" for mass in truth.masses),
                form=form,
            )
        errors.append(Sag(chain, params, np.array(truth.masses), truth.stiffness_nm_rad))
    return SimulatedRobot(robot, params, replace(WORN if truth.worn else Arm(), errors=tuple(errors)))


def with_repeatability(rig: Rig, truth: TruthOptions) -> Rig:
    """Return the rig with the requested repeatability of the bars."""
    if truth.repeatability is None:
        return rig
    bars = {name: replace(bar, sigma=truth.repeatability) for name, bar in rig.bars.items()}
    return replace(rig, bars=bars)


def check_plan(plan: Plan, robot: Robot, rig: Rig, name: str) -> None:
    """Raise PlanError with advice for a plan made for another robot; ``name`` is the plan's file.

    If the plan does not name its robot, the bars show it: another arm would pull most of them beyond their travel.
    """
    from truearm.files.plan_file import check_against_rig, check_robot

    chain = robot.chain
    check_robot(plan, chain.name, name, "; choose the robot to simulate with ", Argument("model"))
    if plan.q.shape[1] != len(chain.joints):
        raise PlanError("other-robot", place=name, joints=plan.q.shape[1], expected=len(chain.joints))
    check_against_rig(plan, rig, name)
    rows = np.flatnonzero(plan.dwells)
    if not rows.size:
        return
    bars = [rig.bars[bar] for bar in plan.bar[rows]]
    p_sphere, p_chuck = (
        np.array([points[point].xyz for point in names[rows]])
        for points, names in ((rig.spheres, plan.sphere), (rig.chucks, plan.chuck))
    )
    length = np.linalg.norm(point_forward(chain, chain.params_nominal, plan.q[rows], p_sphere) - p_chuck, axis=1)
    beyond = np.abs(length - [bar.zero for bar in bars]) - [0.5 * abs(bar.gain) * bar.travel for bar in bars]
    if np.mean(beyond > 0.0) > 0.5:
        text = (
            f"{name}: robot {chain.name} would pull the bar out of its travel at {int(np.sum(beyond > 0.0))} of {rows.size} poses, by "
            f"{MM.text(float(np.median(beyond[beyond > 0.0])), '.0f')} (median); the plan is for another robot or rig; choose them with "
        )
        raise PlanError(text, Argument("model"), " and ", Argument("rig"))


def write_truth(path: Path, world: World, robot: Robot, truth: TruthOptions, seed: int) -> None:
    """Write the hidden truth of a world as JSON, in SI units. Raises InputError."""
    write_atomic(path, json.dumps(truth_document(world, robot, truth, seed), indent=1) + "\n")


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
