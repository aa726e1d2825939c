"""Robots with their own rigs for tests of planning, and an independent check of entire routes."""

from functools import cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import pytest

from truearm.model.chain import forward, joint_frames, joint_jacobian
from truearm.model.robot_file import builtin_robot
from truearm.plan.ball_bar_plan import all_pairings, make_site, plan_ballbar
from truearm.plan.forecast import Knowledge
from truearm.plan.measurement_limits import Limits, Sizes
from truearm.plan.options import Budget, PoseOptions
from truearm.types import BallBar, Point, Rig
from truearm_sim.world import standard_rig

SIGMA = 84e-6  # m
N_POSES = 54


def triangle(prefix, centre, radius):
    turns = 0.2 + 2.0 * np.pi * np.arange(3) / 3.0
    corners = [(centre[0] + radius * np.cos(a), centre[1] + radius * np.sin(a), centre[2]) for a in turns]
    return {f"{prefix}{i + 1}": Point(f"{prefix}{i + 1}", tuple(map(float, c))) for i, c in enumerate(corners)}


def bars(**zeros):
    return {name: BallBar(name, zero, 1.0, 0.075, SIGMA) for name, zero in zeros.items()}


RIGS = {
    "puma560": standard_rig(),
    "ur5e": Rig(
        triangle("c", (0.45, 0.05, 0.06), 0.14), triangle("s", (0.0, 0.0, 0.05), 0.08), bars(bar35=0.35, bar45=0.45)
    ),
    "irb120": Rig(
        triangle("c", (0.38, 0.0, 0.06), 0.10), triangle("s", (0.0, 0.0, 0.04), 0.06), bars(bar25=0.25, bar32=0.32)
    ),
}
ROBOTS = ("puma560", "ur5e", pytest.param("irb120", marks=pytest.mark.soak))
LIMITS, SIZES = Limits(), Sizes()


@cache
def known(name):
    return Knowledge.design(builtin_robot(name), RIGS[name])


@cache
def site(name):
    return make_site(known(name), LIMITS, SIZES)


@cache
def planned(name, n=N_POSES, n_candidates=200):
    rig = RIGS[name]
    return plan_ballbar(site(name), known(name), all_pairings(rig), Budget(n), PoseOptions(candidates=n_candidates))


class Course(NamedTuple):
    """The stops of a route: joints, poses of its plan (-1 of via points), where the bar is mounted, seconds to it."""

    q: np.ndarray
    pose: np.ndarray
    mount: np.ndarray
    seconds: np.ndarray

    @classmethod
    def of(cls, route):
        dwells = np.array([stop.move == "dwell" for stop in route.stops])
        pose = np.where(dwells, np.cumsum(dwells) - 1, -1)
        columns = ([getattr(stop, name) for stop in route.stops] for name in ("q", "there", "seconds"))
        q, there, seconds = map(np.array, columns)
        return cls(q, pose, there != "", seconds)


def legs(route, step=0.015):
    """Yield for each stop after the first: (number, joints (n, j) on the way to it, denser than the planner's)."""
    q = Course.of(route).q
    for i in range(1, len(q)):
        n = 2 + int(np.abs(q[i] - q[i - 1]).max() / step)
        yield i, q[i - 1] + np.linspace(0.0, 1.0, n)[:, None] * (q[i] - q[i - 1])


def connected(route, i):
    """Return chuck, sphere and bar on the way to stop i, None while the bar is off."""
    course = Course.of(route)
    ahead = next(k for k in range(i, len(course.q)) if course.pose[k] >= 0)
    if any(course.mount[k] for k in range(i, ahead + 1)):
        return None
    pose = course.pose[ahead]
    return str(route.plan.chuck[pose]), str(route.plan.sphere[pose]), str(route.plan.bar[pose])


def bar_of(name, q, mounted):
    """Return bar vectors (n, 3) from chuck to sphere and the end's z axes (n, 3)."""
    chuck, sphere, _ = mounted
    rig = RIGS[name]
    pose = forward(known(name).chain, known(name).params, q)
    ends = pose @ np.array([*rig.spheres[sphere].xyz, 1.0])
    return ends[:, :3] - rig.chucks[chuck].xyz, pose[:, :3, 2]


def condition(name, q):
    jacobian = joint_jacobian(known(name).chain, known(name).params, q)
    return np.linalg.svd(jacobian / np.array([0.45] * 3 + [1.0] * 3)[:, None], compute_uv=False)[:, -1]


def along(a, b, n=12):
    """Return points (..., n, 3) on segments."""
    return a[..., None, :] + np.linspace(0.0, 1.0, n)[:, None] * (b - a)[..., None, :]


def nearest(a, b):
    """Return the shortest distance (m,) of point sets (m, k, 3) and (m, l, 3) or (l, 3)."""
    b = np.broadcast_to(b, (len(a), *b.shape[-2:]))
    return np.linalg.norm(a[:, :, None] - b[:, None], axis=-1).min(axis=(1, 2))


# Universal Robots' upper arm and forearm lie beside the plane of their joints' origins (shoulder_offset, elbow_offset
# of Universal_Robots_ROS2_Description, config/ur5e/physical_parameters.yaml): frame, start, end.
BESIDE = {"ur5e": ((1, (0.0, 0.0, 0.138), (-0.425, 0.0, 0.138)), (2, (0.0, 0.0, 0.007), (-0.3922, 0.0, 0.007)))}


FLANGE = {
    "irb120": 0.025
}  # m, radius in the maker's mesh: the last two of ``arm_points``, 12 mm, are thinner than the links


def arm_points(name, q):
    """Return points (n, k, 3) of the upper arm, and from forearm to flange: they must not touch table, posts or bar."""
    frames = joint_frames(known(name).chain, known(name).params, q)
    end = forward(known(name).chain, known(name).params, q)[:, :3, 3]
    if name in BESIDE:
        upper, fore = (
            along(*(frames[:, i, :3, :3] @ np.array(p) + frames[:, i, :3, 3] for p in (a, b)))
            for i, a, b in BESIDE[name]
        )
        nodes = frames[:, 3:, :3, 3]
    else:
        upper, fore = along(frames[:, 1, :3, 3], frames[:, 2, :3, 3]), frames[:, 2:3, :3, 3]
        nodes = frames[:, 2:, :3, 3]
    rest = [along(a, b) for a, b in pairwise([*nodes.swapaxes(0, 1), end])]
    return upper, np.concatenate([fore, *rest], axis=1)
