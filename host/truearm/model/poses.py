"""Poses (…, 4, 4): differences between poses, and poses moved by a difference.

A difference is (…, 6): position [m], then a rotation vector [rad], both in base axes. ``goal = moved(start, apart(goal,
start))``, that is R_goal = exp(w)·R_start. Angles of successive rotations must not be added; rotation vectors compose in
this way.
"""

from __future__ import annotations

import numpy as np

from truearm.model.rotation import rotation, rotation_vector
from truearm.types import Floats

Six = tuple[float, float, float, float, float, float]


def apart(goal: Floats, start: Floats) -> Floats:
    """Return the differences (n, 6) from poses ``start`` to ``goal`` (n, 4, 4)."""
    turn = rotation_vector(goal[:, :3, :3] @ start[:, :3, :3].swapaxes(-1, -2))
    return np.concatenate([goal[:, :3, 3] - start[:, :3, 3], turn], axis=-1)


def moved(start: Floats, by: Floats) -> Floats:
    """Return poses (n, 4, 4) moved by differences (n, 6) in base axes."""
    out = start.copy()
    out[:, :3, :3] = rotation(by[:, 3:]) @ start[:, :3, :3]
    out[:, :3, 3] += by[:, :3]
    return out


def pose_of(xyz: Floats, rotvec: Floats) -> Floats:
    """Return poses (n, 4, 4) at xyz (n, 3), rotated by rotation vectors rotvec (n, 3)."""
    out = np.tile(np.eye(4), (len(xyz), 1, 1))
    out[:, :3, :3] = rotation(rotvec)
    out[:, :3, 3] = xyz
    return out


def frame_of(six: Six) -> Floats:
    """Return the frame (4, 4) at a position [m], rotated by a rotation vector [rad]."""
    return np.asarray(pose_of(np.array([six[:3]]), np.array([six[3:]]))[0])


def position_and_rotation(pose: Floats) -> Floats:
    """Return positions and rotation vectors (n, 6) of poses (n, 4, 4): the inverse of ``pose_of``."""
    return np.concatenate([pose[:, :3, 3], rotation_vector(pose[:, :3, :3])], axis=1)


def inverted(pose: Floats) -> Floats:
    """Return the inverse (…, 4, 4) of rigid motions."""
    out = np.zeros_like(pose)
    turned = np.swapaxes(pose[..., :3, :3], -1, -2)
    out[..., :3, :3] = turned
    out[..., :3, 3] = -(turned @ pose[..., :3, 3:])[..., 0]
    out[..., 3, 3] = 1.0
    return out


def six_of(pose: Floats) -> Six:
    """Return x, y, z, α, β, γ [m, rad] of ``Trans(x, y, z)·Rz(α)·Ry(β)·Rx(γ)``; α, β, γ are a URDF's yaw, pitch, roll.

    At β = ±90° the pose determines only α ∓ γ; γ is then 0.
    """
    x, y, z = map(float, pose[:3, 3])
    r = pose[:3, :3]
    across = float(np.hypot(r[0, 0], r[1, 0]))
    beta = float(np.arctan2(-r[2, 0], across))
    if across < 1e-9:  # rounding of cos β is 1e-16; the angle is accurate to 1e-9 either way
        return x, y, z, float(np.arctan2(-r[0, 1], r[1, 1])), beta, 0.0
    return x, y, z, float(np.arctan2(r[1, 0], r[0, 0])), beta, float(np.arctan2(r[2, 1], r[2, 2]))
