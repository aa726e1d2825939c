"""A rig for an arm that has none yet: suitable chucks, spheres and bars in proportion to the arm's reach."""

from __future__ import annotations

import math

import numpy as np

from truearm.model.chain import forward, joint_frames
from truearm.model.robot import Branch, Robot
from truearm.plan.branches import branch_of
from truearm.types import BallBar, Point, Rig
from truearm.units import CM

REPEATABILITY = 84e-6  # m, Goswami 1993: the repeatability of a dwell with the paper's bar
TRAVEL = 75e-3  # m, of the paper's bar
# Relative to the reach: the centre of the chucks in front of the base, the circles of chucks and of spheres, two bars.
# Arms of 0.5 to 2 m reach shells of these radii from all sides.
BEFORE, ASIDE, CHUCKS, SPHERES, SHORT, LONG = 0.53, 0.05, 0.165, 0.094, 0.42, 0.53
TABLE, PLATE = 0.07, 0.05  # m, height of the chucks above the base, distance of the spheres from the flange
SHARE = 0.92  # of the reach: the outermost poses are singular
POSES = 2000  # random poses, to find the arm's reach


def reach(robot: Robot, branch: Branch) -> float:
    """Return the greatest distance of the end from the second joint [m] over random poses of a branch."""
    chain = robot.chain
    q = np.random.default_rng(0).uniform(branch.lower, branch.upper, (POSES, len(branch.lower)))
    end = forward(chain, chain.params_nominal, q)[:, :3, 3]
    shoulder = joint_frames(chain, chain.params_nominal, q)[:, 1, :3, 3]
    return float(np.linalg.norm(end - shoulder, axis=1).max())


def first_rig(robot: Robot, chucks: int = 3, spheres: int = 3) -> Rig:
    """Return a rig with chucks in front of the arm, spheres on its end and two bars; all as if known exactly.

    Raises PlanError for a robot without a branch.
    """
    r = SHARE * reach(robot, branch_of(robot))
    return Rig(
        chucks=circle("c", chucks, (BEFORE * r, ASIDE * r, TABLE), CHUCKS * r, turn=0.2, digits=3),
        spheres=circle("s", spheres, (0.0, 0.0, PLATE), SPHERES * r, turn=0.5, digits=3),
        bars=bars(round(SHORT * r, 2), round(LONG * r, 2)),
    )


def bars(*zeros: float) -> dict[str, BallBar]:
    """Return bars of these lengths [m], named by their length in centimetres."""
    names = [f"bar{round(CM.of(zero))}" for zero in zeros]
    return {name: BallBar(name, zero, 1.0, TRAVEL, REPEATABILITY) for name, zero in zip(names, zeros, strict=True)}


def circle(
    prefix: str, count: int, centre: tuple[float, float, float], radius: float, *, turn: float, digits: int
) -> dict[str, Point]:
    """Return points evenly spaced on a circle in a plane of constant z [m], rounded to this number of digits."""
    points = []
    for i in range(count):
        angle = turn + 2.0 * math.pi * i / count
        x, y = centre[0] + radius * math.cos(angle), centre[1] + radius * math.sin(angle)
        points.append(Point(f"{prefix}{i + 1}", (round(x, digits), round(y, digits), centre[2])))
    return {point.name: point for point in points}
