"""The limits of a measurement: what an arm with its rig may touch, where a bar holds, and the region of interest.

The arm's links, the bar, chuck posts and a line device are capsules, the table is a plane. A capsule is the set of
points within a radius of a segment; those of the arm come from its robot file or from ``along_joints``. Neighbouring
links always touch and are not checked against each other. Within the arm, only the links that carry the tool are
checked against those that carry the elbow.

The bar's travel is limited; a ``reserve`` of it is left for errors of the model used for planning. Goswami's PUMA
deviates from its design by -16 to +22 mm along the bar, so the default is 22 mm of 37.5. A plan based on an identified
model needs almost none. Both ends of the bar sit in magnetic cups, which allow a limited angle. The one on the table
about the vertical, the one on the end about the end's z axis, which points away from the arm.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from truearm import option_defaults
from truearm.arguments import floats
from truearm.errors import Argument, InputError, PlanError
from truearm.model.chain import Chain, forward, joint_and_end_frames, joint_frames, point_forward
from truearm.model.inverse import singular_value
from truearm.model.robot import Capsules
from truearm.plan.branches import LEVER, Arm
from truearm.types import BallBar, Floats, Plan, Rig

UPPER_ARM = 2  # the joint that moves it first
BEFORE_FOREARM = 4  # joints from the elbow on: the tool can be folded into the links before them
ALONG = np.linspace(0.0, 1.0, 9)  # points of a capsule that are compared with a table
SHORT = 0.02  # m; joints with origins closer than this share a segment
N_POSES = 300


@dataclass(frozen=True)
class Sizes:
    """Dimensions [m]: radii of the parts, the overhang of a line device, the table's height z.

    The rod of a line device extends by the overhang beyond either end of its line.

    The radii are those of the links of an arm whose file has no capsules, of studs that hold spheres, of bars, of chuck
    posts and of a line device's rod. A table with an ``edge`` begins at this distance from the base's z axis.
    """

    link: float = 0.05
    stud: float = 0.012
    bar: float = 0.015
    post: float = 0.02
    rod: float = 0.02
    rod_end: float = 0.05
    table: float = 0.0
    edge: float = 0.0


class Mounted(NamedTuple):
    """The points that the bar connects, in the base and the end frame, (3,)."""

    p_chuck: Floats
    p_sphere: Floats


class Shapes(NamedTuple):
    """A robot and its rig as capsules."""

    chain: Chain
    params: Floats
    links: Capsules
    p_spheres: Floats  # (s, 3)
    p_feet: Floats  # (c, 3) of the chucks' posts, on the table
    p_posts: Floats  # (c, 3) the chucks
    sizes: Sizes


def make_shapes(chain: Chain, params: Floats, rig: Rig, sizes: Sizes, links: Capsules | None = None) -> Shapes:
    """Return the shapes of a robot at params (p,); without ``links`` the capsules run along its joints."""
    spheres = np.array([s.xyz for s in rig.spheres.values()]).reshape(-1, 3)
    posts = np.array([c.xyz for c in rig.chucks.values()]).reshape(-1, 3)
    feet = np.column_stack([posts[:, :2], np.minimum(posts[:, 2], sizes.table)])
    return Shapes(chain, params, links or along_joints(chain, params, sizes.link), spheres, feet, posts, sizes)


def clear(shapes: Shapes, q: Floats, mounted: Mounted | None) -> NDArray[np.bool_]:
    """Return whether nothing touches at joints q (n, j), with the bar on as ``mounted`` or removed."""
    sizes, joint, radius = shapes.sizes, np.array(shapes.links.joint), shapes.links.radius
    ends, pose = link_ends(shapes, q)
    spheres = shapes.p_spheres @ pose[:, :3, :3].swapaxes(1, 2) + pose[:, None, :3, 3]
    moved = joint >= UPPER_ARM
    good = _is_above_table(ends[:, moved], radius[moved], sizes)
    good &= (spheres[..., 2] > sizes.table + sizes.stud).all(axis=1)
    good &= _arm_is_clear_of_itself(shapes, ends, pose, spheres)
    feet, tops = shapes.p_feet, shapes.p_posts
    distance = _from(ends[:, moved, None], feet, tops)
    good &= (distance > radius[moved][:, None] + sizes.post).all(axis=(1, 2))
    studs = segment_distance(pose[:, None, None, :3, 3], spheres[:, :, None], feet, tops)
    good &= (studs > sizes.stud + sizes.post).all(axis=(1, 2))
    if mounted is not None:
        good &= _bar_is_clear(shapes, ends, pose, mounted)
    return np.asarray(good)


def _is_above_table(ends: Floats, radius: Floats, sizes: Sizes) -> NDArray[np.bool_]:
    """Return whether capsules with ends (n, m, 2, 3) are above the table, as far as they are over it."""
    if sizes.edge:
        ends = ends[..., :1, :] + ALONG[:, None] * np.diff(ends, axis=2)
    is_over = np.hypot(ends[..., 0], ends[..., 1]) > sizes.edge - radius[:, None]
    return np.asarray(((ends[..., 2] > sizes.table + radius[:, None]) | ~is_over).all(axis=(1, 2)))


def link_ends(shapes: Shapes, q: Floats) -> tuple[Floats, Floats]:
    """Return the ends (n, m, 2, 3) of the arm's capsules in the base frame, and the pose (n, 4, 4) of the end."""
    frames, pose = joint_and_end_frames(shapes.chain, shapes.params, q)
    fixed = np.broadcast_to(np.eye(4), (len(q), 1, 4, 4))
    carriers = np.concatenate([fixed, frames], axis=1)[:, shapes.links.joint]
    return np.asarray(shapes.links.ends @ carriers[..., :3, :3].swapaxes(-1, -2) + carriers[..., None, :3, 3]), pose


