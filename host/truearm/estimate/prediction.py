"""What an estimate says of single poses: how far the tool may be off there.

(Renders 1991, II-D, a posteriori). The measured point moves by J·Δ, so by the covariance P of the robot's parameters and of the
point's own place on the end, where the rig does not know it, its error has the mean square tr(J P Jᵀ) at a pose. Both belong
together: robot and target may be uncertain by metres and determine the point to a micrometre. Directions that the observations cannot see have no
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
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.estimate.problem import Rigs
from truearm.estimate.uncertainty import covariance_root
from truearm.kinds.registry import kinds
from truearm.model.chain import Chain, about, along, forward, point_jacobians, trace_point
from truearm.types import Estimate, Floats, ObservationTable, PredictedError, Rig

MOST_POSES = 500  # of a large table an even choice: the Jacobian, 1500 × 54, is then 0.6 MB
FIRST_ORDER = 0.2  # of the farthest point's distance from the base: a tenth of the figure is then left out
MOVES = 1e-6  # m, rad by a direction whose largest weight is 1; directions come out of an SVD with 1e-10


class PointCovariance(NamedTuple):
    """What is known of measured points: their places (n, 3), and the covariance (3n, 3n)'s root, ``half @ half.T``.

    ``relative``: without a motion of all points as one body.
    """

    points: Floats
    half: Floats  # (3n, k)
    relative: bool

    @property
    def covariances(self) -> Floats:
        """(n, 3, 3) m², in the base frame, of each point by itself."""
        own = self.half.reshape(len(self.points), 3, -1)
        return np.asarray(own @ own.swapaxes(1, 2))


def point_covariance(
    chain: Chain, rig: Rigs, table: ObservationTable, estimate: Estimate, any_base: bool = False
) -> PointCovariance | None:
    """Covariance of the points that the rows measure (spheres, targets), by that of the robot and of the points' places.

    ``any_base``: where the base stands is a choice of frame, so that a motion of all points as one body does not count.
    None where directions that the observations cannot see move the points otherwise.
    """
    params = estimate.value[: estimate.n_robot_parameters]
    places, columns = _measured_points(rig, table, estimate)
    points, by_robot, _ = point_jacobians(chain, params, table.q, places)
    jac = np.zeros((len(table), 3, estimate.value.size + 1))  # one more column, for what is known exactly
    jac[:, :, : params.size] = by_robot
    axes = forward(chain, params, table.q)[:, :3, :3]
    np.put_along_axis(jac, np.broadcast_to(columns[:, None], axes.shape), axes, axis=2)
    flat = jac[:, :, :-1].reshape(-1, estimate.value.size)
    unseen = flat @ _null_directions(estimate)
    relative = any_base or bool(np.abs(unseen).max(initial=0.0) > MOVES)
    half = flat @ covariance_root(estimate.covariance)
    if relative:
        body, _ = np.linalg.qr(body_motion(points))
        if np.abs(unseen - body @ (body.T @ unseen)).max(initial=0.0) > MOVES:
            return None
        half = half - body @ (body.T @ half)
    return PointCovariance(points, half, relative)


def predicted_point_error(
    chain: Chain, rig: Rigs, table: ObservationTable, estimate: Estimate, any_base: bool = False
) -> PredictedError | None:
    """Expected error of the point that the rows measure (sphere or target), over their poses.

    None where directions that the observations cannot see move the points, other than all as one body, or where the error would be so
    large that it is not determined.
    """
    rows = np.unique(np.linspace(0, len(table) - 1, min(len(table), MOST_POSES)).astype(int))
    found = point_covariance(chain, rig, table.select(rows), estimate, any_base)
    if found is None:
        return None
    variance = (found.half**2).sum(axis=1).reshape(-1, 3).sum(axis=1)
    worst = int(np.argmax(variance))
    if variance[worst] > (FIRST_ORDER * np.linalg.norm(found.points, axis=-1).max()) ** 2:
        return None
    return PredictedError(
        rms=float(np.sqrt(variance.mean())),
        largest=math.sqrt(variance[worst]),
        source=str(table.source[rows[worst]]),
        n=rows.size,
        relative=found.relative,
    )


class EndSigmas(NamedTuple):
    """Standard deviations of a point of the end, (n,) m, and of the end's orientation, (n,) rad: RMS norms of three axes.

    ``relative``: without a motion of all of them as one body.
    """

    position: Floats
    rotation: Floats
    relative: bool


class ParametersKnown(NamedTuple):
    """A chain with parameters (p,), their covariance (p, p), and the directions (p, d) that the observations did not see."""

    chain: Chain
    params: Floats
    covariance: Floats
    unseen: Floats


def end_sigmas(known: ParametersKnown, q: Floats, point: Floats, any_base: bool = False) -> EndSigmas | None:
    """What the parameters' covariance leaves unknown of a point (n, 3) of the end at joint readings q (n, j).

    ``any_base``: where the base stands is a choice of frame. None where directions that the observations did not see move the ends among each other, or
    where too few ends are left to tell that from a motion of the base.
    """
    root = covariance_root(known.covariance)
    parts = [slice(at, at + BLOCK) for at in range(0, len(q), BLOCK)]
    blocks = [_end_motion(known, q[part], point[part]) for part in parts]
    unseen = np.concatenate([jac @ known.unseen for jac, _ in blocks])
    half = np.concatenate([jac @ root for jac, _ in blocks])
    relative = any_base or bool(np.abs(unseen).max(initial=0.0) > MOVES)
    if relative:
        if len(q) < FEWEST_ENDS:
            return None
        body = np.concatenate([_twist_motion(at) for _, at in blocks])
        unseen, half = (_without(body, motion) for motion in (unseen, half))
        if np.abs(unseen).max(initial=0.0) > MOVES:
            return None
    square = (half**2).sum(axis=-1)
    return EndSigmas(np.sqrt(square[:, :3].sum(axis=1)), np.sqrt(square[:, 3:].sum(axis=1)), relative)


BLOCK = 4000  # poses whose derivatives, of 6 times 54 parameters, take 10 MB
FEWEST_ENDS = 3  # whose six numbers each are not all taken up by a motion of the base
LEVER = 0.5  # m: a turn of the end counts as the way of a point so far out


def _end_motion(known: ParametersKnown, q: Floats, point: Floats) -> tuple[Floats, Floats]:
    """(n, 6, p) how a point and the end's orientation move by the parameters, and the point (n, 3) in the base frame."""
    trace = trace_point(known.chain, known.params, q, point)
    axes = np.eye(3)[:, None]
    rows = [along(trace, axes).jac_params, about(trace, axes).jac_params]
    return np.concatenate(rows).swapaxes(0, 1), trace.p_base


