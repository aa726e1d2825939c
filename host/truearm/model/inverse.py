"""Inverse kinematics of any chain: joint readings that bring the end to a pose, or its origin to a point.

Levenberg–Marquardt on the pose error e (position, rotation vector), all targets at once, with the damping of Sugihara
(IEEE Transactions on Robotics 27, 2011, 984):

    Δq = Jᵀ·(J·Jᵀ + ½‖e‖²·I)⁻¹·e .

Far away, the damping keeps the steps short. Near the solution it vanishes, and the steps are Newton's: the error is
squared at each step, down to rounding. For a robot with more joints than needed, and for a target without orientation,
the joint motion from the starting point is the smallest.

The smallest singular value of the Jacobian shows how close a singularity is: an error of one moves the joints by 1/σ.
Here metres count in units of LEVER, to make a rotation of the wrist comparable with a motion of the arm.
"""

from __future__ import annotations

import numpy as np

from truearm.model.chain import Chain, end_and_jacobian
from truearm.model.transforms import apart
from truearm.types import Floats

LEVER = 0.5  # m
MAX_STEPS = 100
# Rounding leaves 1e-16 for an arm of one metre; as damping, it exceeds that of J·Jᵀ.
REACHED = 1e-12  # LEVERs and rad, of ‖e‖
STATIONARY = 0.01  # of ‖e‖: a step that moves no joint by more reduces the error hardly
CHUNK = 2_000  # targets solved at once: Jacobians of 1 MB


def inverse(
    chain: Chain,
    params: Floats,
    targets: Floats,
    q_start: Floats,
    oriented: bool = True,
    bounded: bool = False,
    steps: int = MAX_STEPS,
) -> Floats:
    """Return the solutions (n, j) for targets (n, 4, 4) that are nearest downhill from q_start (n, j), NaN for none.

    oriented : False if only the origin matters. bounded : True if no step may leave the joint limits, within which
        q_start must be; otherwise limits are ignored.
    """
    chunks = [slice(first, first + CHUNK) for first in range(0, max(len(targets), 1), CHUNK)]
    return np.concatenate([_inverse(chain, params, targets[c], q_start[c], oriented, bounded, steps) for c in chunks])


def _inverse(
    chain: Chain, params: Floats, targets: Floats, q_start: Floats, oriented: bool, bounded: bool, steps: int
) -> Floats:
    q = np.array(q_start, dtype=float)
    error, jac = error_and_jacobian(chain, params, targets, q, oriented)
    size = np.linalg.norm(error, axis=-1)
    moving = size > REACHED
    for _ in range(steps):
        rows = np.flatnonzero(moving)
        if not rows.size:
            break
        step = _bounded_step(chain, q[rows], jac[rows], error[rows]) if bounded else _step(jac[rows], error[rows])
        q[rows] += step
        moving[rows] = np.abs(step).max(axis=-1) > STATIONARY * size[rows]
        error[rows], jac[rows] = error_and_jacobian(chain, params, targets[rows], q[rows], oriented)
        size[rows] = np.linalg.norm(error[rows], axis=-1)
        moving &= size > REACHED
    return np.where((size <= REACHED)[:, None], chain.completed(q), np.nan)


def error_and_jacobian(
    chain: Chain, params: Floats, targets: Floats, q: Floats, oriented: bool = True, lever: float = LEVER
) -> tuple[Floats, Floats]:
    """Return the error towards the targets (n, 6), and ``jacobian``."""
    pose, jac = end_and_jacobian(chain, params, q)
    rows, scale = slice(None, 6 if oriented else 3), np.repeat([1.0 / lever, 1.0], 3)
    return (scale * apart(targets, pose))[:, rows], (scale[:, None] * jac)[:, rows]


def jacobian(chain: Chain, params: Floats, q: Floats, oriented: bool = True, lever: float = LEVER) -> Floats:
    """Return the Jacobian (n, 6, j), or (n, 3, j) for the position alone, with positions in ``lever`` [m]."""
    jac = end_and_jacobian(chain, params, np.nan_to_num(q))[1]  # LAPACK fails at NaN
    return (np.repeat([1.0 / lever, 1.0], 3)[:, None] * jac)[:, : 6 if oriented else 3]


def singular_value(chain: Chain, params: Floats, q: Floats, oriented: bool = True, lever: float = LEVER) -> Floats:
    """Return the smallest singular value (n,) of ``jacobian`` by the joints that move on their own.

    NaN if q (n, j) is.
    """
    chunks = [slice(first, first + CHUNK) for first in range(0, max(len(q), 1), CHUNK)]
    jacs = (jacobian(chain, params, q[rows], oriented, lever)[..., chain.motors] for rows in chunks)
    smallest = np.concatenate([np.linalg.svd(jac, compute_uv=False)[:, -1] for jac in jacs])
    return np.where(np.isnan(q).any(axis=-1), np.nan, smallest)


def _bounded_step(chain: Chain, q: Floats, jac: Floats, error: Floats) -> Floats:
    """Return the step (n, j) by which a joint stops at its limit; from there the others move alone."""
    lower, upper = chain.limits
    step = _step(jac, error)
    for _ in range(q.shape[1]):
        stopped = ((step < 0.0) & (q <= lower)) | ((step > 0.0) & (q >= upper))
        if not stopped.any():
            break
        jac = np.where(stopped[:, None], 0.0, jac)
        step = _step(jac, error)
    return np.clip(q + step, lower, upper) - q


def _step(jac: Floats, error: Floats) -> Floats:
    damping = 0.5 * (error**2).sum(axis=-1) + REACHED
    normal = jac @ jac.swapaxes(-1, -2) + damping[:, None, None] * np.eye(jac.shape[-2])
    return np.asarray((jac.swapaxes(-1, -2) @ np.linalg.solve(normal, error[..., None]))[..., 0])
