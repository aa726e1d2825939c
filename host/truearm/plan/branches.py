"""The configuration branch of a plan, and inverse kinematics within it.

Damped least squares solves all poses at once: Δq = Jᵀ(JJᵀ + λ²I)⁻¹e, where e is the pose error. It starts from the
nearest of many random poses of the branch. Solutions that leave the branch, or come close to a singularity, the robot's
own column or the table, are discarded. All results therefore lie in one branch, and the arm can move between any two of
them without passing a singularity of the elbow or the wrist.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from truearm.errors import Argument, PlanError
from truearm.model.chain import Chain, forward, joint_frames
from truearm.model.inverse import error_and_jacobian, singular_value
from truearm.model.robot import Branch, Robot, check_branch
from truearm.model.robot_file import names_with_branch
from truearm.schema import SchemaError
from truearm.types import Floats

MIN_JOINTS = 6  # with fewer, an arm cannot orient the tool freely
N_SEEDS = 30_000
ITERATIONS = 8  # of a pose that converges at all, 99 % have by then
NEARLY = 1.0  # a start may be twice as far as the nearest: found in a quarter of the time, it converges as often
DAMPING = 0.01
LARGEST_STEP = 0.4  # rad
LEVER = 0.45  # m, makes metres comparable with radians
MIN_SINGULAR_VALUE = 0.05
TOLERANCE = 1e-7  # LEVERs, and rad


def check_joints(chain: Chain) -> None:
    """Raise PlanError for an arm with fewer than MIN_JOINTS joints."""
    if len(chain.joints) < MIN_JOINTS:
        raise PlanError(
            f"robot {chain.name} has {len(chain.joints)} joints; a plan of bars or lines needs six or more, one of sockets "
            "four: truearm init --method sockets"
        )


def _check_kinds(chain: Chain) -> None:
    """Raise PlanError for an arm with a prismatic or mimic joint.

    A branch has angles, and a move's pace is that of turning.
    """
    unplanned = [joint for joint in chain.joints if joint.kind != "revolute" or joint.mimic]
    for joint in unplanned[:1]:
        kind = "prismatic" if joint.kind != "revolute" else "a mimic joint"
        raise PlanError(
            f"joint {joint.name} of robot {chain.name} is {kind}, and a plan is for arms with independent revolute joints "
            "only; choose the poses yourself, and identify from a table"
        )


def branch_of(robot: Robot, branch: Branch | None = None) -> Branch:
    """Return the branch of a robot file, or the given one.

    Raises PlanError if there is none, if it does not have two bounds per joint within the joint's limits, or if a joint
    is prismatic.
    """
    chain = robot.chain
    _check_kinds(chain)
    if branch is None:
        if robot.branch is None:
            check_joints(chain)  # no bounds would help
            with_branch = ", ".join(names_with_branch())
            text = (
                f"robot {chain.name} has no [branch] in its file (the built-in robots {with_branch} have one, a URDF never); give "
                f"LOW:HIGH of its {len(chain.joints)} joints in degrees, with commas between them, as "
            )
            raise PlanError(text, Argument("branch"))
        return robot.branch
    try:
        check_branch(branch, chain.joints)
    except SchemaError as exc:
        raise PlanError(Argument("branch"), f": {exc}") from None
    return branch


class Arm(NamedTuple):
    """A chain with the parameters (p,) of the controller's model, a branch, and random poses of it to start from.

    The end is never farther than ``reach`` [m] from ``base`` (3,), the place of the first joint.
    """

    chain: Chain
    params: Floats
    branch: Branch
    seeds: KDTree
    q_seeds: Floats
    base: Floats
    reach: float


def make_arm(chain: Chain, params: Floats, branch: Branch, rng: np.random.Generator) -> Arm:
    """Return an arm with N_SEEDS random poses of its branch, indexed by the poses they reach."""
    q = rng.uniform(branch.lower, branch.upper, (N_SEEDS, len(branch.lower)))
    zero = np.zeros(len(chain.joints))
    places = np.array([*joint_frames(chain, params, zero), forward(chain, params, zero)])[:, :3, 3]
    reach = float(np.linalg.norm(np.diff(places, axis=0), axis=-1).sum())
    return Arm(chain, params, branch, KDTree(_features(forward(chain, params, q))), q, places[0], reach)


def inverse(arm: Arm, poses: Floats) -> Floats:
    """Return joint vectors (m, j) for end poses (m, 4, 4); NaN where no acceptable solution was found."""
    q = np.full((len(poses), arm.q_seeds.shape[1]), np.nan)
    possible = np.flatnonzero(_possible(arm, poses))
    if len(possible):
        q[possible] = _solved(arm, poses[possible])
    return q


def _possible(arm: Arm, poses: Floats) -> NDArray[np.bool_]:
    """Return which poses (m,) are within reach and clear of the arm's column and the table, without a search."""
    place = poses[:, :3, 3]
    possible = (np.hypot(place[:, 0], place[:, 1]) > arm.branch.clearance) & (place[:, 2] > arm.branch.height)
    possible &= np.linalg.norm(place - arm.base, axis=-1) <= arm.reach + TOLERANCE
    return np.asarray(possible)


def _solved(arm: Arm, poses: Floats) -> Floats:
    """Return joint vectors (m, j) for end poses (m, 4, 4), by damped Newton steps from one of the nearest seeds.

    NaN where they do not converge, leave the branch or end near a singularity.
    """
    q = arm.q_seeds[arm.seeds.query(_features(poses), eps=NEARLY)[1]]
    unsolved = np.arange(len(q))
    for _ in range(ITERATIONS):
        error, jacobian = error_and_jacobian(arm.chain, arm.params, poses[unsolved], q[unsolved], lever=LEVER)
        normal = jacobian @ jacobian.swapaxes(-1, -2) + DAMPING**2 * np.eye(6)
        step = (jacobian.swapaxes(-1, -2) @ np.linalg.solve(normal, error[..., None]))[..., 0]
        q[unsolved] += np.clip(step, -LARGEST_STEP, LARGEST_STEP)
        unsolved = unsolved[np.abs(error).max(axis=-1) > TOLERANCE]
    good = np.all((q > arm.branch.lower) & (q < arm.branch.upper), axis=-1)
    good[unsolved] = False
    good[good] = singular_value(arm.chain, arm.params, q[good], lever=LEVER) > MIN_SINGULAR_VALUE
    return np.where(good[:, None], q, np.nan)


def _features(poses: Floats) -> Floats:
    """Return positions in LEVERs and two axes, (…, 9): the distance between two poses for inverse kinematics."""
    return np.concatenate([poses[..., :3, 3] / LEVER, poses[..., :3, 2], 0.5 * poses[..., :3, 0]], axis=-1)
