"""What an estimate says of single poses: how far the tool may be off there.

(Renders 1991, II-D, a posteriori). The measured point moves by J·Δ, so by the parameters'
covariance P its error has the mean square tr(J P Jᵀ) at a pose. Directions that the observations cannot see have no
variance in P, and need none where they move no point. Two cases are told apart by the null directions N:

- J·N moves all points as one body. Then the observations (seats in sockets, a line device or tracker anywhere) do not
  say where the base stands, which nobody asked them. That motion, B = ∂points/∂(twist of the base), is projected out of J.
- It moves them among each other. Then no figure would be honest, and there is none.

Nor is there one where the first order says nothing any more. A point that may be off by a part f of its distance from the base may have
turned by an angle f, and what the linearisation leaves out is f/2 of what it says: above FIRST_ORDER the observations do not
determine where the tool is (flats alone, say, see a combination of turns with σ of many turns).
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from truearm.estimate.problem import Rigs
from truearm.kinds.registry import kinds
from truearm.model.chain import Chain, point_jacobians
from truearm.types import Estimate, Floats, ObservationTable, PredictedError, Rig

MOST_POSES = 500  # of a large table an even choice: the Jacobian, 1500 × 54, is then 0.6 MB
FIRST_ORDER = 0.2  # of the farthest point's distance from the base: a tenth of the figure is then left out
MOVES = 1e-6  # m, rad by a direction whose largest weight is 1; directions come out of an SVD with 1e-10


def predicted_point_error(
    chain: Chain, rig: Rigs, table: ObservationTable, estimate: Estimate
) -> PredictedError | None:
    """Expected error of the point that the rows measure (sphere or target), over their poses.

    None where directions that the observations cannot see move the points, other than all as one body, or where the error would be so
    large that it is not determined.
    """
    rows = np.unique(np.linspace(0, len(table) - 1, min(len(table), MOST_POSES)).astype(int))
    params = estimate.value[: estimate.n_robot_parameters]
    points, jac, _ = point_jacobians(chain, params, table.q[rows], _measured_points(rig, table, estimate)[rows])
    flat = jac.reshape(-1, params.size)
    unseen = flat @ _null_directions(estimate)
    relative = bool(np.abs(unseen).max(initial=0.0) > MOVES)
    if relative:
        body, _ = np.linalg.qr(body_motion(points))
        if np.abs(unseen - body @ (body.T @ unseen)).max() > MOVES:
            return None
        flat = flat - body @ (body.T @ flat)
    covariance = estimate.covariance[: params.size, : params.size]
    variance = np.maximum(np.einsum("np,np->n", flat @ covariance, flat), 0.0).reshape(-1, 3).sum(axis=1)
    worst = int(np.argmax(variance))
    if variance[worst] > (FIRST_ORDER * np.linalg.norm(points, axis=-1).max()) ** 2:
        return None
    return PredictedError(
        rms=float(np.sqrt(variance.mean())),
        largest=math.sqrt(variance[worst]),
        source=str(table.source[rows[worst]]),
        n=rows.size,
        relative=relative,
    )


def _measured_points(rig: Rigs, table: ObservationTable, estimate: Estimate) -> Floats:
    """(n, 3) where on the end the sphere or target of each row is, as identified where it was; else the origin."""
    rigs: Mapping[str, Rig] = {"": rig} if isinstance(rig, Rig) else rig
    found = dict(zip(estimate.parameter_names, estimate.value.tolist(), strict=True))
    points = np.zeros((len(table), 3))
    for name, one in rigs.items():
        prefix = f"{name}." if name else ""
        for kind, of in kinds().items():
            rows = (table.rig == name) & (table.kind == kind)
            known, column = of.points(one), table.column(of.point)
            for label, point in known.items():
                mine = rows & ((column == label) | ((column == "") & (len(known) == 1)))
                points[mine] = [
                    found.get(f"{prefix}{of.point}.{label}.{k}", value)
                    for k, value in zip("xyz", point.xyz, strict=True)
                ]
    return points


def _null_directions(estimate: Estimate) -> Floats:
    """(p, k) the robot's parts of what cannot be seen; the largest weight of a whole direction is 1."""
    at = {name: i for i, name in enumerate(estimate.parameter_names[: estimate.n_robot_parameters])}
    out = np.zeros((len(at), len(estimate.null_space)))
    for k, direction in enumerate(estimate.null_space):
        for name, weight in zip(direction.names, direction.weights, strict=True):
            if name in at:
                out[at[name], k] = weight
    return out


def body_motion(points: Floats) -> Floats:
    """(3n, 6) how points (n, 3) move by a twist (v; w) of the base: v + w × p."""
    turned = np.cross(np.eye(3), points[:, None, :]).swapaxes(1, 2)
    return np.concatenate([np.broadcast_to(np.eye(3), turned.shape), turned], axis=2).reshape(-1, 6)