def _arm_is_clear_of_itself(shapes: Shapes, ends: Floats, pose: Floats, spheres: Floats) -> NDArray[np.bool_]:
    """Check the tool against everything before the forearm: column, shoulder, upper arm."""
    joint, radius = np.array(shapes.links.joint), shapes.links.radius
    inner, tool = joint <= len(shapes.chain.joints) - BEFORE_FOREARM, joint >= tool_joint(shapes)
    flange = np.broadcast_to(pose[:, None, :3, 3], spheres.shape)
    starts = np.concatenate([ends[:, tool, 0], flange], axis=1)
    stops = np.concatenate([ends[:, tool, 1], spheres], axis=1)
    thick = np.concatenate([radius[tool], np.full(spheres.shape[1], shapes.sizes.stud)])
    distance = _from(ends[:, inner, None], starts[:, None], stops[:, None])
    return np.asarray((distance > radius[inner][:, None] + thick).all(axis=(1, 2)))


def _bar_is_clear(shapes: Shapes, ends: Floats, pose: Floats, mounted: Mounted) -> NDArray[np.bool_]:
    """Check the bar against the arm up to its wrist, and against the posts of the other chucks."""
    p_sphere = pose[:, :3, :3] @ mounted.p_sphere + pose[:, :3, 3]
    others = (shapes.p_posts != mounted.p_chuck).any(axis=1)
    distance = segment_distance(shapes.p_feet[others], shapes.p_posts[others], p_sphere[:, None], mounted.p_chuck)
    good = (distance > shapes.sizes.post + shapes.sizes.bar).all(axis=1)
    return good & _wrist_is_clear(shapes, ends, p_sphere[:, None], mounted.p_chuck, shapes.sizes.bar)


def device_is_clear(shapes: Shapes, q: Floats, start: Floats, end: Floats, carried: bool = True) -> bool:
    """Return whether a line device along start–end (3,) touches neither table, posts nor the arm up to its wrist.

    The arm is checked at all joints q (n, j), but only if the magnet is ``carried`` beyond the end's origin. Otherwise
    the device would touch the flange anyway, so the part that carries the magnet is not described yet.
    """
    sizes = shapes.sizes
    out = sizes.rod_end * (end - start) / np.linalg.norm(end - start)
    start, end = start - out, end + out
    if min(start[2], end[2]) < sizes.table + sizes.rod:
        return False
    if (segment_distance(shapes.p_feet, shapes.p_posts, start, end) < sizes.post + sizes.rod).any():
        return False
    return not carried or bool(_wrist_is_clear(shapes, link_ends(shapes, q)[0], start, end, sizes.rod).all())


def _wrist_is_clear(shapes: Shapes, ends: Floats, start: Floats, end: Floats, radius: float) -> NDArray[np.bool_]:
    """Return a mask (n,) of whether the arm up to its wrist stays clear of a capsule.

    The parts that carry the end of a bar or a magnet necessarily touch it.
    """
    inner = np.array(shapes.links.joint) < tool_joint(shapes)
    distance = _from(ends[:, inner], start, end)
    return np.asarray((distance > shapes.links.radius[inner] + radius).all(axis=1))


def tool_joint(shapes: Shapes) -> int:
    """Return the first joint (from 1) that counts as tool: the last but one, since the last turns about its axis."""
    return len(shapes.chain.joints) - 1


def _from(ends: Floats, start: Floats, end: Floats) -> Floats:
    """Return the distances (…) of segments with ends (…, 2, 3) from others."""
    return segment_distance(ends[..., 0, :], ends[..., 1, :], start, end)


