"""Rigid motions: the six elementary ones, rotation vectors, and poses.

R = exp([ω]×) is a rotation by |ω| about ω. To first order exp([ω + δω]×) = exp([J_l(ω) δω]×)·exp([ω]×): J_l(ω) maps a
change of the parameters to a small rotation about the base axes, which is Renders' Δφ (1991, (28)). With θ = |ω|

    exp = I + a [ω]× + b [ω]×²     a = sin θ/θ     b = (1 − cos θ)/θ²
    J_l = I + b [ω]× + c [ω]×²     c = (θ − sin θ)/θ³ .

a, b and c are analytic in θ², and near 0 they are summed as series, so complex steps are propagated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from truearm.types import Floats

MOTIONS = ("tx", "ty", "tz", "rx", "ry", "rz")


@dataclass(frozen=True)
class Element:
    """One elementary transform along or about ``motion``.

    Its amount is ``params[parameter]``, or the fixed ``value`` [m or rad] if ``parameter`` is None. For a ``joint`` (an
    index) the amount is the joint's true angle, and ``value`` is its offset unless the offset is a parameter.
    """

    motion: str
    value: float = 0.0
    parameter: int | None = None
    joint: int | None = None


def axis_of(motion: str) -> int:
    """Return 0, 1, 2 for a motion along or about x, y, z."""
    return "xyz".index(motion[1])


def elementary(motion: str, amount: Any) -> Floats:
    """Return the transform (…, 4, 4) that moves along or rotates about one axis by amount (…) [m or rad]."""
    amount, axis = np.asarray(amount), axis_of(motion)
    out = np.zeros((*amount.shape, 4, 4), dtype=np.result_type(amount, float))
    for k in range(4):
        out[..., k, k] = 1.0
    if motion[0] == "t":
        out[..., axis, 3] = amount
        return out
    a, b = (axis + 1) % 3, (axis + 2) % 3
    out[..., a, a] = out[..., b, b] = np.cos(amount)
    out[..., b, a] = np.sin(amount)
    out[..., a, b] = -out[..., b, a]
    return out


def mixed(axis: NDArray[np.intp], turns: NDArray[np.bool_], amount: Floats) -> Floats:
    """Return transforms (n, 4, 4) along each one's axis, or about it where ``turns``, by amount (n,)."""
    out = np.zeros((len(amount), 4, 4), dtype=np.result_type(amount, float))
    out[:, range(4), range(4)] = 1.0
    along, about = np.flatnonzero(~turns), np.flatnonzero(turns)
    out[along, axis[along], 3] = amount[along]
    a, b = (axis[about] + 1) % 3, (axis[about] + 2) % 3
    out[about, a, a] = out[about, b, b] = np.cos(amount[about])
    out[about, b, a] = np.sin(amount[about])
    out[about, a, b] = -out[about, b, a]
    return out


def cos_sin(angle: Floats) -> tuple[Floats, Floats]:
    """Return cosine and sine, computed from the tangent of the half angle, accurate to 3e-16.

    numpy's tan is vectorised where the machine supports it, unlike its sin and cos: 3 ns a pair instead of 20.
    """
    half = np.tan(0.5 * angle)
    square = half * half
    scale = 1.0 / (1.0 + square)
    return (1.0 - square) * scale, 2.0 * half * scale


def apply(transform: Floats, points: Floats) -> Floats:
    return transform[:3, :3] @ points + transform[:3, 3:]


def move(motion: str, amount: Floats, cos_sin: tuple[Floats, Floats], points: Floats) -> Floats:
    """Apply a joint's motion to points (3, n)."""
    if motion[0] == "r":
        return turn(motion, *cos_sin, points)
    moved = np.array(np.broadcast_to(points, (3, amount.size)), dtype=np.result_type(points, amount))
    moved[axis_of(motion)] += amount
    return moved


def turn(motion: str, cos: Floats, sin: Floats, vectors: Floats) -> Floats:
    """Rotate vectors (3, …, n) about the axis of a motion such as "rz", by angles (n,) with these cosines and sines."""
    k = axis_of(motion)
    a, b = (k + 1) % 3, (k + 2) % 3
    out = np.empty((*vectors.shape[:-1], cos.size), dtype=np.result_type(cos, vectors))
    out[k] = vectors[k]
    out[a] = cos * vectors[a] - sin * vectors[b]
    out[b] = sin * vectors[a] + cos * vectors[b]
    return out


def cross(a: Floats, b: Floats) -> Floats:
    """Return a × b for (3, …); numpy's cross reorders axes and takes four times as long."""
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


# ------------------------------------------------------------------------- rotation vectors, batched and differentiable

SERIES_BELOW = 0.1  # θ²: eight terms leave 0.1⁸/19! ≈ 1e-25; above it θ − sin θ has lost less than three digits
TERMS = np.array([[1.0 / math.factorial(2 * i + k) for k in (1, 2, 3)] for i in reversed(range(8))])


def skew(vector: Floats) -> Floats:
    """Return [v]× (…, 3, 3) of v (…, 3), so that [v]× w = v × w."""
    vector = np.asarray(vector)
    out = np.zeros((*vector.shape, 3), dtype=vector.dtype)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[..., j, k], out[..., k, j] = -vector[..., i], vector[..., i]
    return out


