"""Predicted error of the tool at individual poses, from an estimate (Renders 1991, II-D, a posteriori).

With P the covariance of the robot's parameters and of the point's position on the end, the error at a pose has the mean
square

    tr(J P Jᵀ) ,

plus that of the arm's own scatter, where it was learned. Null directions N have no variance in P:

- If J·N moves all points as one rigid body, the observations do not determine the pose of the base. That motion, B =
  ∂points/∂(twist of the base), is projected out of J.
- If J·N moves the points relative to each other, no figure is given.

N must be complete: the printed ones lack parts of 1e-6. No figure is given either above FIRST_ORDER, where
linearisation fails.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.estimate.law_fit import is_of_arm
from truearm.estimate.uncertainty import covariance_root
from truearm.kinds.position import nearest_rotation
from truearm.kinds.registry import kinds
from truearm.kinds.table import ObservationTable
from truearm.model.chain import Chain, about, along, forward, point_forward, point_jacobians, trace_point
from truearm.results import MOVES, Estimate, PredictedError, Scatter
from truearm.types import Floats, Rigs, rigs_by_name, rms, thinned

MOST_POSES = 500  # evenly spaced ones of a large table: the Jacobian, 1500 × 54, is then 0.6 MB
FIRST_ORDER = 0.2  # of the farthest point's distance from the base: a tenth of the result is then neglected
BLOCK = 4000  # poses; their derivatives, 6 times 54 parameters, take 10 MB
FEWEST_ENDS = 3  # so that a motion of the base does not account for all of their six numbers each
WEIGHTS = np.array(
    [1.0] * 3 + [0.5] * 3
)  # a rotation of the end counts as the displacement of a point half a metre away


class PointCovariance(NamedTuple):
    """Positions of measured points (n, 3), and the root of their covariance (3n, 3n), ``half @ half.T``.

    ``relative``: without a motion of all points as one rigid body.
    """

    points: Floats
    half: Floats  # (3n, k)
    relative: bool

    @property
    def covariances(self) -> Floats:
        """Return the covariances (n, 3, 3) m², in the base frame, of individual points."""
        roots = self.half.reshape(len(self.points), 3, -1)
        return np.asarray(roots @ roots.swapaxes(1, 2))


def measured_jacobian(chain: Chain, rig: Rigs, table: ObservationTable, estimate: Estimate) -> tuple[Floats, Floats]:
    """Return the points (n, 3) that the rows measure, and their derivatives (3n, p) by all parameters, row by row."""
    params = estimate.value[: estimate.n_robot_parameters]
    places, columns = measured_points(rig, table, estimate)
    points, by_robot, _ = point_jacobians(chain, params, table.q, places)
    jac = np.zeros((len(table), 3, estimate.value.size + 1))  # one more column, for values known exactly
    jac[:, :, : params.size] = by_robot
    axes = forward(chain, params, table.q)[:, :3, :3]
    np.put_along_axis(jac, np.broadcast_to(columns[:, None], axes.shape), axes, axis=2)
    flat = jac[:, :, :-1].reshape(-1, estimate.value.size)
    return points, flat


def point_covariance(
    chain: Chain, rig: Rigs, table: ObservationTable, estimate: Estimate, any_base: bool = False
) -> PointCovariance | None:
    """Return the covariance of the points that the rows measure (spheres, targets), from that of robot and positions.

    ``any_base``: the pose of the base is a choice of frame, so a motion of all points as one rigid body does not count.
    None if null directions of the observations move the points in any other way.
    """
    points, jac = measured_jacobian(chain, rig, table, estimate)
    return seen_covariance(points, jac @ estimate.unseen, jac @ covariance_root(estimate.covariance), any_base)


def seen_covariance(points: Floats, unseen: Floats, half: Floats, any_base: bool) -> PointCovariance | None:
    """Return ``point_covariance`` of points (n, 3) that null directions move by ``unseen`` (3n, d) m."""
    motion = _motion(half, unseen, body_motion(points), any_base)
    return None if motion is None else PointCovariance(points, *motion)


def _motion(half: Floats, unseen: Floats, body: Floats, any_base: bool) -> tuple[Floats, bool] | None:
    """Return the root ``half`` (m, k) of a covariance, and whether it is without a motion of the base, ``body`` (m, 6).

    That is so with ``any_base``, or if null directions cause such a motion. ``unseen`` (m, d) are their motions. None
    if they have any other.
    """
    relative = any_base or bool(np.abs(unseen).max(initial=0.0) > MOVES)
    if relative:
        basis, _ = np.linalg.qr(body)
        half, unseen = (columns - basis @ (basis.T @ columns) for columns in (half, unseen))
        if np.abs(unseen).max(initial=0.0) > MOVES:
            return None
    return half, relative


def predicted_point_error(
    chain: Chain, rig: Rigs, table: ObservationTable, estimate: Estimate, any_base: bool = False
) -> PredictedError | None:
    """Return the expected error of the point that the rows measure (sphere or target), over their poses.

    It includes the arm's own scatter, where that was learned.

    None if null directions of the observations move the points other than as one rigid body, or if the error would be
    so large that it is undetermined.
    """
    rows = thinned(len(table), MOST_POSES)
    positions = point_covariance(chain, rig, table.select(rows), estimate, any_base)
    if positions is None:
        return None
    scatter = _scatter(chain, rig, table.select(rows), estimate)
    variance = (positions.half**2).sum(axis=1).reshape(-1, 3).sum(axis=1) + scatter
    worst = int(np.argmax(variance))
    if variance[worst] > (FIRST_ORDER * np.linalg.norm(positions.points, axis=-1).max()) ** 2:
        return None
    return PredictedError(
        rms=float(np.sqrt(variance.mean())),
        max=math.sqrt(variance[worst]),
        at=str(table.source[rows[worst]]),
        n=rows.size,
        relative=positions.relative,
        scatter=float(np.sqrt(scatter.mean())),
    )


def _scatter(chain: Chain, rig: Rigs, table: ObservationTable, estimate: Estimate) -> Floats:
    """Return the mean square (n,) [m²] of the arm's own scatter at the measured points, where it was learned.

    0 elsewhere.

    It is the error that the poses do not share: of each joint, and of a motion of the last link. Faults that explain
    the residuals pass for scatter, and are stated for themselves.
    """
    scatter = estimate.scatter
    learned_beside_faults = not estimate.faults or estimate.law_parameters  # laws are chosen beside them
    if scatter is None or not learned_beside_faults or not is_of_arm(scatter):
        return np.zeros(len(table))
    places, by_joints = _joint_motion(chain, rig, table, estimate, scatter)
    of_link = 3.0 * scatter.shared**2 + 2.0 * scatter.turned**2 * (places**2).sum(axis=1)
    return np.asarray(of_link + (by_joints**2).sum(axis=(1, 2)))


def _joint_motion(
    chain: Chain, rig: Rigs, table: ObservationTable, estimate: Estimate, scatter: Scatter
) -> tuple[Floats, Floats]:
    """Return the places (n, 3) of the measured points on the end, and their motion (n, 3, j) [m] by each joint's σ."""
    places, _ = measured_points(rig, table, estimate)
    _, _, by_joints = point_jacobians(chain, estimate.value[: estimate.n_robot_parameters], table.q, places)
    return places, by_joints * [scatter.joint[joint.name] for joint in chain.joints]