def segment_distance(a0: Floats, a1: Floats, b0: Floats, b1: Floats) -> Floats:
    """Return the shortest distance (…) between segments a0–a1 and b0–b1, each end (…, 3) (Ericson 2005, 5.1.9).

    Finds the nearest points of the two lines, clamps one parameter to its segment and solves for the other again.
    """
    along_a, along_b, between = a1 - a0, b1 - b0, a0 - b0
    a, e, b = _dot(along_a, along_a), _dot(along_b, along_b), _dot(along_a, along_b)
    c, f = _dot(along_a, between), _dot(along_b, between)
    tiny = 1e-18
    across = a * e - b * b  # 0 for parallel lines: any point of the first can be used
    s = np.clip(np.where(across > tiny, (b * f - c * e) / np.where(across > tiny, across, 1.0), 0.0), 0.0, 1.0)
    t = np.clip((b * s + f) / np.maximum(e, tiny), 0.0, 1.0)
    s = np.clip((b * t - c) / np.maximum(a, tiny), 0.0, 1.0)
    gap = between + s[..., None] * along_a - t[..., None] * along_b
    return np.asarray(np.sqrt(_dot(gap, gap)))


def _dot(u: Floats, v: Floats) -> Floats:
    return np.asarray(np.einsum("...i,...i->...", u, v))


def along_joints(chain: Chain, params: Floats, radius: float) -> Capsules:
    """Return capsules from the base's foot through the joints' origins to the end; coinciding origins count once.

    For a robot file that describes none. They describe the arm if its links are no wider than ``Sizes.link`` and lie on
    their axes. Most arms are wider, and the upper arm of a Universal Robots arm lies 135 mm beside the plane of its
    axes: the files of the built-in arms have capsules of their own.
    """
    zero = np.zeros(len(chain.joints))
    frames = [np.eye(4), *joint_frames(chain, params, zero), forward(chain, params, zero)]
    corners = [0]
    for i in range(1, len(frames)):
        if np.linalg.norm((frames[i] - frames[corners[-1]])[:3, 3]) > SHORT:
            corners.append(i)
    # The part between two kept origins moves with the last joint before the second.
    joint = tuple(i - 1 for i in corners[1:])
    ends = [[np.zeros(3), frames[i - 1][:3, :3].T @ (frames[i] - frames[i - 1])[:3, 3]] for i in corners[1:]]
    return Capsules(joint, np.array(ends), np.full(len(joint), radius))


@dataclass(frozen=True)
class Limits:
    """The limits at poses and on the path between them; ``tightened`` where only samples are checked."""

    joint_margin: float = np.deg2rad(2.0)  # rad (m) from the joints' limits
    singular_value: float = 0.04  # of the end's Jacobian, metres in LEVERs
    reserve: float = option_defaults.DESIGN_RESERVE  # m, of travel on either side
    chuck_angle: float = np.deg2rad(80.0)  # of the bar from the vertical
    sphere_angle: float = np.deg2rad(75.0)  # of the bar from the end's z axis

    def tightened(self) -> Limits:
        """Return limits for samples STEP apart: between two of them the bar's length bulges by less than 0.6 mm."""
        return replace(
            self,
            reserve=self.reserve + 6e-4,
            singular_value=self.singular_value + 0.004,
            chuck_angle=self.chuck_angle - 0.01,
            sphere_angle=self.sphere_angle - 0.01,
        )


AT_ONCE = 1000  # poses checked for collisions: their distances fit into the cache
STEP = 0.04  # rad, the largest rotation of a joint between two samples of a path


@dataclass(frozen=True)
class Site:
    """An arm with its rig."""

    arm: Arm
    rig: Rig
    shapes: Shapes
    limits: Limits


@dataclass(frozen=True)
class Pairing:
    """A bar between a chuck and a sphere, by their names in the rig."""

    bar: str
    chuck: str
    sphere: str

    def of(self, rig: Rig) -> tuple[BallBar, Mounted]:
        chuck, sphere = rig.chucks[self.chuck], rig.spheres[self.sphere]
        return rig.bars[self.bar], Mounted(np.array(chuck.xyz), np.array(sphere.xyz))


def pairing_at(plan: Plan, i: int) -> Pairing:
    """Return what is connected at pose i."""
    return Pairing(str(plan.bar[i]), str(plan.chuck[i]), str(plan.sphere[i]))


def of_pairing(plan: Plan, pairing: Pairing) -> NDArray[np.bool_]:
    """Return a mask (n,) of the poses with a pairing."""
    return np.asarray((plan.bar == pairing.bar) & (plan.chuck == pairing.chuck) & (plan.sphere == pairing.sphere))


