"""A block with two conical sockets for a ball, to be printed.

Also its places, and joint readings with the ball in each socket.

A cone of 45° touches the ball in a circle, so the centre of the ball is at one point whatever the arm's posture. It
works for any arm with four joints or more, because a seat prescribes three coordinates of the ball and no orientation.
Random postures show where the ball can be; postures near a socket are then moved into it by Newton's method. Of these,
the ones that differ most are taken.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from truearm.errors import Argument, PlanError
from truearm.model.chain import forward, joint_frames, point_forward, point_jacobians
from truearm.model.robot import Robot
from truearm.plan.measurement_limits import Shapes, Sizes, along_joints, clear, make_shapes
from truearm.plan.route import short_tour
from truearm.types import Floats, Point, Rig, Triple
from truearm.units import MM

FLOOR, MOUTH = 0.3, 0.85  # radii of a cone's floor and mouth, in radii of the ball; it touches the ball at 0.71
WALL = 5e-3  # m, below and around a cone
N_ANGLES = 72  # of a ring
MIN_JOINTS = 4  # with three, a ball in a socket leaves the arm no choice of its posture
N_POSTURES = 30_000
N_NEAR = 400  # postures that are moved into a socket
N_STEPS = 8
STEP = 0.3  # rad, m
SEATED = 1e-7  # m
TILT = np.radians(50.0)  # greatest angle of the ball's stem with the vertical
# m, radius of the links of an arm whose file has none; of a small arm, in lengths of the arm
LINK, SLENDER = 0.05, 0.08
NEAREST = 0.35  # of the reach: least distance of a place from the base
EDGE = 0.3  # of the length: distance from the base at which a table higher than the base begins
UNIT_Z = np.array([0.0, 0.0, 1.0])  # the stem of a ball in the origin of the end frame
MARGIN = 0.03  # rad, m from the limits
DIFFERENT = 0.1  # rad, m between the postures in a socket
SLAB = 0.1  # of the reach: random postures within it of a place tell how well the arm gets there
RAISED = 0.15  # of the reach: height of the lowest box, and from one box to the next
N_HEIGHTS = 6  # of places: on the table, and on boxes
N_TRIED = 6  # spots, for each place


@dataclass(frozen=True)
class SocketBlock:
    """A block for a ball of this ``radius`` [m]. Its origin is in the middle of its bottom, its sockets are on x."""

    radius: float

    @property
    def distance(self) -> float:
        """Return the distance of the sockets [m]."""
        return max(50e-3, 5.0 * self.radius)

    @property
    def size(self) -> tuple[float, float, float]:
        """Return length, width and height [m]."""
        margin = MOUTH * self.radius + WALL
        return self.distance + 2.0 * margin, 2.0 * margin, WALL + (MOUTH - FLOOR) * self.radius

    @property
    def centre_height(self) -> float:
        """Return the height of a seated ball's centre above the bottom [m]."""
        return WALL + (math.sqrt(2.0) - FLOOR) * self.radius

    def triangles(self) -> Floats:
        """Return the corners (n, 3, 3) [m] of the closed surface, counterclockwise as seen from outside."""
        length, width, height = self.size
        middle, lower, upper = 0.5 * self.distance, np.array([0.0, -0.5 * width]), np.array([0.5 * length, 0.5 * width])
        corners = [(x, y) for x in (lower[0] - middle, upper[0] - middle) for y in (lower[1], upper[1])]
        angles = np.linspace(-np.pi, np.pi, N_ANGLES, endpoint=False)
        angles = np.unique(np.concatenate([angles, [math.atan2(y, x) for x, y in corners]]).round(9))
        ray = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        with np.errstate(divide="ignore"):
            sides = np.where(ray > 0.0, upper - [middle, 0.0], [middle, 0.0] - lower) / np.abs(ray)
        border = sides.min(axis=1, keepdims=True)
        rings = [(0.0, WALL), (FLOOR * self.radius, WALL), (MOUTH * self.radius, height)]
        rings += [(border, height), (border, 0.0), (0.0, 0.0)]
        points = [np.column_stack([r * ray + [middle, 0.0], np.full(len(ray), z)]) for r, z in rings]
        ring = np.array(points).round(7)
        follower = np.roll(ring, -1, axis=1)
        quarters = [(ring[:-1], ring[1:], follower[1:]), (ring[:-1], follower[1:], follower[:-1])]
        half = np.concatenate([np.stack(corner, axis=2).reshape(-1, 3, 3) for corner in quarters])
        area = np.linalg.norm(np.cross(half[:, 1] - half[:, 0], half[:, 2] - half[:, 0]), axis=1)
        half = half[(area > 0.0) & np.any(half[:, :, 0] > 0.0, axis=1)]  # none between the halves
        return np.concatenate([half, (half * [-1.0, 1.0, 1.0])[:, ::-1]])


