"""Lines that an arm can drive: straight at the target, with the tool turning evenly, as controllers do in Cartesian
motion.

A line has a middle posture, drawn at random, a direction, and a rotation of the tool from end to end. Inverse
kinematics follows it outwards from the middle. The entire path must satisfy the limits and the joint speed. The target
must stay within the range of the transverse sensors by twice the a-priori straightness (Renders 1991, II-C, 15 mm).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from truearm.errors import PlanError
from truearm.estimate.prior import weak_prior
from truearm.estimate.uncertainty import tolerance_error
from truearm.model.chain import end_and_jacobian, forward, point_forward, point_jacobians
from truearm.model.inverse import inverse, singular_value
from truearm.plan.bar_paths import samples
from truearm.plan.branch_inverse import LEVER
from truearm.plan.collision_shapes import device_is_clear
from truearm.plan.measurement_limits import Site, allowed
from truearm.plan.options import LineOptions
from truearm.plan.region import Region
from truearm.progress import steps_of
from truearm.types import Floats, rms_of_columns
from truearm.units import MM

# of the tool from end to end: determines its orientation without tilting the device's magnet far
MOST_TURN = np.deg2rad(40.0)
STEPS = 8  # of the inverse kinematics from one point to the next: more only where the arm does not reach it
AT_ONCE, ROUNDS = 100, 40  # random draws


class Lines(NamedTuple):
    """Lines (l): joints (l, 2·n_points + 1, j) evenly spaced, with both ends, and the points at odd indices.

    Joint velocities (l, n_points, j) are for the points in the first direction.
    """

    q: Floats
    q_rate: Floats

    @property
    def points(self) -> Floats:
        """Return the joints at the points (l, n_points, j)."""
        return self.q[:, 1::2]

    def select(self, rows: list[int]) -> Lines:
        return Lines(self.q[rows], self.q_rate[rows])


def candidate_lines(
    site: Site,
    options: LineOptions,
    n: int,
    point: Floats,
    joint_speed: float,
    region: Region | None = None,
    seed: int = 0,
    fewest: int = 1,
) -> Lines:
    """Return up to ``n`` lines with their middles in the region. Raises PlanError for fewer than ``fewest``."""
    rng = np.random.default_rng([seed, 0x11E5])
    branch, driveable = site.arm.branch, list[tuple[Floats, Floats]]()
    for _ in steps_of(range(ROUNDS), "looking for lines that the arm can drive"):
        middle = rng.uniform(branch.lower, branch.upper, (AT_ONCE, len(branch.lower)))
        along, turn = _directions(rng), MOST_TURN * rng.random((AT_ONCE, 1)) * _directions(rng)
        p_middle = point_forward(site.arm.chain, site.arm.params, middle, point)
        if region is not None:
            inside = ((p_middle >= region.lower) & (p_middle <= region.upper)).all(axis=1)
            middle, along, turn = middle[inside], along[inside], turn[inside]
        if not len(middle):
            continue
        lines = driven_lines(site, middle, options.length * along, turn, 2 * options.points + 1, point)
        rates = _rates(site, lines[:, 1::2], options.speed * along, options.speed / options.length * turn, point)
        driveable += [
            (q, rate)
            for q, rate, u in zip(lines, rates, along, strict=True)
            if _fits(site, q, rate, u, options, point, joint_speed)
        ]
        if len(driveable) >= n:
            break
    if len(driveable) < fewest:
        raise PlanError(
            f"only {len(driveable)} lines of {MM.text(options.length)} fit within the arm's reach; ask for shorter, slower or fewer lines"
        )
    return Lines(*(np.array(column) for column in zip(*driveable[:n], strict=True)))


def _directions(rng: np.random.Generator) -> Floats:
    drawn = rng.normal(size=(AT_ONCE, 3))
    return np.asarray(drawn / np.linalg.norm(drawn, axis=1, keepdims=True))


def driven_lines(site: Site, middle: Floats, displacement: Floats, turn: Floats, n: int, point: Floats) -> Floats:
    """Return joints (m, n, j) along lines with middle postures ``middle`` (m, j); NaN where no joints were found.

    From end to end a point (3,) of the end moves by way (m, 3) [m], and the tool turns by a rotation vector turn (m,
    3).
    """
    chain, params, branch = site.arm.chain, site.arm.params, site.arm.branch
    at_middle = forward(chain, params, middle)
    p_middle = point_forward(chain, params, middle, point)
    out, shares = np.full((len(middle), n, middle.shape[1]), np.nan), np.linspace(-0.5, 0.5, n)
    for side in (np.flatnonzero(shares >= 0.0), np.flatnonzero(shares < 0.0)[::-1]):
        q = middle
        for k in side:
            pose = at_middle.copy()
            pose[:, :3, :3] = Rotation.from_rotvec(shares[k] * turn).as_matrix() @ pose[:, :3, :3]
            pose[:, :3, 3] = p_middle + shares[k] * displacement - pose[:, :3, :3] @ point
            q = inverse(chain, params, pose, q, steps=STEPS)
            q[((q <= branch.lower) | (q >= branch.upper)).any(axis=1)] = np.nan
            out[:, k] = q
    return np.where(np.isnan(out).any(axis=(1, 2), keepdims=True), np.nan, out)


def _rates(site: Site, q: Floats, velocity: Floats, turning: Floats, point: Floats) -> Floats:
    """Return joint rates (m, n, j) [rad/s] at joints q (m, n, j), for a point's velocity (m, 3) and the tool's turning
    (m, 3).

    The velocity is in m/s and the turning in rad/s.
    """
    flat = np.nan_to_num(q.reshape(-1, q.shape[2]))
    pose, jacobian = end_and_jacobian(site.arm.chain, site.arm.params, flat)
    velocity, turning = (np.repeat(vector, q.shape[1], axis=0) for vector in (velocity, turning))
    twist = np.concatenate([velocity - np.cross(turning, pose[:, :3, :3] @ point), turning], axis=1)
    return np.asarray((np.linalg.pinv(jacobian, rcond=1e-3) @ twist[..., None])[..., 0].reshape(q.shape))


def _fits(
    site: Site, q: Floats, q_rate: Floats, along: Floats, options: LineOptions, point: Floats, joint_speed: float
) -> bool:
    """Return whether a line (n, j) can be driven from end to end next to its device."""
    if np.isnan(q).any() or np.abs(q_rate).max() > joint_speed:
        return False
    path, limits = samples(q[:-1], q[1:])[0], site.limits.tightened()
    singular = singular_value(site.arm.chain, site.arm.params, path, lever=LEVER)
    if not allowed(site, path, None, limits).all() or (singular < limits.singular_value).any():
        return False
    ends = point_forward(site.arm.chain, site.arm.params, q[[0, -1]], point)
    if not device_is_clear(site.shapes, path, ends[0], ends[1], bool(point.any())):
        return False
    return 2.0 * straightness(site, q[1::2], along, point) < 0.5 * options.transverse


def straightness(site: Site, q: Floats, along: Floats, point: Floats) -> float:
    """Return the expected transverse distance [m] of a line's points from the best straight line, at the worst point.

    It is computed from the tolerances of ``weak_prior``, those of a manufacturer's drawing.
    """
    p, jac, _ = point_jacobians(site.arm.chain, site.arm.params, q, point)
    across = jac - along[:, None] * np.einsum("i,nip->np", along, jac)[:, None]
    y = (p - p.mean(axis=0)) @ along
    basis, _ = np.linalg.qr(np.stack([np.ones_like(y), y], axis=1))
    bent = across - np.einsum("nk,mk,mip->nip", basis, basis, across)
    return float(np.sqrt(((bent * weak_prior(site.arm.chain)) ** 2).sum(axis=(1, 2)).max()))


def a_priori(site: Site, q: Floats, point: Floats) -> Floats:
    """Return the expected RMS error [m] (c,) over the points of lines (c, n, j), by the tolerances of ``weak_prior``."""
    chain = site.arm.chain
    error = tolerance_error(chain, weak_prior(chain), q.reshape(-1, q.shape[2]), point)
    return rms_of_columns(error.reshape(q.shape[:2]).T)