def allowed(site: Site, q: Floats, pairing: Pairing | None, limits: Limits | None = None) -> NDArray[np.bool_]:
    """Return whether joints q (n, j) are within all limits, with the bar on or, for None, removed."""
    limits = limits or site.limits
    good = device_allows(site, q, pairing, limits)
    good[good] = arm_allows(site, q[good], pairing, limits)
    return good


def device_allows(site: Site, q: Floats, pairing: Pairing | None, limits: Limits) -> NDArray[np.bool_]:
    """Check the joints, the bar's length and the angles of its cups."""
    good = within_joints(site, q, limits)
    if pairing is None:
        return good
    bar, mounted = pairing.of(site.rig)
    vector, axis = bar_vectors(site, q, mounted)
    length = np.linalg.norm(vector, axis=1)
    good &= np.abs(length - bar.zero) < free_travel(bar, limits)
    good &= vector[:, 2] > length * np.cos(limits.chuck_angle)
    good &= -np.einsum("ni,ni->n", vector, axis) > length * np.cos(limits.sphere_angle)
    return good


def arm_allows(site: Site, q: Floats, pairing: Pairing | None, limits: Limits) -> NDArray[np.bool_]:
    """Check for collisions and, with the bar on, for singularities."""
    mounted = None if pairing is None else pairing.of(site.rig)[1]
    blocks = [q[i : i + AT_ONCE] for i in range(0, len(q), AT_ONCE)]
    good = np.concatenate([clear(site.shapes, block, mounted) for block in blocks or [q]])
    if mounted is not None:
        good[good] = singular_value(site.arm.chain, site.arm.params, q[good], lever=LEVER) > limits.singular_value
    return good


def within_joints(site: Site, q: Floats, limits: Limits) -> NDArray[np.bool_]:
    """Return a mask (n,) of the poses inside the joints' limits, with their margin."""
    lower, upper = site.arm.chain.limits
    return np.asarray(((q > lower + limits.joint_margin) & (q < upper - limits.joint_margin)).all(axis=-1))


def free_travel(bar: BallBar, limits: Limits) -> float:
    """Return how far the planned length may deviate from mid-travel in either direction [m]."""
    return 0.5 * abs(bar.gain) * bar.travel - limits.reserve


def bar_vectors(site: Site, q: Floats, mounted: Mounted) -> tuple[Floats, Floats]:
    """Return the vectors from chuck to sphere [m] and the end's z axes, each (n, 3)."""
    pose = forward(site.arm.chain, site.arm.params, q)
    return pose[:, :3, :3] @ mounted.p_sphere + pose[:, :3, 3] - mounted.p_chuck, pose[:, :3, 2]


@dataclass(frozen=True, init=False)
class Region:
    """A cuboid in the base frame, with edges along its axes.

    Parameters
    ----------
    lower, upper : array (3,)
        Its corners [m], none of ``lower`` above ``upper``.

    Raises
    ------
    TypeError, InputError
        If one is not three finite numbers, or they are in the wrong order.

    Examples
    --------
    >>> import truearm
    >>> region = truearm.Region([0.3, -0.2, 0.1], [0.6, 0.2, 0.4])
    >>> truearm.BallBarOptions(region=region).criterion
    'I'
    """

    lower: Floats
    upper: Floats

    def __init__(self, lower: ArrayLike, upper: ArrayLike) -> None:
        object.__setattr__(self, "lower", floats("lower", lower, 3))
        object.__setattr__(self, "upper", floats("upper", upper, 3))
        if (self.lower > self.upper).any():
            raise InputError(Argument("lower"), " of a region must not lie above ", Argument("upper"))


def around(points: Floats) -> Region:
    """Return the smallest box around points (n, 3)."""
    return Region(points.min(axis=0), points.max(axis=0))


def poses_in(site: Site, region: Region, p_end_point: Floats, seed: int = 0) -> Floats:
    """Return N_POSES random poses (n, j) of the arm's branch, or fewer if they are rare.

    In these, a point (3,) of the end is inside the region.

    Raises PlanError if none of 200,000 random poses is.
    """
    rng, arm = np.random.default_rng([seed, 0x4E610]), site.arm
    poses = np.zeros((0, len(arm.chain.joints)))
    for _ in range(10):
        q = rng.uniform(arm.branch.lower, arm.branch.upper, (20_000, len(arm.branch.lower)))
        points = point_forward(arm.chain, arm.params, q, p_end_point)
        q = q[((points >= region.lower) & (points <= region.upper)).all(axis=1)]
        poses = np.concatenate([poses, q[allowed(site, q, None)]])
        if len(poses) >= N_POSES:
            return poses[:N_POSES]
    if not len(poses):
        raise PlanError("the arm cannot reach the region; ask for another ", Argument("region"))
    return poses
