"""Goswami's plan: poses on shells about the chucks, shared evenly by the pairings, in an order with short moves.

``truearm plan ballbar`` chooses among such poses and adds via points. Here all are measured as they come, and those
with the most expensive moves are dropped.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from truearm.errors import PlanError
from truearm.plan.branches import Arm, inverse
from truearm.plan.forecast import Knowledge, arm_of
from truearm.plan.route import short_tour, untangled
from truearm.plan.shells import TRIES, grid_directions, move_costs, tool_poses
from truearm.types import BallBar, Floats, Plan, Point

# Between the tool's axis and the direction to the chuck. It separates the radius of a shell from the robot's size: with
# 35° the fit on 46 cm predicts 61 cm to 0.0890 mm (expected RMS, from 0.084 mm of noise), and to 0.103 mm in one run of
# a hundred; with 60° to 0.0875 mm and 0.095 mm.
MAX_TILT = np.deg2rad(60.0)
SURPLUS = 1.25  # poses searched for per pose visited


def plan_shells(knowledge: Knowledge, bar: str, n_poses: int = 800, seed: int = 0, speed: Floats | None = None) -> Plan:
    """Return ``n_poses`` poses with one bar, spread evenly over all pairings of chuck and sphere, in visiting order.

    ``speed`` (j,) [rad/s] weights the joints when the order of visits is chosen. Shells are named ``<bar>-<chuck>``.
    Raises PlanError if the arm has no branch or cannot reach that many points.
    """
    rig = knowledge.rig
    pairings = [(chuck, sphere) for chuck in rig.chucks.values() for sphere in rig.spheres.values()]
    if n_poses < len(pairings):
        raise PlanError(f"{n_poses} poses are too few for {len(pairings)} pairings; give at least one pose per pairing")
    rng = np.random.default_rng(seed)
    arm = arm_of(knowledge, rng)
    counts = np.diff(np.linspace(0, n_poses, len(pairings) + 1).astype(int))
    reached = _reachable(arm, rig.bars[bar], pairings, int(counts.max() * SURPLUS) + 1, rng)
    weights = np.ones(len(arm.chain.joints)) if speed is None else 1.0 / np.asarray(speed)
    start = 0.5 * (arm.branch.lower + arm.branch.upper)
    poses = []
    for (chuck, sphere), count, q in zip(pairings, counts, reached, strict=True):
        cost = move_costs(arm, q, weights, rig.bars[bar], chuck, sphere)
        order = short_tour(np.abs((q - start) * weights).max(axis=-1), cost)
        poses.append(q[untangled(without_dearest(order, cost, int(count)), cost)])
        start = poses[-1][-1]
    names = np.repeat(
        [(f"{bar}-{chuck.name}", bar, chuck.name, sphere.name) for chuck, sphere in pairings], counts, axis=0
    )
    return Plan(np.concatenate(poses), *names.T)


def _reachable(
    arm: Arm, bar: BallBar, pairings: Sequence[tuple[Point, Point]], count: int, rng: np.random.Generator
) -> list[Floats]:
    """Return ``count`` joint vectors for each pairing; the grid is refined until all pairings reach enough of it."""
    p_chuck, p_sphere = np.array([(chuck.xyz, sphere.xyz) for chuck, sphere in pairings]).swapaxes(0, 1)
    n_places = 3 * count
    for _ in range(5):
        directions = grid_directions(n_places)
        pairing, place = np.divmod(np.arange(len(pairings) * len(directions)), len(directions))
        q = np.full((len(place), len(arm.chain.joints)), np.nan)
        for _ in range(TRIES):
            left = np.flatnonzero(np.isnan(q[:, 0]))
            which = pairing[left]
            q[left] = inverse(
                arm, tool_poses(directions[place[left]], bar.zero, p_chuck[which], p_sphere[which], rng, MAX_TILT)
            )
        found = [q[(pairing == i) & ~np.isnan(q[:, 0])] for i in range(len(pairings))]
        if min(map(len, found)) >= count:
            return [rows[np.linspace(0, len(rows) - 1, count).round().astype(int)] for rows in found]
        n_places *= 2
    chuck, sphere = pairings[int(np.argmin([len(rows) for rows in found]))]
    raise PlanError(
        f"the arm reaches too few poses with bar {bar.name} between chuck {chuck.name} and sphere {sphere.name}; "
        "give another length of the bar, move the chucks, or allow more of the joints' range"
    )


def without_dearest(order: NDArray[np.int64], cost: Floats, count: int) -> NDArray[np.int64]:
    """Return the tour with the most expensive points removed one by one until ``count`` are left."""
    while len(order) > count:
        moves = np.concatenate([[0.0], cost[order[:-1], order[1:]], [0.0]])
        shortcuts = np.concatenate([[0.0], cost[order[:-2], order[2:]], [0.0]])
        order = np.delete(order, int(np.argmax(moves[:-1] + moves[1:] - shortcuts)))
    return order