@dataclass(frozen=True)
class Site:
    """A place of the block: the middle of its bottom (3,) [m], and the direction (3,) from first to second socket.

    ``q`` are the joint readings (n, j) with the ball in each of them, in an order of short moves.
    """

    place: Floats
    direction: Floats
    q: tuple[Floats, ...]


@dataclass(frozen=True)
class _Arm:
    shapes: Shapes
    limits: Floats  # (2, m) of the motors: a mimic joint has none of its own
    ball: Floats  # (3,) in the end frame, m

    def p_ball(self, q: Floats) -> Floats:
        """Return the ball's position (n, 3) in the base frame."""
        return point_forward(self.shapes.chain, self.shapes.params, q, self.ball)

    def is_clear(self, q: Floats) -> NDArray[np.bool_]:
        """Return which postures (n, j) have a steep stem of the ball, and touch neither table nor arm."""
        stem = forward(self.shapes.chain, self.shapes.params, q)[:, :3, :3] @ (self.ball if self.ball.any() else UNIT_Z)
        steep = np.flatnonzero(stem[:, 2] < -np.cos(TILT) * np.linalg.norm(stem, axis=1))
        steep = steep[clear(self.shapes, q[steep], None)]
        return np.isin(np.arange(len(q)), steep)

    def seated(self, q: Floats, socket: Floats, count: int) -> Floats:
        """Return ``count`` postures with the ball at ``socket`` (3,) that differ, sought from q (n, j).

        They are fewer if the arm has not so many.
        """
        lower, upper = self.limits
        for _ in range(N_STEPS):
            p, _, jacobian = point_jacobians(self.shapes.chain, self.shapes.params, q, self.ball)
            step = (np.linalg.pinv(jacobian, rcond=1e-3) @ (socket - p)[..., None])[..., 0]
            q = q + np.clip(step, -STEP, STEP)
        q, motors = self.shapes.chain.completed(q), self.shapes.chain.motors
        usable = (np.linalg.norm(self.p_ball(q) - socket, axis=1) < SEATED) & self.is_clear(q)
        usable &= np.all((q[:, motors] > lower + MARGIN) & (q[:, motors] < upper - MARGIN), axis=1)
        q = q[usable]
        q = q[_spread(q, count, min_distance=DIFFERENT)]
        distance = np.abs(q[:, None] - q).max(axis=2)
        return q[short_tour(np.abs(q).max(axis=1), distance)] if len(q) else q


