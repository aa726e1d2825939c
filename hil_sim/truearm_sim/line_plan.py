"""A rig and plans for the simulated line device: random lines in the workspace, driven in both directions."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from truearm.model.robot import Robot
from truearm.model.robot_file import builtin_robot
from truearm.plan import plan_file
from truearm.plan.ball_bar_plan import make_site
from truearm.plan.bar_paths import way_without_bar
from truearm.plan.branches import branch_of
from truearm.plan.forecast import Knowledge
from truearm.plan.line_plan import candidate_lines
from truearm.plan.measurement_limits import Limits, Site, Sizes
from truearm.plan.options import LineOptions
from truearm.types import Floats, Plan, Point, Rig
from truearm_sim.line_device import REACH
from truearm_sim.true_robot import PAPER

MAGNET = "magnet"
TARGETS = {MAGNET: Point(MAGNET, (0.0, 0.0, 0.10))}
LENGTH = 0.5  # m
SPEED = 0.1  # m/s
JOINT_SPEED = 1.0  # rad/s at most on a line


def line_rig(rig: Rig | None = None) -> Rig:
    """Return a rig with a magnet for the line device on the endpoint, in addition to its other items."""
    return replace(rig or Rig(), targets=TARGETS, line_travel=2.0 * REACH)


def drawn_line_plan(
    n_lines: int,
    seed: int = 0,
    rig: Rig | None = None,
    speed: float = SPEED,
    back: bool = True,
    robot: Robot | None = None,
) -> Plan:
    """Return ``n_lines`` lines, named l1, l2 …, driven forwards and, with ``back``, back; via points connect them.

    ``robot``: the PUMA 560 by default. Raises PlanError if the arm has no branch or cannot reach such lines.
    """
    robot = robot or builtin_robot(PAPER)
    knowledge = replace(Knowledge.design(robot, rig or line_rig()), branch=branch_of(robot))
    site = make_site(knowledge, Limits(), Sizes(), seed)
    point = np.array(TARGETS[MAGNET].xyz)
    found = candidate_lines(
        site, LineOptions(length=LENGTH, speed=speed), n_lines, point, JOINT_SPEED, seed=seed, fewest=n_lines
    )
    parts = [lines_plan(q, f"l{i}", speed, back) for i, q in enumerate(found.q[:, [0, -1]], start=1)]
    return plan_file.concatenate(*with_ways(site, parts))


def lines_plan(ends: Floats, name: str, speed: float, back: bool) -> Plan:
    """Return a plan to one end (2, j) by joints, along the line to the other, and back."""
    q = ends[[0, 1, 0]] if back else ends
    n, none = len(q), np.full(len(q), "")
    on_line = np.arange(n) > 0
    return Plan(
        q,
        *(none,) * 4,
        move=np.where(on_line, "line", "via"),
        line=np.where(on_line, name, ""),
        target=np.where(on_line, MAGNET, ""),
        speed=np.where(on_line, speed, np.nan),
    )


def with_ways(site: Site, parts: list[Plan]) -> list[Plan]:
    """Return the parts of a plan with collision-free via points between them. Raises PlanError if there is no path."""
    out = parts[:1]
    for before, after in pairwise(parts):
        via = way_without_bar(site, before.q[-1], after.q[0], "the next line")
        if len(via):
            none = np.full(len(via), "")
            out.append(Plan(np.array(via), none, none, none, none, move=np.full(len(via), "via")))
        out.append(after)
    return out
