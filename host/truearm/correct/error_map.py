"""The error of the end over a section of the workspace, and its uncertainty (Renders 1991, IV-A and Fig. 5).

    e(q) = ‖f_i(q) − f_n(q)‖                                  (31)

Two joints with parallel axes move the end in a plane; all others are at rest (Fig. 5: θ_1 = θ_4 = θ_6 = 0, elbow up).
Each square cell gets the joint vector that brings the nominal end to its middle or, out of reach, one that brings it
into the cell. The sign of the plane's Jacobian ∂(u, v)/∂(q_a, q_b) distinguishes elbow up and down.

With the covariance P of the parameters, the identified end has the mean square error tr(J P Jᵀ). Where a null direction
would move the end, no figure is given, except for directions that only place base or tool: without them, figures are
relative to both.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.spatial import KDTree

from truearm.correct.configurations import within
from truearm.correct.correction import ModelPair, believed, reached
from truearm.errors import Argument, RobotError
from truearm.model.chain import joint_frames, joint_jacobian, point_jacobians
from truearm.results import MOVES
from truearm.text import counted
from truearm.types import Displayed, Floats, rms
from truearm.units import MM

SAMPLES = 100  # of each of the two joints
NEAREST = 4  # samples from which a cell is tried
MOST_CELLS = 250_000
BLOCK = 2000  # cells whose derivatives are held at once
NEWTON_STEPS = 6  # from the nearest sample they square the error, 25 mm, down to rounding
LARGEST_STEP = 0.3  # rad
PARALLEL = 0.02  # rad: axes that a drawing has parallel differ by less in a controller's calibration
ROUNDING = 1e-9  # m, at the edge of a cell
STRETCHED = 1e-3  # m²/rad²: below this, elbow up and down are hardly distinguishable


@dataclass(frozen=True, eq=False, repr=False)
class ErrorMap(Displayed):
    """The cells of a section: l rows along v, k columns along u. Cells that no joint vector reaches are NaN.

    ``u`` (k,) and ``v`` (l,) are the middles of the cells [m], along ``axes[0]`` and ``axes[1]``, unit vectors in the
    base frame. ``q`` (l, k, j) are the joint readings and ``point`` (l, k, 3) the place of the nominal end [m].
    ``error`` (l, k) is its distance from the identified end [m], and ``sigma`` (l, k) the standard deviation of that
    end's position [m], NaN if undetermined. ``outside`` (l, k) is True where a joint is outside the fitted readings,
    None if these are unknown.

    Examples
    --------
    >>> import numpy as np
    >>> import truearm
    >>> found = truearm.error_map(truearm.read_result("result.json"), cell=0.1)
    >>> found.axes.shape, found.q.shape == (*found.error.shape, 6)
    ((2, 3), True)
    """

    u: Floats
    v: Floats
    axes: Floats
    q: Floats
    point: Floats
    error: Floats
    sigma: Floats
    outside: NDArray[np.bool_] | None = None

    def _headline(self) -> str:
        reached = self.error[~np.isnan(self.error)]
        largest = f", at most {MM.text(reached.max(), '.3f')}" if reached.size else ""
        return f"{counted(reached.size, 'reachable cell')} of {self.error.size}{largest}"

    def _columns(self) -> Mapping[str, Any]:
        in_reach = ~np.isnan(self.error)
        v, u = np.meshgrid(self.v, self.u, indexing="ij")
        columns = {"u": u, "v": v, "q": self.q, "error": self.error, "sigma": self.sigma}
        return {title: column[in_reach] for title, column in columns.items()}


class BestRectangle(NamedTuple):
    """The cells of the rectangle with the smallest largest error."""

    u: tuple[float, float]  # m
    v: tuple[float, float]  # m
    largest: float  # m
    rms: float  # m


def error_map(
    pair: ModelPair, q: Floats, joints: tuple[int, int], cell: float, covariance: Floats, unseen: Floats
) -> ErrorMap:
    """Return the map over the section that two joints (indices) span while the others stay at q (j,).

    The elbow is as at q; up if the arm is stretched there.

    cell : m. covariance : (p, p). unseen : (p, d) null directions, each with a largest weight of 1.

    Raises RobotError unless the two joints turn about parallel axes and the end lies off them.
    """
    axes = _plane(pair, q, joints)
    samples = _samples(pair, q, joints)
    determinant = float(_plane_determinant(pair, q[None], joints, axes)[0])
    is_bent = abs(determinant) > STRETCHED
    side = float(np.sign(determinant)) if is_bent else _elbow_up(pair, samples, joints, axes)
    samples = samples[side * _plane_determinant(pair, samples, joints, axes) > STRETCHED]
    flat = believed(pair, samples)[:, :3, 3] @ axes.T
    low = np.floor(flat.min(axis=0) / cell) * cell
    index = np.floor((flat - low) / cell).astype(int)
    u, v = (low[i] + cell * (np.arange(index[:, i].max() + 1) + 0.5) for i in (0, 1))
    if u.size * v.size > MOST_CELLS:
        raise RobotError(
            f"the section has {u.size} × {v.size} cells, in all {u.size * v.size:,}; the most is {MOST_CELLS:,}: choose larger cells"
        )
    middles = np.stack(np.meshgrid(u, v), axis=-1)
    q_grid = np.full((v.size, u.size, q.size), np.nan)
    q_grid[index[:, 1], index[:, 0]] = samples
    nearest = KDTree(flat).query(middles, range(1, NEAREST + 1))[1]
    rows, columns = (axis.ravel() for axis in np.indices((v.size, u.size)))
    point, error, sigma = (np.full((v.size, u.size, *shape), np.nan) for shape in ((3,), (), ()))
    for first in range(0, rows.size, BLOCK):
        block = rows[first : first + BLOCK], columns[first : first + BLOCK]
        moved = np.full_like(q_grid[block], np.nan)
        for k in range(NEAREST):  # the nearest may be a turn away, where the middle is beyond a limit
            missed = np.isnan(moved[:, 0]) & (nearest[block][:, k] < len(samples))
            start = samples[nearest[block][missed, k]]
            moved[missed] = _reach(pair, start, middles[block][missed], joints, axes, side, cell)
        q_grid[block] = np.where(np.isnan(moved), q_grid[block], moved)
        is_reached = ~np.isnan(q_grid[block][:, 0])
        block = block[0][is_reached], block[1][is_reached]
        point[block] = believed(pair, q_grid[block])[:, :3, 3]
        error[block] = np.linalg.norm(reached(pair, q_grid[block])[:, :3, 3] - point[block], axis=1)
        sigma[block] = _sigma(pair, q_grid[block], covariance, unseen)
    return ErrorMap(u, v, axes, pair.chain.completed(q_grid), point, error, sigma)


def _reach(
    pair: ModelPair, start: Floats, goal: Floats, joints: tuple[int, int], axes: Floats, side: float, cell: float
) -> Floats:
    """Return joints (n, j) that bring the nominal end to points (n, 2) of the plane, by Newton's method in both."""
    q, two = start.copy(), list(joints)
    for _ in range(NEWTON_STEPS):
        error = goal - believed(pair, q)[:, :3, 3] @ axes.T
        jac = axes @ joint_jacobian(pair.chain, pair.nominal, q)[:, :3, two]
        square = jac @ jac.swapaxes(1, 2) + 1e-12 * np.eye(2)
        step = (jac.swapaxes(1, 2) @ np.linalg.solve(square, error[..., None]))[..., 0]
        q[:, two] += np.clip(step, -LARGEST_STEP, LARGEST_STEP)
    missed = np.abs(goal - believed(pair, q)[:, :3, 3] @ axes.T).max(axis=1, initial=0.0)
    good = (
        (missed < 1e-3 * cell) & within(pair.chain, q) & (side * _plane_determinant(pair, q, joints, axes) > STRETCHED)
    )
    return np.where(good[:, None], q, np.nan)


