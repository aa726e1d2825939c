"""Simple shapes that must not touch: the arm's links, the bar, the posts of the chucks as capsules, the table as a plane.

A capsule is what lies within a radius of a segment. The arm's segments run from the base through the joints' origins to
the end and on to each sphere: no maker's drawing, but the distance kept between them is chosen as generously as the
rest of the plan (``Sizes.link``). Neighbouring segments always touch and are not held against each other.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.model.chain import Chain, forward, joint_frames
from truearm.types import Floats, Rig

SHORT = 0.02  # m; joints whose origins are nearer than this share a segment


@dataclass(frozen=True)
class Sizes:
    """Radii [m] of links, of studs that hold spheres, of bars and of chucks' posts, and the table's height z [m]."""

    link: float = 0.05
    stud: float = 0.012
    bar: float = 0.015
    post: float = 0.02
    table: float = 0.0


class Mounted(NamedTuple):
    """What the bar connects: points in the base and the end frame, (3,)."""

    p_chuck: Floats
    p_sphere: Floats


class Shapes(NamedTuple):
    """A robot and its rig as capsules: which of the nodes (base, joints, end) the arm's segments run through."""

    chain: Chain
    params: Floats
    nodes: tuple[int, ...]  # 0 the base's foot, 1 … j the joints, j + 1 the end
    elbow: int  # index in ``nodes``, the first joint's that the second one moves
    wrist: int  # index in ``nodes``, from where on the arm is tool
    p_spheres: Floats  # (s, 3)
    p_posts: Floats  # (c, 3) the chucks
    sizes: Sizes


def make_shapes(chain: Chain, params: Floats, rig: Rig, sizes: Sizes) -> Shapes:
    """Shapes of a robot at params (p,): joints whose origins coincide, at any pose, count once."""
    nodes = _nodes(chain, params, np.zeros((1, len(chain.joints))))[0]
    kept = [0]
    for i in range(1, len(nodes)):
        if np.linalg.norm(nodes[i] - nodes[kept[-1]]) > SHORT:
            kept.append(i)
    last = len(chain.joints)
    elbow = next((k for k, node in enumerate(kept) if node > 2), len(kept) - 1)
    wrist = max(k for k, node in enumerate(kept) if node <= max(last - 1, 0))
    spheres = np.array([s.xyz for s in rig.spheres.values()]).reshape(-1, 3)
    posts = np.array([c.xyz for c in rig.chucks.values()]).reshape(-1, 3)
    return Shapes(chain, params, tuple(kept), elbow, wrist, spheres, posts, sizes)


def clear(shapes: Shapes, q: Floats, mounted: Mounted | None) -> NDArray[np.bool_]:
    """Whether nothing touches at joints q (n, j), with the bar on as ``mounted`` or off."""
    sizes = shapes.sizes
    nodes = _nodes(shapes.chain, shapes.params, q)[:, shapes.nodes]
    pose = forward(shapes.chain, shapes.params, q)
    spheres = shapes.p_spheres @ pose[:, :3, :3].swapaxes(1, 2) + pose[:, None, :3, 3]
    good = (nodes[:, shapes.elbow :, 2] > sizes.table + sizes.link).all(axis=1)
    good &= (spheres[..., 2] > sizes.table + sizes.stud).all(axis=1)
    good &= _arm_is_clear_of_itself(shapes, nodes, spheres)
    for chuck in shapes.p_posts:
        post = np.array([chuck[0], chuck[1], min(sizes.table, chuck[2])]), chuck
        for a, b in pairwise(range(shapes.elbow, len(shapes.nodes))):
            good &= segment_distance(nodes[:, a], nodes[:, b], *post) > sizes.link + sizes.post
        for k in range(spheres.shape[1]):
            good &= segment_distance(nodes[:, -1], spheres[:, k], *post) > sizes.stud + sizes.post
    if mounted is not None:
        good &= _bar_is_clear(shapes, nodes, pose, mounted)
    return good


def _arm_is_clear_of_itself(shapes: Shapes, nodes: Floats, spheres: Floats) -> NDArray[np.bool_]:
    """The tool against all that lies before the forearm: column, shoulder, upper arm."""
    good = np.ones(len(nodes), dtype=bool)
    size = shapes.sizes
    for a, b in pairwise(range(min(shapes.elbow, shapes.wrist - 1) + 1)):
        good &= segment_distance(nodes[:, a], nodes[:, b], nodes[:, shapes.wrist], nodes[:, -1]) > 2.0 * size.link
        for k in range(spheres.shape[1]):
            apart = segment_distance(nodes[:, a], nodes[:, b], nodes[:, -1], spheres[:, k])
            good &= apart > size.link + size.stud
    return good


def _bar_is_clear(shapes: Shapes, nodes: Floats, pose: Floats, mounted: Mounted) -> NDArray[np.bool_]:
    """The bar against the arm up to its wrist, and against the posts of the other chucks."""
    p_sphere = pose[:, :3, :3] @ mounted.p_sphere + pose[:, :3, 3]
    bar = p_sphere, mounted.p_chuck
    good = np.ones(len(nodes), dtype=bool)
    for a, b in pairwise(range(shapes.wrist + 1)):
        good &= segment_distance(nodes[:, a], nodes[:, b], *bar) > shapes.sizes.link + shapes.sizes.bar
    for chuck in shapes.p_posts:
        if not np.array_equal(chuck, mounted.p_chuck):
            foot = np.array([chuck[0], chuck[1], min(shapes.sizes.table, chuck[2])])
            good &= segment_distance(foot, chuck, *bar) > shapes.sizes.post + shapes.sizes.bar
    return good


def _nodes(chain: Chain, params: Floats, q: Floats) -> Floats:
    """(n, j + 2, 3) the foot of the base, the joints' origins, the end's."""
    joints = joint_frames(chain, params, q)[..., :3, 3]
    foot = np.zeros_like(joints[:, :1])
    return np.concatenate([foot, joints, forward(chain, params, q)[:, None, :3, 3]], axis=1)


def segment_distance(a0: Floats, a1: Floats, b0: Floats, b1: Floats) -> Floats:
    """Shortest distance (…) of segments a0–a1 and b0–b1, each end (…, 3) (Ericson 2005, 5.1.9).

    The nearest points of the two lines, one parameter clamped to its segment and the other one solved for again.
    """
    along_a, along_b, between = a1 - a0, b1 - b0, a0 - b0
    a, e, b = _dot(along_a, along_a), _dot(along_b, along_b), _dot(along_a, along_b)
    c, f = _dot(along_a, between), _dot(along_b, between)
    tiny = 1e-18
    across = a * e - b * b  # 0 for parallels: any point of the first does
    s = np.clip(np.where(across > tiny, (b * f - c * e) / np.where(across > tiny, across, 1.0), 0.0), 0.0, 1.0)
    t = np.clip((b * s + f) / np.maximum(e, tiny), 0.0, 1.0)
    s = np.clip((b * t - c) / np.maximum(a, tiny), 0.0, 1.0)
    apart = between + s[..., None] * along_a - t[..., None] * along_b
    return np.asarray(np.sqrt(_dot(apart, apart)))


def _dot(u: Floats, v: Floats) -> Floats:
    return np.asarray(np.einsum("...i,...i->...", u, v))
