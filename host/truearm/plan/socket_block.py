"""A block with two conical sockets for a ball, to be printed: its dimensions, and its surface as triangles.

A cone of 45° touches the ball in a circle, so the centre of the ball is at one point whatever the arm's posture. The
block is symmetric about the plane x = 0 between its sockets. Each half is made of rings around the axis of its socket.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from truearm.types import Floats

FLOOR, MOUTH = 0.3, 0.85  # radii of a cone's floor and mouth, in radii of the ball; it touches the ball at 0.71
WALL = 5e-3  # m, below and around a cone
N_ANGLES = 72  # of a ring


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
