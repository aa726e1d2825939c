"""Simple shapes that must not touch: the arm's links, the bar, chuck posts and a line device as capsules; the table as
a plane.

A capsule is the set of points within a radius of a segment; those of the arm come from its robot file or from
``along_joints``. Neighbouring links always touch and are not checked against each other. Within the arm, only the links
that carry the tool are checked against those that carry the elbow.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.model.chain import Chain, forward, joint_and_end_frames, joint_frames
from truearm.model.workspace import Capsules
from truearm.types import Floats, Rig

UPPER_ARM = 2  # the joint that moves it first
BEFORE_FOREARM = 4  # joints from the elbow on: the tool can be folded into the links before them
ALONG = np.linspace(0.0, 1.0, 9)  # points of a capsule that are compared with a table
SHORT = 0.02  # m; joints with origins closer than this share a segment


@dataclass(frozen=True)
class Sizes:
    """Dimensions [m]: radii of the parts, how far a line device's rod extends beyond either end of its line, the
    table's height z.

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
    ends, pose = link_ends_and_pose(shapes, q)
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


def link_ends(shapes: Shapes, q: Floats) -> Floats:
    """Return the ends (n, m, 2, 3) of the arm's capsules in the base frame."""
    return link_ends_and_pose(shapes, q)[0]


def link_ends_and_pose(shapes: Shapes, q: Floats) -> tuple[Floats, Floats]:
    """Return the result of ``link_ends``, and the pose (n, 4, 4) of the end."""
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
    return not carried or bool(_wrist_is_clear(shapes, link_ends(shapes, q), start, end, sizes.rod).all())


def _wrist_is_clear(shapes: Shapes, ends: Floats, start: Floats, end: Floats, radius: float) -> NDArray[np.bool_]:
    """Return a mask (n,) of whether the arm up to its wrist stays clear of a capsule.

    The parts that carry the end of a bar or a magnet necessarily touch it.
    """
    inner = np.array(shapes.links.joint) < tool_joint(shapes)
    distance = _from(ends[:, inner], start, end)
    return np.asarray((distance > shapes.links.radius[inner] + radius).all(axis=1))


def tool_joint(shapes: Shapes) -> int:
    """Return the first joint (from 1) that counts as tool: the last but one, as the last turns about the tool's axis."""
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
