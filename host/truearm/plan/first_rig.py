"""A rig for an arm for which none has been built: where chucks, spheres and bars would do, in proportion to the arm's reach."""

from __future__ import annotations

import math

import numpy as np

from truearm.model.chain import forward, joint_frames
from truearm.model.robot import Robot
from truearm.plan.branches import branch_of
from truearm.types import BallBar, Point, Rig
from truearm.units import CM

REPEATABILITY = 84e-6  # m, Goswami 1993: what a dwell of the paper's bar repeated to
TRAVEL = 75e-3  # m, of the paper's bar
# Of the reach: where the chucks' middle lies before the base, circles of chucks and of spheres, two bars. Shells of these radii
# are reached from all around by arms of 0.5 to 2 m.
BEFORE, ASIDE, CHUCKS, SPHERES, SHORT, LONG = 0.53, 0.05, 0.165, 0.094, 0.42, 0.53
TABLE, PLATE = 0.07, 0.05  # m, heights of chucks above the base, of spheres before the flange
SHARE = 0.92  # of the reach: the outermost poses are singular
POSES = 2000  # drawn, to find how far the arm reaches


def reach(robot: Robot) -> float:
    """How far [m] the end comes from the second joint, of poses drawn in the robot's branch. Raises PlanError for a robot without one."""
    branch, chain = branch_of(robot), robot.chain
    q = np.random.default_rng(0).uniform(branch.lower, branch.upper, (POSES, len(chain.joints)))
    end = forward(chain, chain.params_nominal, q)[:, :3, 3]
    shoulder = joint_frames(chain, chain.params_nominal, q)[:, 1, :3, 3]
    return float(np.linalg.norm(end - shoulder, axis=1).max())


def first_rig(robot: Robot, bars: tuple[float, ...] = (), known: float | None = None, zero_sigma: float = 1e-4) -> Rig:
    """Three chucks before the arm, three spheres on its end, and bars of these lengths [m]; () for two that suit the reach.

    Coordinates are a proposal. ``known`` [m]: how well they will be known; None: not at all. ``zero_sigma`` [m]: how well the first bar's
    length will be; the others' are estimated from 1 mm. Raises PlanError for a robot without a branch.
    """
    r = SHARE * reach(robot)
    zeros = bars or (round(SHORT * r, 2), round(LONG * r, 2))
    made: dict[str, BallBar] = {}
    for zero in zeros:
        name = f"bar{round(CM.of(zero))}"
        sigma = zero_sigma if not made else max(zero_sigma, 1e-3)
        made[name] = BallBar(name, zero, 1.0, TRAVEL, REPEATABILITY, sigma, 1e-3)
    return Rig(
        chucks=_circle("c", (BEFORE * r, ASIDE * r, TABLE), CHUCKS * r, 0.2, known),
        spheres=_circle("s", (0.0, 0.0, PLATE), SPHERES * r, 0.5, known),
        bars=made,
    )


def _circle(
    prefix: str, centre: tuple[float, float, float], radius: float, turn: float, known: float | None
) -> dict[str, Point]:
    points = {}
    for i in range(3):
        angle = turn + 2.0 * math.pi * i / 3.0
        x, y = centre[0] + radius * math.cos(angle), centre[1] + radius * math.sin(angle)
        name = f"{prefix}{i + 1}"
        points[name] = Point(name, (round(x, 3), round(y, 3), centre[2]), known)
    return points