def _plane(pair: ModelPair, q: Floats, joints: tuple[int, int]) -> Floats:
    """Return two unit vectors (2, 3) across the first joint's axis, the second as far up (or along y) as possible.

    Raises RobotError unless the joints turn about parallel axes by themselves.
    """
    frames = joint_frames(pair.chain, pair.nominal, q)
    motions = [pair.chain.motions[i] for i in joints]
    turning = all(motion[0] == "r" for motion in motions) and not pair.chain.mimics.keys() & set(joints)
    normals = [frames[i][:3, "xyz".index(motion[1])] for i, motion in zip(joints, motions, strict=True)]
    if not turning or joints[0] >= joints[1] or np.linalg.norm(np.cross(*normals)) > PARALLEL:
        raise RobotError(
            f"joints {joints[0] + 1} and {joints[1] + 1} do not turn about parallel axes by themselves; choose two that do with ",
            Argument("joints"),
        )
    normal = normals[0]
    up = np.array([0.0, 0.0, 1.0]) if abs(normal[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
    v = up - normal * (normal @ up)
    v /= np.linalg.norm(v)
    u = np.cross(v, normal)
    return np.stack([u if u[np.abs(u).argmax()] > 0.0 else -u, v])


def _samples(pair: ModelPair, q: Floats, joints: tuple[int, int]) -> Floats:
    """Return readings (n, j) on a grid of two joints over their limits, a turn at most; the others are as in q (j,)."""
    ranges = []
    for i in joints:
        joint = pair.chain.joints[i]
        first = joint.lower if np.isfinite(joint.lower) else -np.pi
        ranges.append(np.linspace(first, min(joint.upper, first + 2.0 * np.pi), SAMPLES))
    samples = np.tile(q, (SAMPLES * SAMPLES, 1))
    samples[:, joints[0]], samples[:, joints[1]] = (axis.ravel() for axis in np.meshgrid(*ranges))
    return samples


def _plane_determinant(pair: ModelPair, q: Floats, joints: tuple[int, int], axes: Floats) -> Floats:
    """Return the determinant of the plane's Jacobian (n,) [m²/rad²]."""
    jac = axes @ joint_jacobian(pair.chain, pair.nominal, q)[:, :3, list(joints)]
    return np.asarray(np.linalg.det(jac))


def _elbow_up(pair: ModelPair, samples: Floats, joints: tuple[int, int], axes: Floats) -> float:
    """Return the sign of the determinant where the elbow is mostly higher; the only sign if there is one."""
    determinant = _plane_determinant(pair, samples, joints, axes)
    frames = joint_frames(pair.chain, pair.nominal, samples)
    middle = 0.5 * (frames[:, joints[0], :3, 3] + believed(pair, samples)[:, :3, 3])
    height = (frames[:, joints[1], :3, 3] - middle) @ axes[1]
    heights = {
        sign: float(height[sign * determinant > STRETCHED].mean())
        for sign in (1.0, -1.0)
        if (sign * determinant > STRETCHED).any()
    }
    if not heights:
        raise RobotError(
            f"joints {joints[0] + 1} and {joints[1] + 1} do not span a section at these joint readings; choose other readings of the other joints"
        )
    return max(heights, key=lambda sign: heights[sign])


def _sigma(pair: ModelPair, q: Floats, covariance: Floats, unseen: Floats) -> Floats:
    """Return the standard deviation (n,) [m] of the identified end; NaN where it is undetermined."""
    _, jac, _ = point_jacobians(pair.chain, pair.identified, q, np.zeros(3))
    variance = np.einsum("nip,pr,nir->n", jac, covariance, jac, optimize=True)
    moved = np.abs(jac @ unseen).max(axis=(1, 2), initial=0.0)
    return np.where(moved > MOVES, np.nan, np.sqrt(np.maximum(variance, 0.0)))


def best_region(
    section: ErrorMap, width: float, height: float, within: tuple[float, float, float, float] | None = None
) -> BestRectangle | None:
    """Return the rectangle of this size (along u, v) [m] with the smallest largest error, or None if it fits nowhere.

    ``within``: u0, u1, v0, v1 [m], the part of the section in which it may lie. The map does not account for
    collisions, of the arm with itself or with the table for example.
    """
    cell = section.u[1] - section.u[0] if section.u.size > 1 else np.inf
    k, n = max(1, int(np.ceil(width / cell - 1e-9))), max(1, int(np.ceil(height / cell - 1e-9)))
    if k > section.u.size or n > section.v.size:
        return None
    error = section.error
    if within is not None:
        u0, u1, v0, v1 = np.array(within) + 0.5 * cell * np.array([1.0, -1.0, 1.0, -1.0])
        inside = (
            (section.u > u0 - ROUNDING) & (section.u < u1 + ROUNDING),
            (section.v > v0 - ROUNDING) & (section.v < v1 + ROUNDING),
        )
        error = np.where(inside[1][:, None] & inside[0], error, np.nan)
    windows = sliding_window_view(error, (n, k))
    largest = windows.max(axis=(2, 3))  # NaN where a cell is out of reach
    if np.isnan(largest).all():
        return None
    i, j = np.unravel_index(int(np.nanargmin(largest)), largest.shape)
    u, v = section.u[j : j + k], section.v[i : i + n]
    half = 0.5 * cell
    return BestRectangle(
        (float(u[0] - half), float(u[-1] + half)),
        (float(v[0] - half), float(v[-1] + half)),
        float(largest[i, j]),
        rms(windows[i, j]),
    )
