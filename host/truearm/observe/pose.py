"""A pose measured by a tracker: the target's position and the end frame's orientation, in the tracker's axes.

The first three residuals are those of ``position.py``. The measured orientation M (of the robot's end frame) and the
predicted one P = R_dᵀ·R(q) differ by the rotation vector ρ = log(M Pᵀ), measured − predicted to first order. A small
turn δφ of the end about the base axes makes P exp([R_dᵀδφ]×)P, so with log(exp(ρ)·exp(−δ)) = ρ − J_r⁻¹(ρ) δ and
J_r(ρ) = J_l(ρ)ᵀ

    ∂predicted = J_l(ρ)⁻ᵀ R_dᵀ (∂φ_end − ∂φ_device) .

The end's turn about a direction u per parameter is the wrench of a pure couple u on that parameter's twist
(``about``), as a coordinate's derivative is that of a force (``chain.along``).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from truearm.model.chain import Chain, PointTrace, Rows, forward, trace_point
from truearm.model.transforms import axis_of, turn
from truearm.observe.position import PositionRows, in_device_axes, joints_in_time
from truearm.observe.rotation import left_jacobian, rotation, rotation_vector
from truearm.observe.rows import Linearised, gather, scatter, widen
from truearm.types import Floats

WIDTH = 6  # scalar residuals an observation: x, y, z [m] and a rotation vector [rad], in the tracker's axes


@dataclass(frozen=True)
class PoseRows(PositionRows):
    """n measured poses: points, and orientations of the end frame; ``sensor_cov`` is (n, 6) or (n, 6, 6)."""

    rotation: Floats  # (n, 3) measured rotation vector from the tracker's axes to the end frame, rad


def evaluate(chain: Chain, rows: PoseRows, x: Floats) -> Linearised:
    """Residual (6n,), jac_params (6n, P), jac_joints (6n, j) at x (P,); the six of a pose follow each other."""
    q, params = joints_in_time(rows, x), x[: len(chain.parameters)]
    trace = trace_point(chain, params, q, gather(x, rows.constants, rows.target))
    device = gather(x, rows.constants, rows.device)
    rot = rotation(device[:, 3:]) @ rows.reference
    point = in_device_axes(trace, rows, x, device, rot)
    predicted = np.swapaxes(rot, 1, 2) @ forward(chain, params, q)[:, :3, :3]
    rho = rotation_vector(rotation(rows.rotation) @ np.swapaxes(predicted, 1, 2))
    # Row k of J_l(ρ)⁻ᵀ R_dᵀ, as a direction in the base frame.
    directions = np.asarray(np.linalg.solve(np.swapaxes(left_jacobian(rho), 1, 2), np.swapaxes(rot, 1, 2)), dtype=float)
    turned = left_jacobian(device[:, 3:])
    jac, jac_joints = np.empty((len(q), 6, x.size)), np.empty((len(q), 6, q.shape[1]))
    jac[:, :3], jac_joints[:, :3] = point.jac_params.reshape(-1, 3, x.size), point.jac_joints.reshape(-1, 3, q.shape[1])
    for k in range(3):
        u: Floats = directions[:, k]
        derivative = about(trace, u)
        columns = widen(derivative.jac_params, x.size)
        scatter(columns, rows.device[:, 3:], -np.einsum("ni,nik->nk", u, turned))
        scatter(columns, rows.time_offset, (derivative.jac_joints * rows.q_rate).sum(axis=1, keepdims=True))
        jac[:, 3 + k], jac_joints[:, 3 + k] = columns, derivative.jac_joints
    residual = np.concatenate([point.residual.reshape(-1, 3), rho], axis=1)
    return Linearised(residual.ravel(), jac.reshape(-1, x.size), jac_joints.reshape(-1, q.shape[1]))


def about(trace: PointTrace, direction: Floats) -> Rows:
    """Derivatives of the end's turn about a direction (n, 3) of the base frame, as ``along`` has them of a coordinate.

    ``jac_point`` is zero: where the point lies on the end does not matter.
    """
    chain, n = trace.chain, trace.q.shape[0]
    u = np.broadcast_to(np.asarray(direction).reshape(-1, 3).T, (3, n))
    jac_params, jac_joints = np.zeros((len(chain.parameters), n)), np.zeros((len(chain.joints), n))
    for i, link in enumerate(trace.links):
        u = link.transform[:3, :3].T @ u
        jac_params[list(link.columns)] = link.twists[3:].T @ u
        if i == len(chain.joints) or chain.movers[i].motion[0] == "t":
            continue
        mover = chain.movers[i]
        on_axis = u[axis_of(mover.motion)]
        if mover.parameter is not None:
            jac_params[mover.parameter] = on_axis
        if mover.gain is not None:
            jac_params[mover.gain] = on_axis * trace.q[:, i]
        jac_joints[i] = on_axis * trace.gains[i]
        cos, sin = trace.cos_sin[i]
        u = turn(mover.motion, cos, -sin, u)
    return Rows(jac_params.T, jac_joints.T, np.zeros((n, 3)))
