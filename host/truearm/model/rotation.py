"""Rotation vectors, batched and differentiable: a device's orientation as a function of its three parameters.

R = exp([ω]×) is a rotation by |ω| about ω. To first order exp([ω + δω]×) = exp([J_l(ω) δω]×)·exp([ω]×): J_l(ω) maps a
change of the parameters to a small rotation about the base axes, which is Renders' Δφ (1991, (28)). With θ = |ω|

    exp = I + a [ω]× + b [ω]×²     a = sin θ/θ     b = (1 − cos θ)/θ²
    J_l = I + b [ω]× + c [ω]×²     c = (θ − sin θ)/θ³ .

a, b and c are analytic in θ², and near 0 they are summed as series, so complex steps are propagated.
"""

from __future__ import annotations

import math

import numpy as np

from truearm.types import Floats

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
