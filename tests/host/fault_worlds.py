"""Worlds with a known fault: a planned session of 360 ball-bar poses with one bar and nine mounts.

The plan is the planner's own; the true arm is the paper's optimised PUMA, the noise that of its bar. Faults are put
into the world (chuck, reading, joint), not into the estimated quantities.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import plan_bench
from puma_bench import CHAIN, FREE, SIGMA, TRUTH

from truearm.estimate.identify import SolverOptions, identify
from truearm.kinds.table import ObservationTable
from truearm.model.chain import point_forward
from truearm.model.robot_file import builtin_robot
from truearm.plan.ball_bar_plan import all_pairings, make_site, plan_ballbar
from truearm.plan.forecast import Knowledge
from truearm.plan.options import Budget, PoseOptions
from truearm.plan.route import Visits

STANDARD = plan_bench.RIGS["puma560"]
RIG = replace(STANDARD, bars={"bar46": STANDARD.bars["bar46"]})
TOOL = np.array([0.0, 0.0, 0.04])  # m, between the spheres: the point for the true tool error


@cache
def plan(times=1, check_poses=10):
    """Return 360 poses in the order of ``truearm plan ballbar``.

    The links count as thin ones along the joints: the docs quote figures of these poses, which were planned before the
    PUMA 560 had shapes of its own, and no fault depends on them.
    """
    known = replace(Knowledge.design(builtin_robot("puma560"), RIG), links=None)
    site = make_site(known, plan_bench.LIMITS, plan_bench.SIZES)
    # The planner's default of 5000 candidates gains little and takes three times as long.
    visits = Visits(times, check_poses if times == 1 else 0)
    return plan_ballbar(site, known, all_pairings(RIG), Budget(360), PoseOptions(candidates=2000), visits).route.plan


def lengths(plan, chuck_off=0.0, q_off=0.0, sphere=None):
    """Return true lengths (n,) [m] with errors of chucks (n, 3) and joints (n, j), and spheres other than planned."""
    chucks = np.array([RIG.chucks[name].xyz for name in plan.chuck]) + chuck_off
    spheres = np.array([RIG.spheres[name].xyz for name in (plan.sphere if sphere is None else sphere)])
    return np.linalg.norm(point_forward(CHAIN, TRUTH, plan.q + q_off, spheres) - chucks, axis=1)


def table(plan, length, sphere=None):
    names = {"bar": plan.bar, "chuck": plan.chuck, "sphere": plan.sphere if sphere is None else sphere}
    source = [f"poses.csv row {i + 2}" for i in range(len(plan))]
    return ObservationTable(q=plan.q, kind="ball_bar", value=length, source=source, **names)


def clean(plan, rng):
    return table(plan, lengths(plan) + SIGMA * rng.normal(size=len(plan)))


def slipped(plan, rng, size=0.3e-3):
    """Return a table with a chuck that moves in a random direction while in use; also its name and the row."""
    chuck = rng.choice(list(RIG.chucks))
    mine = np.flatnonzero(plan.chuck == chuck)
    at = int(mine[rng.integers(len(mine) // 5, 4 * len(mine) // 5)])
    off = np.zeros((len(plan), 3))
    off[at:][plan.chuck[at:] == chuck] = size * direction(rng)
    return table(plan, lengths(plan, off) + SIGMA * rng.normal(size=len(plan))), (chuck, at)


def direction(rng):
    u = rng.normal(size=3)
    return u / np.linalg.norm(u)


def wrong_bar(plan, rng, size=0.3e-3):
    return table(plan, lengths(plan) + size + SIGMA * rng.normal(size=len(plan)))


def drifting(plan, rng, size):
    """Return a table with a sensor zero that moves linearly from 0 to ``size`` over the session."""
    return table(plan, lengths(plan) + np.linspace(0.0, size, len(plan)) + SIGMA * rng.normal(size=len(plan)))


def encoder_off(plan, rng, size=0.3e-3):
    """Return a table with an error of one of joints 1 to 3 in the middle half; also its number, from 0."""
    joint, n = int(rng.integers(3)), len(plan)
    off = np.zeros(plan.q.shape)
    off[n // 4 : 3 * n // 4, joint] = size
    return table(plan, lengths(plan, q_off=off) + SIGMA * rng.normal(size=n)), joint


def mislabelled(plan, rng):
    """Return a table with half of a mount measured with another sphere; also its first row and the one after its last."""
    sphere = plan.sphere.copy()
    mounts = np.flatnonzero(np.r_[True, (plan.chuck[1:] != plan.chuck[:-1]) | (plan.sphere[1:] != plan.sphere[:-1])])
    which = int(rng.integers(len(mounts)))
    first, end = mounts[which], np.r_[mounts, len(plan)][which + 1]
    last = first + (end - first) // 2
    sphere[first:last] = rng.choice([name for name in RIG.spheres if name != sphere[first]])
    return table(plan, lengths(plan) + SIGMA * rng.normal(size=len(plan)), sphere), (first, last)


def identified(table, effects=()):
    return identify(CHAIN, RIG, table, free=FREE, prefer=FREE, options=SolverOptions(effects=tuple(effects)))


def tool_error(estimate, plan, true_tool=TOOL):
    """Return the true RMS error [m] of the tool over the planned poses."""
    params = estimate.value[: estimate.n_robot_parameters]
    apart = point_forward(CHAIN, params, plan.q, TOOL) - point_forward(CHAIN, TRUTH, plan.q, true_tool)
    return float(np.sqrt((apart**2).sum(axis=1).mean()))


def chucks_off(plan, rng, size=0.2e-3):
    """Return a table with chucks displaced from the start, each in its own direction."""
    off = {name: size * direction(rng) for name in RIG.chucks}
    each = np.array([off[name] for name in plan.chuck])
    return table(plan, lengths(plan, each) + SIGMA * rng.normal(size=len(plan)))
