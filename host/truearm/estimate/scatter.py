"""The arm's own scatter in a fit without joint laws: errors of joints and poses, learned by evidence, and what they do to σ.

The noise of ``pose_noise`` is learned as beside joint laws, of which there are none here. Parameters keep their
least-squares values: unmodelled errors that differ between the points of a pose would distort weights learned from
them. With Q = J S (P = S Sᵀ) and the learned covariance R of the whitened rows, which are declared as I, their
covariance is

    S (I + Qᵀ(R − I)Q) Sᵀ .

A prior, which is not based on any row, enters it as declared. That is done where at least half of the rows share their
pose with others; with fewer, as with check poses, single rows would decide. And only if the evidence says that the errors
are the arm's (``is_of_arm``).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from truearm.estimate.law_fit import LawProblem, Learned, law_problem, learn, nats_of_scatter
from truearm.estimate.pose_noise import MOTIONS, PoseNoise, pose_rows
from truearm.estimate.problem import Problem
from truearm.estimate.uncertainty import Goodness
from truearm.results import Scatter
from truearm.types import Floats, Indices

LEVEL = (
    0.05  # of the limit; variances cannot be negative, so noise of the sensors passes for the arm's in 1 of 300 fits
)
LEAST_SHARE = 0.5  # of the rows must share their pose with others
JOINT_NOISE = 1e-4  # rad, initial value


def learned_scatter(
    problem: Problem, x: Floats, columns: NDArray[np.bool_], pose: Indices, fit: Goodness
) -> Scatter | None:
    """Return the scatter of the arm at the estimate x (P,); ``pose`` (n_rows,) are the numbers of the rows' poses.

    None where declared noise explains a ``fit`` to poses of single rows: nothing is left for the arm.
    """
    if fit.explained and not shared_poses(problem, pose):
        return None
    laws_problem = law_problem(problem, columns, x, pose, {})
    return scatter_of(laws_problem, learn(laws_problem, PoseNoise.of(1.0, len(problem.chain.joints), JOINT_NOISE)))


def scatter_of(problem: LawProblem, learned: Learned) -> Scatter:
    """Return the scatter that was learned beside the laws of a problem."""
    noise, joints = learned.noise, problem.problem.chain.joints
    return Scatter(
        noise.sensor,
        math.sqrt(noise.shared),
        math.sqrt(noise.turned),
        dict(zip((joint.name for joint in joints), np.sqrt(noise.joint).tolist(), strict=True)),
        tuple(joint.name for joint in joints if joint.kind != "revolute"),
        nats_of_scatter(problem, learned),
        shared_poses(problem.problem, problem.pose),
        {},
    )


def is_of_arm(scatter: Scatter) -> bool:
    """Return whether noise of the sensors alone would seldom raise the evidence for errors of the arm so much.

    Twice the nats are then χ² (Wilks), of at most as many degrees of freedom as the arm's errors have variances.
    """
    return bool(2.0 * scatter.nats > chdtri(len(scatter.joint) + 2, LEVEL))


def covariance_with(
    scatter: Scatter, problem: Problem, x: Floats, columns: NDArray[np.bool_], root: Floats, pose: Indices
) -> Floats:
    """Return the covariance (k, k) of least-squares estimates at x (P,), where ``root`` (k, r) is S."""
    sigma = np.concatenate([np.repeat([scatter.shared, scatter.turned], MOTIONS), list(scatter.joint.values())])
    excess = np.eye(root.shape[1])
    for poses in pose_rows(problem, x, columns, pose):
        if not poses.is_knowledge:
            seen = poses.rows[..., :-1] @ root
            rows = seen.reshape(-1, root.shape[1])
            along = ((poses.moved * sigma).swapaxes(1, 2) @ seen).reshape(-1, root.shape[1])
            excess += max(scatter.factor - 1.0, 0.0) * rows.T @ rows + along.T @ along  # at least as declared
    return np.asarray(root @ excess @ root.T)


def shared_poses(problem: Problem, pose: Indices) -> int:
    """Return how many poses have several rows; 0 if fewer than half of the rows are in one of these."""
    rows = [group.row for group in problem.groups if group.row is not None]
    count = np.unique(pose[np.concatenate(rows)], return_counts=True)[1] if rows else np.zeros(0, np.intp)
    several = count[count > 1]
    return several.size if several.size and several.sum() >= LEAST_SHARE * count.sum() else 0