def with_scatter_at_tool(chain: Chain, rig: Rigs, table: ObservationTable, estimate: Estimate) -> Estimate:
    """Return the estimate with the motion of the measured points by each joint's scatter, where that was learned.

    A point near a joint's axis shows this motion alone, and any angle.
    """
    if estimate.scatter is None:
        return estimate
    poses = table.select(thinned(len(table), MOST_POSES))
    _, motion = _joint_motion(chain, rig, poses, estimate, estimate.scatter)
    sizes = np.sqrt((motion**2).sum(axis=1).mean(axis=0)).tolist()
    at_tool = dict(zip((joint.name for joint in chain.joints), sizes, strict=True))
    return replace(estimate, scatter=estimate.scatter._replace(at_tool=at_tool))


def nominal_error(chain: Chain, rig: Rigs, table: ObservationTable, estimate: Estimate) -> Floats:
    """Return the distances (n,) [m] between the measured points of nominal and identified robot, over their poses."""
    poses = table.select(thinned(len(table), MOST_POSES))
    return np.asarray(np.linalg.norm(nominal_gap(chain, rig, poses, estimate), axis=1))


def nominal_gap(chain: Chain, rig: Rigs, table: ObservationTable, estimate: Estimate) -> Floats:
    """Return the vectors (n, 3) [m] in the base frame from the nominal robot's measured points to the identified ones.

    The nominal robot's base is placed by all points, and its point on the end too: how they are mounted does not count.
    """
    params = estimate.value[: estimate.n_robot_parameters]
    places, _ = measured_points(rig, table, estimate)
    points, nominal = (point_forward(chain, p, table.q, places) for p in (params, estimate.nominal[: len(params)]))
    turned = (nominal - nominal.mean(axis=0)) @ nearest_rotation(
        (points - points.mean(axis=0)).T @ (nominal - nominal.mean(axis=0)), np.eye(3)
    ).T
    gap = (points - points.mean(axis=0) - turned).ravel()
    mounting = np.concatenate([body_motion(points), forward(chain, params, table.q)[:, :3, :3].reshape(-1, 3)], axis=1)
    gap -= mounting @ np.linalg.lstsq(mounting, gap, rcond=None)[0]
    return np.asarray(gap.reshape(-1, 3))


