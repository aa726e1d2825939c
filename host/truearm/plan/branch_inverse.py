"""Joint vectors for end poses: inverse kinematics within one configuration branch of an arm.

Damped least squares, all poses at once: Δq = Jᵀ(JJᵀ + λ²I)⁻¹e with e the pose error. It starts from the nearest of many
random poses of the branch, and what leaves the branch or comes near a singularity, the robot's own column or the table is
dropped. So all results are of one branch, and the arm can go from any of them to any other without passing a singularity
of the elbow or the wrist.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from truearm.model.chain import Chain, forward, joint_jacobian
from truearm.model.workspace import Branch
from truearm.types import Floats

N_SEEDS = 30_000
ITERATIONS = 12
DAMPING = 0.01
LEVER = 0.45  # m, what makes a metre comparable with a radian
MIN_SINGULAR_VALUE = 0.05
TOLERANCE = 1e-7  # LEVERs, and rad


class Arm(NamedTuple):
    """A chain with the parameters (p,) it is programmed with, a branch, and random poses of it to start from."""

    chain: Chain
    params: Floats
    branch: Branch
    seeds: KDTree
    q_seeds: Floats


def make_arm(chain: Chain, params: Floats, branch: Branch, rng: np.random.Generator) -> Arm:
    """An arm with N_SEEDS random poses of its branch, to be looked up by what they reach."""
    q = rng.uniform(branch.lower, branch.upper, (N_SEEDS, len(branch.lower)))
    return Arm(chain, params, branch, KDTree(_features(forward(chain, params, q))), q)


def inverse(arm: Arm, poses: Floats) -> Floats:
    """Joint vectors (m, j) of end poses (m, 4, 4); NaN where none was found that is good."""
    q = arm.q_seeds[arm.seeds.query(_features(poses))[1]]
    for _ in range(ITERATIONS):
        error, jacobian = pose_error(arm, poses, q)
        normal = jacobian @ jacobian.swapaxes(-1, -2) + DAMPING**2 * np.eye(6)
        step = (jacobian.swapaxes(-1, -2) @ np.linalg.solve(normal, error[..., None]))[..., 0]
        q = q + np.clip(step, -0.4, 0.4)
    error, jacobian = pose_error(arm, poses, q)
    good = np.all((q > arm.branch.lower) & (q < arm.branch.upper), axis=-1) & (np.abs(error).max(axis=-1) < TOLERANCE)
    good &= np.linalg.svd(jacobian, compute_uv=False)[:, -1] > MIN_SINGULAR_VALUE
    good &= (np.hypot(poses[:, 0, 3], poses[:, 1, 3]) > arm.branch.clearance) & (poses[:, 2, 3] > arm.branch.height)
    return np.where(good[:, None], q, np.nan)


def _features(poses: Floats) -> Floats:
    """Positions in LEVERs and two axes, (…, 9): the distance of two poses as inverse kinematics feels it."""
    return np.concatenate([poses[..., :3, 3] / LEVER, poses[..., :3, 2], 0.5 * poses[..., :3, 0]], axis=-1)


def pose_error(arm: Arm, poses: Floats, q: Floats) -> tuple[Floats, Floats]:
    """Error (m, 6) and Jacobian (m, 6, j), positions in LEVERs."""
    here = forward(arm.chain, arm.params, q)
    turn = Rotation.from_matrix(poses[:, :3, :3] @ here[:, :3, :3].swapaxes(-1, -2)).as_rotvec()
    scale = np.array([1 / LEVER] * 3 + [1.0] * 3)
    error = np.concatenate([poses[:, :3, 3] - here[:, :3, 3], turn], axis=-1) * scale
    return error, joint_jacobian(arm.chain, arm.params, q) * scale[:, None]