def rotation(vector: Floats) -> Floats:
    """Return exp([ω]×) (…, 3, 3) of rotation vectors (…, 3) [rad]."""
    a, b, _ = _coefficients(vector)
    return _series(vector, a, b)


def left_jacobian(vector: Floats) -> Floats:
    """Return J_l(ω) (…, 3, 3): the small rotation about the base axes per change of the rotation vector (…, 3)."""
    _, b, c = _coefficients(vector)
    return _series(vector, b, c)


def rotation_and_jacobian(vector: Floats) -> tuple[Floats, Floats]:
    """Return ``rotation`` and ``left_jacobian`` of the same vectors (…, 3)."""
    a, b, c = _coefficients(vector)
    return _series(vector, a, b), _series(vector, b, c)


def screw(twist: Floats) -> tuple[Floats, Floats]:
    """Return the rotation (3, 3) and shift (3,) [m] of the motion exp(ξ) by a twist ξ = (ω, v) (6,) [rad, m]."""
    omega, v = twist[:3], twist[3:]
    rot, jacobian = rotation_and_jacobian(omega)
    return rot, jacobian @ v


def turned(vector: Floats, change: Floats) -> Floats:
    """Return rotation vectors (…, 3), |ω| ≤ π, after the small rotations J_l(ω)·change, for changes (…, 3)."""
    rot, jacobian = rotation_and_jacobian(vector)
    turn = (jacobian @ change[..., None])[..., 0]
    return rotation_vector(rotation(turn) @ rot)


def rotation_vector(rot: Floats) -> Floats:
    """Return ω (…, 3) with exp([ω]×) = rot (…, 3, 3) and |ω| ≤ π.

    Computed from the unit quaternion, starting with its largest component from the diagonal: no angle loses digits.
    """
    rot = np.asarray(rot, dtype=float)
    m = rot.transpose(-2, -1, *range(rot.ndim - 2))
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    # Four times the outer product of the quaternion (x, y, z, w) with itself: every row is a multiple of it.
    outer = np.empty((*m.shape[2:], 4, 4))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        outer[..., i, i] = 1.0 + 2.0 * m[i, i] - trace
        outer[..., i, j] = outer[..., j, i] = m[i, j] + m[j, i]
        outer[..., i, 3] = outer[..., 3, i] = m[k, j] - m[j, k]
    outer[..., 3, 3] = 1.0 + trace
    best = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), axis=-1)
    quaternion = np.take_along_axis(outer, best[..., None, None], axis=-2)[..., 0, :]
    quaternion *= np.where(quaternion[..., 3:] < 0.0, -1.0, 1.0)
    xyz, w = quaternion[..., :3], quaternion[..., 3]
    size = np.linalg.norm(xyz, axis=-1)
    turned = size > 0.0
    per_size = np.where(turned, 2.0 * np.arctan2(size, w) / np.where(turned, size, 1.0), 2.0 / np.where(turned, 1.0, w))
    return np.asarray(per_size[..., None] * xyz)


def _series(vector: Floats, first: Floats, second: Floats) -> Floats:
    """Return I + first [ω]× + second [ω]×², with [ω]×² = ωωᵀ − θ² I."""
    vector = np.asarray(vector)
    square = vector[..., :, None] * vector[..., None, :]
    theta2 = (vector * vector).sum(axis=-1)
    eye = (1.0 - second * theta2)[..., None, None] * np.eye(3)
    return np.asarray(eye + first[..., None, None] * skew(vector) + second[..., None, None] * square)


def _coefficients(vector: Floats) -> tuple[Floats, Floats, Floats]:
    """Return a, b and c (…) as defined in the module docstring."""
    vector = np.asarray(vector)
    t = (vector * vector).sum(axis=-1)
    is_small = np.abs(t) < SERIES_BELOW
    if is_small.all():
        a, b, c = _taylor(t)
        return a, b, c
    theta = np.sqrt(np.where(is_small, 1.0, t))
    sine, half = np.sin(theta), np.sin(theta / 2.0)
    exact = (sine / theta, 2.0 * (half / theta) ** 2, (theta - sine) / theta**3)
    if not is_small.any():
        return exact
    a, b, c = np.where(is_small, _taylor(t), exact)
    return a, b, c


def _taylor(t: Floats) -> Floats:
    """Return Σ (−t)^i / (2i + k)! for k = 1, 2, 3, as (3, …)."""
    total = np.zeros_like(t)
    for terms in TERMS:
        total = terms.reshape(3, *(1,) * t.ndim) - t * total
    return total


# ------------------------------------------------------------------------------------------------------ poses (…, 4, 4)

Six = tuple[float, float, float, float, float, float]


def apart(goal: Floats, start: Floats) -> Floats:
    """Return the differences (n, 6) from poses ``start`` to ``goal`` (n, 4, 4).

    These are position [m], then a rotation vector [rad], both in base axes: R_goal = exp(w)·R_start. Angles of
    successive rotations must not be added; rotation vectors compose in this way.
    """
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
