"""Inverse kinematics within one configuration branch of an arm: joint vectors for poses of the end.

Damped least squares solves all poses at once: Δq = Jᵀ(JJᵀ + λ²I)⁻¹e, where e is the pose error. It starts from the
nearest of many random poses of the branch. Solutions that leave the branch, or come close to a singularity, the robot's
own column or the table, are discarded. All results therefore lie in one branch, and the arm can move between any two of
them without passing a singularity of the elbow or the wrist.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from truearm.model.chain import Chain, end_and_jacobian, forward
from truearm.model.workspace import Branch
from truearm.types import Floats

N_SEEDS = 30_000
ITERATIONS = 12
DAMPING = 0.01
LEVER = 0.45  # m, makes metres comparable with radians
MIN_SINGULAR_VALUE = 0.05
TOLERANCE = 1e-7  # LEVERs, and rad


class Arm(NamedTuple):
    """A chain with the parameters (p,) of the controller's model, a branch, and random poses of it to start from."""

    chain: Chain
    params: Floats
    branch: Branch
    seeds: KDTree
    q_seeds: Floats


def make_arm(chain: Chain, params: Floats, branch: Branch, rng: np.random.Generator) -> Arm:
    """Return an arm with N_SEEDS random poses of its branch, indexed by the poses they reach."""
    q = rng.uniform(branch.lower, branch.upper, (N_SEEDS, len(branch.lower)))
    return Arm(chain, params, branch, KDTree(_features(forward(chain, params, q))), q)


def inverse(arm: Arm, poses: Floats) -> Floats:
    """Return joint vectors (m, j) for end poses (m, 4, 4); NaN where no acceptable solution was found."""
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
    """Return positions in LEVERs and two axes, (…, 9): the distance between two poses for inverse kinematics."""
    return np.concatenate([poses[..., :3, 3] / LEVER, poses[..., :3, 2], 0.5 * poses[..., :3, 0]], axis=-1)


def pose_error(arm: Arm, poses: Floats, q: Floats) -> tuple[Floats, Floats]:
    """Return the error (m, 6) and the Jacobian (m, 6, j), positions in LEVERs."""
    here, jacobian = end_and_jacobian(arm.chain, arm.params, q)
    turn = Rotation.from_matrix(poses[:, :3, :3] @ here[:, :3, :3].swapaxes(-1, -2)).as_rotvec()
    scale = np.array([1 / LEVER] * 3 + [1.0] * 3)
    error = np.concatenate([poses[:, :3, 3] - here[:, :3, 3], turn], axis=-1) * scale
    return error, jacobian * scale[:, None]
