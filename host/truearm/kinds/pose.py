"""A pose measured by a tracker: the target's position and the end frame's orientation, in the tracker's axes.

The first three residuals are those of ``position.py``. The measured orientation M (of the robot's end frame) and the
predicted one P = R_dᵀ·R(q) differ by the rotation vector ρ = log(M Pᵀ), measured − predicted to first order. A small
rotation δφ of the end about the base axes changes P to exp([R_dᵀδφ]×)P, so with log(exp(ρ)·exp(−δ)) = ρ − J_r⁻¹(ρ) δ
and J_r(ρ) = J_l(ρ)ᵀ

    ∂predicted = J_l(ρ)⁻ᵀ R_dᵀ (∂φ_end − ∂φ_device) .

The derivative of the end's rotation about a direction u by a parameter is the wrench of a pure couple u applied to that
parameter's twist (``chain.about``). Likewise, the derivative of a coordinate is that of a force (``chain.along``).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from truearm.kinds.columns import LARGEST_TURN_NOISE, POINT, SPREAD, TURN, Quantity
from truearm.kinds.group import Linearised, gather, linearised
from truearm.kinds.kind import Kind, RigUse, Scope, look_up, measured, refuse
from truearm.kinds.position import TRACKER, PositionRows, in_device_axes, joints_in_time, points_of
from truearm.kinds.rig_entries import TARGET
from truearm.model.chain import Chain, about, forward, trace_point
from truearm.model.transforms import left_jacobian, rotation, rotation_and_jacobian, rotation_vector
from truearm.types import Floats, Indices
from truearm.units import SMALLEST

TURN_SIGMA = Quantity("rotation_sigma", ("rotation_sigma",), "rad", LARGEST_TURN_NOISE, positive=True)


@dataclass(frozen=True, kw_only=True)
class PoseRows(PositionRows):
    """n measured poses: points and orientations of the end frame; ``sensor_cov`` is (n, 6) or (n, 6, 6)."""

    COMPONENTS = ("m", "m", "m", "rad", "rad", "rad")

    rotation: Floats  # (n, 3) measured rotation vector from the tracker's axes to the end frame, rad

    def evaluate(self, chain: Chain, x: Floats) -> Linearised:
        """Return residuals (6n,) and their derivatives at x (P,)."""
        q, params = joints_in_time(self, x), x[: len(chain.parameters)]
        trace = trace_point(chain, params, q, gather(x, self.constants, self.target))
        device = gather(x, self.constants, self.device)
        rot, turns = rotation_and_jacobian(device[:, 3:])
        rot = rot @ self.reference
        point = in_device_axes(trace, self, x, device, rot, turns)
        predicted = np.swapaxes(rot, 1, 2) @ forward(chain, params, q)[:, :3, :3]
        rho = rotation_vector(rotation(self.rotation) @ np.swapaxes(predicted, 1, 2))
        # Row k of J_l(ρ)⁻ᵀ R_dᵀ, as a direction in the base frame.
        directions = np.asarray(
            np.linalg.solve(np.swapaxes(left_jacobian(rho), 1, 2), np.swapaxes(rot, 1, 2)), dtype=float
        )
        axes = np.swapaxes(directions, 0, 1)
        derivative = about(trace, axes)
        by_time = (derivative.jac_joints * self.q_rate).sum(axis=2, keepdims=True)
        by_device = self.device[:, 3:], -np.einsum("wni,nik->wnk", axes, turns)
        turn = linearised(rho, derivative, x, by_device, (self.time_offset, by_time))
        return Linearised(
            np.concatenate([point.residual.reshape(-1, 3), rho], axis=1).ravel(),
            np.concatenate([point.wrenches, turn.wrenches]),
            point.basis,
            np.concatenate([point.jac_rig, turn.jac_rig]),
            np.concatenate([point.by_joints, turn.by_joints]),
        )


def use_rig(scope: Scope, rows: Indices) -> RigUse:
    """Return what the rows use of the rig: targets and trackers.

    A row's own standard deviation of the orientation takes precedence over that of its tracker.
    """
    trackers = scope.rig.trackers
    points = points_of(scope, rows, "tracker", trackers)
    labels, which = look_up(scope, rows, "tracker", trackers)
    turns = measured(scope, rows, TURN)
    row_sigma = scope.table[TURN_SIGMA.field][rows]
    of_tracker = np.array([trackers[str(label)].rotation_sigma or 0.0 for label in labels])[which]
    sigma = np.where(np.isnan(row_sigma), of_tracker, row_sigma)
    message = f"a pose row needs a rotation_sigma, its own or its tracker's, of {SMALLEST:g} rad or more"
    refuse(scope, rows, ~((sigma >= SMALLEST) & np.isfinite(sigma)), message)
    points["sensor_cov"] = _beside(points["sensor_cov"], sigma**2)
    return RigUse.of(PoseRows, scope, rows, **points, rotation=turns)


def _beside(cov: Floats, variance: Floats) -> Floats:
    """Return the covariance (n, 6) or (n, 6, 6) of points, (n, 3) or (n, 3, 3), and three angles of a variance (n,)."""
    angles = np.repeat(variance[:, None], 3, axis=1)
    if cov.ndim == 2:
        return np.concatenate([cov, angles], axis=1)
    out = np.zeros((len(cov), 6, 6))
    out[:, :3, :3] = cov
    out[:, range(3, 6), range(3, 6)] = angles
    return out


KIND = Kind(
    group=PoseRows,
    use_rig=use_rig,
    needs=("tracker", POINT, TURN),
    may=("target", SPREAD, TURN_SIGMA),
    entries=(TARGET, TRACKER),
    point="target",
    labels=("target",),
    grouped_by=("tracker", "target"),
    regions=("tracker",),
    name="tracked pose",
    residual={
        "m": "distance of the measured from the predicted point",
        "rad": "angle between the measured and the predicted orientation",
    },
)