class EndSigmas(NamedTuple):
    """Standard deviations of a point of the end (n,) [m] and of its orientation (n,) [rad].

    They are RMS norms of three axes.

    ``relative``: without a motion of all of them as one rigid body.
    """

    position: Floats
    rotation: Floats
    relative: bool


class ParametersKnown(NamedTuple):
    """A chain with parameters (p,), their covariance (p, p), and the null directions (p, d) of the observations."""

    chain: Chain
    params: Floats
    covariance: Floats
    unseen: Floats


def end_sigmas(known: ParametersKnown, q: Floats, point: Floats, any_base: bool = False) -> EndSigmas | None:
    """Return the standard deviations of a point (n, 3) of the end at joint readings q (n, j) from the covariance.

    ``any_base``: the pose of the base is a choice of frame. None if null directions of the observations move the ends
    relative to each other, or if there are too few ends to distinguish that from a motion of the base.
    """
    directions = np.concatenate([covariance_root(known.covariance), known.unseen], axis=1)
    motions, twists = [], []
    for first in range(0, len(q), BLOCK):
        block = slice(first, first + BLOCK)
        trace = trace_point(known.chain, known.params, q[block], point[block])
        by_params = [motion(trace, np.eye(3)[:, None]).jac_params for motion in (along, about)]
        motions.append(np.concatenate(by_params).swapaxes(0, 1) @ directions)
        shift = body_motion(trace.p_base).reshape(-1, 3, 6)
        turn = np.concatenate([np.zeros((3, 3)), np.eye(3)], axis=1)
        twists.append(np.concatenate([shift, np.broadcast_to(turn, shift.shape)], axis=1))
    weighted = (np.concatenate(columns) * WEIGHTS[:, None] for columns in (motions, twists))
    flat, body = (columns.reshape(6 * len(q), columns.shape[2]) for columns in weighted)
    half, unseen = np.split(flat, [known.covariance.shape[0]], axis=1)
    motion = _motion(half, unseen, body, any_base)
    if motion is None or (motion[1] and len(q) < FEWEST_ENDS):
        return None
    square = (motion[0] ** 2).sum(axis=1).reshape(-1, 6) / WEIGHTS**2
    return EndSigmas(np.sqrt(square[:, :3].sum(axis=1)), np.sqrt(square[:, 3:].sum(axis=1)), motion[1])


def measured_points(rig: Rigs, table: ObservationTable, estimate: Estimate) -> tuple[Floats, NDArray[np.intp]]:
    """Return the position (n, 3) on the end of each row's sphere or target, as identified if it was.

    Also returns the indices (n, 3) of these numbers in the estimate's parameters; their count if they are not
    parameters.
    """
    index = {name: i for i, name in enumerate(estimate.parameter_names)}
    values = np.append(estimate.value, np.nan)
    points, columns = np.zeros((len(table), 3)), np.full((len(table), 3), estimate.value.size)
    for name, entries in rigs_by_name(rig).items():
        prefix = f"{name}." if name else ""
        for name_of_kind, kind in kinds().items():
            rows = (table.rig == name) & (table.kind == name_of_kind)
            labelled_points = kind.points(entries)
            for label, point in labelled_points.items():
                column = table[kind.point]
                labelled = rows & ((column == label) | ((column == "") & (len(labelled_points) == 1)))
                numbers = [index.get(f"{prefix}{kind.point}.{label}.{k}", estimate.value.size) for k in "xyz"]
                columns[labelled] = numbers
                # Of a point that the rig knows exactly, the parameter is by how much it is off.
                origin = np.array(point.xyz) if point.sigma == 0.0 else np.zeros(3)
                points[labelled] = np.where(np.isnan(values[numbers]), point.xyz, origin + values[numbers])
    return points, columns


def body_motion(points: Floats) -> Floats:
    """Return the motion (3n, 6) of points (n, 3) by a twist (v; w) of the base: v + w × p."""
    turned = np.cross(np.eye(3), points[:, None, :]).swapaxes(1, 2)
    return np.concatenate([np.broadcast_to(np.eye(3), turned.shape), turned], axis=2).reshape(-1, 6)


def moves(chain: Chain, x: Floats, there: Floats, q: Floats) -> float:
    """Return the RMS distance [m] over the poses between the end's origins for the parameters of x and of ``there``."""
    p = len(chain.parameters)
    motion = forward(chain, there[:p], q)[:, :3, 3] - forward(chain, x[:p], q)[:, :3, 3]
    return rms(np.linalg.norm(motion, axis=1))
