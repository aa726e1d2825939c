"""A target on the tool, measured as a point in a device's own axes: a tracker, or a line device (``line.py``).

Predicted is m = R_dᵀ (T(q)·s − p_d) with the device's pose (R_d, p_d) in the base frame; the residual stays in the
device's axes, where the sensors' covariance S_x is declared. With r = T(q)·s − p_d = R_d·m, moving the device by δp and
turning it by a small δφ about the base axes changes the prediction by

    δm = −R_dᵀ (δp + δφ × r) = −R_dᵀ (I, −[R_d m]×) (δp; δφ) ,

Renders' (1991) device Jacobian (27), (28) with its lever in base axes: the printed one has [m]×, right only for a device
parallel to the base. A device's parameters are x, y, z (p_d, m) and rx, ry, rz, a rotation vector ω about the base axes
away from the orientation R_r that the rig declares (the identity where it declares none): R_d = exp([ω]×)·R_r and
δφ = J_l(ω) δω.

The joints were truly at q(t) = q_reading(t + τ), to first order q_reading + q̇·τ; so ∂m/∂τ = J_q·q̇ and the residual's
derivative is −J_q·q̇.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from truearm.model.chain import Chain, PointTrace, along, trace_point
from truearm.model.transforms import cross
from truearm.observe.rotation import left_jacobian, rotation
from truearm.observe.rows import Indices, Linearised, gather, scatter
from truearm.types import Floats

WIDTH = 3  # scalar residuals an observation: x, y, z in the device's axes
STRAIGHT = 1e-9  # points that leave a line by 3e-5 of its length do not show the roll about it


@dataclass(frozen=True)
class PositionRows:
    """n measured points; indices point into x followed by ``constants``."""

    row: Indices  # (n,) rows of the table
    sensor_cov: Floats  # (n, 3) or (n, 3, 3) m², in the device's axes
    q: Floats  # (n, j)
    q_rate: Floats  # (n, j), 0 where the robot stood
    xyz: Floats  # (n, 3) measured, m, in the device's axes
    target: Indices  # (n, 3) in the end frame
    device: Indices  # (n, 6) x, y, z, rx, ry, rz
    reference: Floats  # (n, 3, 3) declared orientation R_r of the device
    time_offset: Indices  # (n, 1)
    constants: Floats


def evaluate(chain: Chain, rows: PositionRows, x: Floats) -> Linearised:
    """Residual (3n,), jac_params (3n, P), jac_joints (3n, j) at x (P,); x, y, z of a point follow each other."""
    q = joints_in_time(rows, x)
    trace = trace_point(chain, x[: len(chain.parameters)], q, gather(x, rows.constants, rows.target))
    device = gather(x, rows.constants, rows.device)
    rot = for_each(rotation, device[:, 3:]) @ rows.reference
    return in_device_axes(trace, rows, x, device, rot)


def joints_in_time(rows: PositionRows, x: Floats) -> Floats:
    """(n, j) the joint readings moved by the time offset."""
    return np.asarray(rows.q + rows.q_rate * gather(x, rows.constants, rows.time_offset))


def in_device_axes(trace: PointTrace, rows: PositionRows, x: Floats, device: Floats, rot: Floats) -> Linearised:
    """The residual and its derivatives for traced targets, devices (n, 6) and their orientations (n, 3, 3)."""
    n, j = rows.q.shape
    lever = trace.p_base - device[:, :3]  # r
    predicted = np.einsum("nik,ni->nk", rot, lever)
    turned = for_each(left_jacobian, device[:, 3:])
    dtype = np.result_type(x, float)
    jac, jac_joints = np.zeros((x.size, n, 3), dtype), np.empty((n, 3, j), dtype)
    for axis in range(3):
        u = rot[:, :, axis]
        columns = jac[:, :, axis].T
        derivative = along(trace, u, columns.T[: len(trace.chain.parameters)])
        scatter(columns, rows.target, derivative.jac_point)
        scatter(columns, rows.device[:, :3], -u)
        # −u·(δφ × r) = (u × r)·δφ
        scatter(columns, rows.device[:, 3:], np.einsum("ni,nik->nk", cross(u.T, lever.T).T, turned))
        scatter(columns, rows.time_offset, (derivative.jac_joints * rows.q_rate).sum(axis=1, keepdims=True))
        jac_joints[:, axis] = derivative.jac_joints
    return Linearised((rows.xyz - predicted).ravel(), jac.reshape(x.size, -1).T, jac_joints.reshape(-1, j))


def for_each(matrix: Callable[[Floats], Floats], turns: Floats) -> Floats:
    """(n, 3, 3) a matrix of each rotation vector (n, 3), computed once where all are the same: one device, as a rule."""
    if len(turns) and (turns == turns[0]).all():
        return np.broadcast_to(matrix(turns[0]), (len(turns), 3, 3))
    return matrix(turns)


def place(p_device: Floats, p_base: Floats, declared: Floats) -> tuple[Floats, Floats]:
    """The pose of a device that brings points (n, 3) of its own axes onto points of the base, by least squares.

    Returns its position (3,) and rotation (3, 3). What the points do not show of the orientation stays as ``declared``
    (3, 3): the roll about points on one line, all of it for a single point.
    """
    middle_device, middle_base = p_device.mean(axis=0), p_base.mean(axis=0)
    rot = nearest_rotation((p_base - middle_base).T @ (p_device - middle_device), declared)
    return middle_base - rot @ middle_device, rot


def nearest_rotation(correlation: Floats, declared: Floats, most: int = 2) -> Floats:
    """The rotation R (3, 3) of the largest tr(Rᵀ H); among equals the one turned least away from ``declared`` R_r.

    With ``correlation`` H (3, 3) = Σ p_base p_deviceᵀ = U S Vᵀ and two singular values that count, R = U diag(1, 1, ±1) Vᵀ
    (Arun, Huang, Blostein 1987; the sign keeps it a rotation). Of points on a line one counts: H says that v₁ is turned to
    u₁ and no more, so R = u₁v₁ᵀ + U⊥ Q V⊥ᵀ, with Q (2, 2) in the same way nearest to what R_r has there. Of a single point
    none counts, and R = R_r. ``most`` 1 lets but one count: the roll about the line is then the declared one, whatever
    the points say of it.
    """
    u, size, vt = np.linalg.svd(correlation)
    k = min(most, int((size > STRAIGHT * size[0]).sum()), 2)
    left, _, right = np.linalg.svd(u[:, k:].T @ declared @ vt[k:].T)
    left[:, -1] *= np.sign(np.linalg.det(u) * np.linalg.det(vt) * np.linalg.det(left) * np.linalg.det(right))
    return np.asarray(u[:, :k] @ vt[:k] + u[:, k:] @ left @ right @ vt[k:])
