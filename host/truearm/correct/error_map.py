"""How far the end errs over a section of the workspace, and how well that is known (Renders 1991, IV-A and Fig. 5).

    e(q) = ‖f_i(q) − f_n(q)‖                                  (31)

Two joints with parallel axes move the end in a plane; all others stand still (Fig. 5: θ_1 = θ_4 = θ_6 = 0, elbow up). The
plane is cut into square cells, and each takes the joint vector that brings the nominal end nearest to its middle. Elbow up
and down are told apart by the sign of the plane's Jacobian ∂(u, v)/∂(q_a, q_b): between them the arm is stretched.

The map's own uncertainty: with the parameters' covariance P the identified end has the mean square error tr(J P Jᵀ).
Where a direction that the observations did not see would move the end, no figure would be honest, and there is none.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from truearm.correct.pair import Pair, reached, told
from truearm.errors import RobotError
from truearm.model.chain import joint_frames, joint_jacobian, point_jacobians
from truearm.types import Floats

COARSE = 40  # samples of each of the two joints, to see how far the arm reaches
FINEST = 400  # 160,000 joint vectors, some 150 MB on the way
A_CELL = 2.0  # samples at least, along the arc of the arm's reach
MOVES = 1e-6  # m by a null direction whose largest weight is 1
STRETCHED = 1e-3  # m²/rad²: below, elbow up and down are hardly told apart


class ErrorMap(NamedTuple):
    """Cells (v, u) of a section; what no joint vector reaches is NaN."""

    u: Floats  # (k,) m, middles along ``axes[0]``
    v: Floats  # (l,) m, middles along ``axes[1]``
    axes: Floats  # (2, 3) unit vectors in the base frame
    q: Floats  # (l, k, j)
    point: Floats  # (l, k, 3) m, the nominal end
    error: Floats  # (l, k) m
    sigma: Floats  # (l, k) m, standard deviation of the identified end's position


class Region(NamedTuple):
    """The cells of a rectangle in which the largest error is smallest."""

    u: tuple[float, float]  # m
    v: tuple[float, float]  # m
    largest: float  # m
    rms: float  # m


def error_map(
    pair: Pair,
    q: Floats,
    joints: tuple[int, int],
    cell: float,
    covariance: Floats,
    unseen: Floats,
    elbow_up: bool = True,
) -> ErrorMap:
    """The map over the section that two joints (indices) span while the others stand at q (j,).

    cell : m. covariance : (p, p). unseen : (p, d) null directions, the largest weight of each being 1.

    Raises RobotError where the two joints do not turn about parallel axes across which the end lies.
    """
    axes = _plane(pair, q, joints)
    samples = _samples(pair, q, joints, _fine_enough(pair, q, joints, cell))
    points = told(pair, samples)[:, :3, 3]
    kept = _elbow(pair, samples, joints, axes, elbow_up)
    samples, points = samples[kept], points[kept]
    flat = points @ axes.T
    low = np.floor(flat.min(axis=0) / cell) * cell
    at = np.floor((flat - low) / cell).astype(int)
    size = at.max(axis=0) + 1
    off = np.linalg.norm(flat - low - (at + 0.5) * cell, axis=1)
    order = np.lexsort((off, at[:, 0], at[:, 1]))
    place = at[order, 1] * size[0] + at[order, 0]
    _, first = np.unique(place, return_index=True)
    chosen = order[first]
    grid = at[chosen, 1], at[chosen, 0]
    shape = (int(size[1]), int(size[0]))
    q_grid, point, error, sigma = (np.full((*shape, *more), np.nan) for more in ((q.size,), (3,), (), ()))
    q_grid[grid], point[grid] = samples[chosen], points[chosen]
    error[grid] = np.linalg.norm(reached(pair, samples[chosen])[:, :3, 3] - points[chosen], axis=1)
    sigma[grid] = _sigma(pair, samples[chosen], covariance, unseen)
    u, v = (low[i] + cell * (np.arange(size[i]) + 0.5) for i in (0, 1))
    return ErrorMap(u, v, axes, q_grid, point, error, sigma)


def _plane(pair: Pair, q: Floats, joints: tuple[int, int]) -> Floats:
    """Unit vectors across the first joint's axis: the second one as far up (or along y) as it goes."""
    frames = joint_frames(pair.chain, pair.nominal, q)
    movers = [pair.chain.movers[i] for i in joints]
    turning = all(mover.motion[0] == "r" for mover in movers)
    normals = [frames[i][:3, "xyz".index(mover.motion[1])] for i, mover in zip(joints, movers, strict=True)]
    if not turning or joints[0] >= joints[1] or np.linalg.norm(np.cross(*normals)) > 1e-6:
        raise RobotError(
            f"joints {joints[0] + 1} and {joints[1] + 1} do not turn about parallel axes; choose two that do"
        )
    normal = normals[0]
    up = np.array([0.0, 0.0, 1.0]) if abs(normal[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
    v = up - normal * (normal @ up)
    v /= np.linalg.norm(v)
    u = np.cross(v, normal)
    return np.stack([u if u[np.abs(u).argmax()] > 0.0 else -u, v])


def _fine_enough(pair: Pair, q: Floats, joints: tuple[int, int], cell: float) -> int:
    """How many samples of each joint leave no cell between them empty."""
    coarse = _samples(pair, q, joints, COARSE)
    shoulder = joint_frames(pair.chain, pair.nominal, coarse)[:, joints[0], :3, 3]
    reach = float(np.linalg.norm(told(pair, coarse)[:, :3, 3] - shoulder, axis=1).max())
    widest = float(np.ptp(coarse[:, list(joints)], axis=0).max())
    return int(np.clip(A_CELL * widest * reach / cell, COARSE, FINEST))


def _samples(pair: Pair, q: Floats, joints: tuple[int, int], count: int) -> Floats:
    ranges = []
    for i in joints:
        joint = pair.chain.joints[i]
        first = joint.lower if np.isfinite(joint.lower) else -np.pi
        ranges.append(np.linspace(first, min(joint.upper, first + 2.0 * np.pi), count))
    samples = np.tile(q, (count * count, 1))
    samples[:, joints[0]], samples[:, joints[1]] = (axis.ravel() for axis in np.meshgrid(*ranges))
    return samples


def _elbow(pair: Pair, samples: Floats, joints: tuple[int, int], axes: Floats, up: bool) -> NDArray[np.bool_]:
    """Mask (n,) of one configuration: of both the one whose elbow lies, on the whole, higher (lower)."""
    jac = axes @ joint_jacobian(pair.chain, pair.nominal, samples)[:, :3, list(joints)]
    side = np.linalg.det(jac)
    frames = joint_frames(pair.chain, pair.nominal, samples)
    end = told(pair, samples)[:, :3, 3]
    middle = 0.5 * (frames[:, joints[0], :3, 3] + end)
    height = (frames[:, joints[1], :3, 3] - middle) @ axes[1]
    sides = [np.asarray(side > STRETCHED), np.asarray(side < -STRETCHED)]
    if not all(mask.any() for mask in sides):
        only = sides[0] if sides[0].any() else sides[1]
        if not only.any():
            raise RobotError(f"joints {joints[0] + 1} and {joints[1] + 1} do not span a section at these joints")
        return np.asarray(only)
    heights = [float(height[mask].mean()) for mask in sides]
    return np.asarray(sides[int(np.argmax(heights) if up else np.argmin(heights))])


def _sigma(pair: Pair, q: Floats, covariance: Floats, unseen: Floats) -> Floats:
    """(n,) m; NaN where it cannot be told."""
    _, jac, _ = point_jacobians(pair.chain, pair.identified, q, np.zeros(3))
    variance = np.einsum("nip,pr,nir->n", jac, covariance, jac, optimize=True)
    moved = np.abs(jac @ unseen).max(axis=(1, 2), initial=0.0)
    return np.where(moved > MOVES, np.nan, np.sqrt(np.maximum(variance, 0.0)))


def best_region(found: ErrorMap, width: float, height: float) -> Region | None:
    """Where a task of this size (along u and v) [m] errs least at its worst place; None where it fits nowhere."""
    cell = found.u[1] - found.u[0] if found.u.size > 1 else np.inf
    k, n = max(1, int(np.ceil(width / cell - 1e-9))), max(1, int(np.ceil(height / cell - 1e-9)))
    if k > found.u.size or n > found.v.size:
        return None
    windows = sliding_window_view(found.error, (n, k))
    largest = windows.max(axis=(2, 3))  # NaN where a cell is out of reach
    if np.isnan(largest).all():
        return None
    i, j = np.unravel_index(int(np.nanargmin(largest)), largest.shape)
    u, v = found.u[j : j + k], found.v[i : i + n]
    half = 0.5 * cell
    return Region(
        (float(u[0] - half), float(u[-1] + half)),
        (float(v[0] - half), float(v[-1] + half)),
        float(largest[i, j]),
        float(np.sqrt(np.mean(windows[i, j] ** 2))),
    )