def plans_of_sites(
    robot: Robot, ball: Triple, block: SocketBlock, table: float, n_sites: int, n_seats: int
) -> Iterator[list[Site]]:
    """Yield plans of ``n_sites`` places with ``n_seats`` seats each, for a ball on the end and a table's height [m].

    Each has places at two heights: the table or a box, and a higher box. Plans with low boxes come first. All places
    are before the base, where its x axis points. Raises PlanError for an arm with fewer than four joints, or one that
    does not reach as many places.
    """
    chain = robot.chain
    joints = len(chain.motors)
    if joints < MIN_JOINTS:
        raise PlanError(f"robot {chain.name} has {joints} joints; a plan of sockets needs four or more", joints=joints)
    arm = _arm(robot, np.array(ball), block, table)
    q = np.random.default_rng(0).uniform(arm.limits[0], arm.limits[1], (N_POSTURES, joints))
    q = chain.completed(q)
    q = q[arm.is_clear(q)]
    p_ball = arm.p_ball(q)
    distance = np.linalg.norm(p_ball[:, :2], axis=1)
    reach = float(distance.max(initial=0.0))
    in_front = (p_ball[:, 0] > 0.0) & (distance > max(NEAREST * reach, arm.shapes.sizes.edge + 0.5 * block.size[0]))
    q, p_ball = q[in_front], p_ball[in_front]

    @cache
    def site_at(bottom: tuple[float, ...]) -> Site | None:
        return _site(arm, block, q, p_ball, np.array(bottom), n_seats)

    levels = [_level(block, p_ball, table + round(step * RAISED * reach, 2), reach) for step in range(N_HEIGHTS)]
    n_best = 0
    for pair in sorted(combinations(range(N_HEIGHTS), 2), key=sum):
        sites: list[Site] = []
        for bottoms, count in zip((levels[step] for step in pair), (n_sites - n_sites // 2, n_sites), strict=True):
            occupied = np.array([site.place[:2] for site in sites]).reshape(-1, 2)
            order = _spread(np.concatenate([occupied, bottoms[:, :2]]), N_TRIED * n_sites, len(sites))
            for bottom in bottoms[order - len(sites)].tolist():
                if len(sites) < count and (site := site_at(tuple(bottom))) is not None:
                    sites.append(site)
        n_best = max(n_best, len(sites))
        if len(sites) == n_sites:
            yield sites
    if n_best < n_sites:
        raise PlanError(
            f"robot {chain.name} reaches {n_best} of {n_sites} places on a table at {MM.text(table)} in {n_seats} "
            "postures that differ; ask for fewer ",
            *(Argument("places"), " or ", Argument("seats"), ", or correct ", Argument("ball_xyz_mm")),
            *(" or ", Argument("table_mm")),
            **{"reached": n_best, "places": n_sites},
        )


def _arm(robot: Robot, ball: Floats, block: SocketBlock, table: float) -> _Arm:
    chain, params, branch = robot.chain, robot.chain.params_nominal, robot.branch
    limits = np.clip(chain.limits, -np.pi, np.pi) if branch is None else np.array([branch.lower, branch.upper])
    origins = joint_frames(chain, params, np.zeros(len(chain.joints)))[:, :3, 3]
    length = float(np.linalg.norm(np.diff(origins, axis=0), axis=1).sum())
    link = min(LINK, SLENDER * length)
    links = robot.capsules
    if links is None:
        links = along_joints(chain, params, link)
        links.radius[-1] = min(link, block.radius)  # it may be the stem
    rig = Rig(spheres={"ball": Point("ball", (float(ball[0]), float(ball[1]), float(ball[2])))})
    sizes = Sizes(link=link, stud=block.radius, table=table, edge=EDGE * length if table > 0.0 else 0.0)
    return _Arm(make_shapes(chain, params, rig, sizes, links), limits[:, chain.motors], ball)


def _level(block: SocketBlock, p_ball: Floats, height: float, reach: float) -> Floats:
    """Return the spots (n, 3) at a height to which more postures lead than to half of all."""
    nearby = p_ball[np.abs(p_ball[:, 2] - height - block.centre_height) < SLAB * reach, :2]
    if not len(nearby):
        return np.empty((0, 3))
    tree = KDTree(nearby)
    count = tree.query_ball_point(nearby, SLAB * reach, return_length=True)
    spots = nearby[count >= np.median(count)].round(2)
    return np.column_stack([spots, np.full(len(spots), height)])


def _site(arm: _Arm, block: SocketBlock, q: Floats, p_ball: Floats, place: Floats, n_seats: int) -> Site | None:
    """Return a place with its seats; None if the arm does not reach both sockets in enough postures."""
    x, y = place[:2] / max(float(np.linalg.norm(place[:2])), 1e-9)
    direction = np.array([-y, x, 0.0])
    seats = []
    for side, count in ((-0.5, n_seats - n_seats // 2), (0.5, n_seats // 2)):
        socket = place + [0.0, 0.0, block.centre_height] + side * block.distance * direction
        nearest = np.argsort(np.linalg.norm(p_ball - socket, axis=1))[:N_NEAR]
        seats.append(arm.seated(q[nearest], socket, count))
        if len(seats[-1]) < count:
            return None
    return Site(place, direction, tuple(seats))


def _spread(points: Floats, count: int, n_taken: int = 0, min_distance: float = 0.0) -> NDArray[np.intp]:
    """Return up to ``count`` of the points (n, d), always the one farthest from all others taken.

    The first ``n_taken`` count as taken. No two are equal, or as close as ``min_distance``.
    """
    chosen = list(range(n_taken))
    distance = np.abs(points[:, None] - points[:n_taken]).max(axis=2).min(axis=1, initial=np.inf)
    while len(points) and len(chosen) < n_taken + count:
        farthest = int(distance.argmax())
        if distance[farthest] <= min_distance:
            break
        chosen.append(farthest)
        distance = np.minimum(distance, np.abs(points - points[farthest]).max(axis=1))
    return np.array(chosen[n_taken:], dtype=np.intp)