def _twist_motion(points: Floats) -> Floats:
    """(n, 6, 6) how points and orientations move by a twist of the base."""
    turns = np.concatenate([np.zeros((3, 3)), np.eye(3)], axis=1)
    positions = body_motion(points).reshape(-1, 3, 6)
    return np.concatenate([positions, np.broadcast_to(turns, positions.shape)], axis=1)


def _without(body: Floats, motion: Floats) -> Floats:
    """Motions (n, 6, k) without what is a common motion of all, in the least squares with orientations at LEVER."""
    weight = np.array([1.0] * 3 + [LEVER] * 3)[:, None]
    flat = [(part * weight).reshape(-1, part.shape[2]) for part in (body, motion)]
    twist = np.linalg.lstsq(flat[0], flat[1], rcond=None)[0]
    return np.asarray(motion - body @ twist)


def _measured_points(rig: Rigs, table: ObservationTable, estimate: Estimate) -> tuple[Floats, NDArray[np.intp]]:
    """(n, 3) where on the end the sphere or target of each row is, as identified where it was; else the origin.

    And (n, 3) which parameters of the estimate these numbers are; their number, where they are none.
    """
    rigs: Mapping[str, Rig] = {"": rig} if isinstance(rig, Rig) else rig
    at = {name: i for i, name in enumerate(estimate.parameter_names)}
    values = np.append(estimate.value, np.nan)
    points, columns = np.zeros((len(table), 3)), np.full((len(table), 3), estimate.value.size)
    for name, one in rigs.items():
        prefix = f"{name}." if name else ""
        for kind, of in kinds().items():
            rows = (table.rig == name) & (table.kind == kind)
            known, column = of.points(one), table.column(of.point)
            for label, point in known.items():
                mine = rows & ((column == label) | ((column == "") & (len(known) == 1)))
                own = [at.get(f"{prefix}{of.point}.{label}.{k}", estimate.value.size) for k in "xyz"]
                columns[mine] = own
                points[mine] = np.where(np.isnan(values[own]), point.xyz, values[own])
    return points, columns


def _null_directions(estimate: Estimate) -> Floats:
    """(P, k) what cannot be seen; the largest weight of a direction is 1."""
    at = {name: i for i, name in enumerate(estimate.parameter_names)}
    out = np.zeros((len(at), len(estimate.null_space)))
    for k, direction in enumerate(estimate.null_space):
        for name, weight in zip(direction.names, direction.weights, strict=True):
            out[at[name], k] = weight
    return out


def body_motion(points: Floats) -> Floats:
    """(3n, 6) how points (n, 3) move by a twist (v; w) of the base: v + w × p."""
    turned = np.cross(np.eye(3), points[:, None, :]).swapaxes(1, 2)
    return np.concatenate([np.broadcast_to(np.eye(3), turned.shape), turned], axis=2).reshape(-1, 6)
