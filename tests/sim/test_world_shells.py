"""Plans on shells: where the poses lie, how they see the robot, and that the arm and the bar can follow."""

from dataclasses import replace

import numpy as np
import pytest

from truearm.errors import PlanError
from truearm.model.chain import forward, joint_jacobian
from truearm.model.robot_file import builtin_robot
from truearm.plan import route as tour
from truearm.plan.forecast import Knowledge
from truearm.types import Point, Rig
from truearm_sim import shells
from truearm_sim.world import World, standard_plan, standard_rig

ROBOT = builtin_robot("puma560")
DESIGN, OPTIMISED = ROBOT.parameter_sets["design"], ROBOT.parameter_sets["optimised"]
RIG = standard_rig()
KNOWN = Knowledge.design(ROBOT, RIG)


@pytest.fixture(scope="module")
def plan():
    return standard_plan(800)


def points(plan, kind):
    return np.array([getattr(RIG, kind + "s")[name].xyz for name in getattr(plan, kind)])


def bar_vectors(plan, params, q=None):
    """Return vectors from chuck to sphere, (n, 3), and the end's axes (n, 3, 3)."""
    poses = forward(ROBOT.chain, params, plan.q if q is None else q)
    p_sphere = (poses[:, :3, :3] @ points(plan, "sphere")[..., None])[..., 0] + poses[:, :3, 3]
    return p_sphere - points(plan, "chuck"), poses[:, :3, :3]


def test_poses_lie_evenly_on_their_shells(plan):
    zero = np.where(plan.bar == "bar46", 0.46, 0.61)
    vectors, _ = bar_vectors(plan, DESIGN)
    # Inverse kinematics stops at 1e-7 in units of LEVER (0.45 m) and radians, at a sphere 0.14 m from the end.
    assert np.abs(np.linalg.norm(vectors, axis=1) - zero).max() < 1e-7
    assert np.all(vectors[:, 2] > 0.0)
    for name, chuck, bar in zip(plan.shell, plan.chuck, plan.bar, strict=True):
        assert name == f"{bar}-{chuck}"
    for bar in ("bar46", "bar61"):
        rows = plan.bar == bar
        assert rows.sum() == 800
        pairings, counts = np.unique(np.stack([plan.chuck[rows], plan.sphere[rows]]), axis=1, return_counts=True)
        assert pairings.shape[1] == 9
        assert counts.max() - counts.min() <= 1
    vectors, _ = bar_vectors(plan, DESIGN)
    latitude = np.rad2deg(np.arcsin(vectors[:, 2] / np.linalg.norm(vectors, axis=1)))
    longitude = np.rad2deg(np.arctan2(vectors[:, 1], vectors[:, 0]))
    for shell in np.unique(plan.shell):
        rows = plan.shell == shell
        assert np.ptp(latitude[rows]) > 60.0
        assert len(np.unique(longitude[rows] // 30.0)) >= 9  # of 12 sectors


def test_tool_orientation_is_varied_and_faces_the_chuck(plan):
    vectors, axes = bar_vectors(plan, DESIGN)
    facing = -np.einsum("ni,ni->n", vectors, axes[:, :, 2]) / np.linalg.norm(vectors, axis=1)
    angle = np.rad2deg(np.arccos(facing))
    assert angle.max() < 60.0 + 1e-3
    for chuck in RIG.chucks:
        for sphere in RIG.spheres:
            rows = (plan.chuck == chuck) & (plan.sphere == sphere)
            assert angle[rows].std() > 5.0
            # The mean resultant of the turns about the axis: 1 for one turn, about 1/√n for the whole circle.
            turn = np.arctan2(axes[rows, 2, 1], -axes[rows, 2, 0])
            assert abs(np.exp(1j * turn).mean()) < 0.5


def test_joint_limits_branch_and_travel_of_the_true_bar_are_kept(plan):
    margin = np.deg2rad(5.0)
    for i, joint in enumerate(ROBOT.chain.joints):
        assert plan.q[:, i].min() >= joint.lower + margin
        assert plan.q[:, i].max() <= joint.upper - margin
    assert np.all(plan.q > ROBOT.branch.lower)
    assert np.all(plan.q < ROBOT.branch.upper)
    scaled = joint_jacobian(ROBOT.chain, DESIGN, plan.q) / np.array([0.45] * 3 + [1.0] * 3)[:, None]
    assert np.linalg.svd(scaled, compute_uv=False)[:, -1].min() > 0.05
    # A calibration that starts from the design model must get every reading: 10 mm of 37.5 mm are left.
    zero = np.where(plan.bar == "bar46", 0.46, 0.61)
    vectors, _ = bar_vectors(plan, OPTIMISED)
    extension = np.linalg.norm(vectors, axis=1) - zero
    assert np.abs(extension).max() < 0.0375 - 0.010
    assert np.abs(extension).max() > 0.010  # the design model is visibly wrong


def test_the_true_bar_stays_within_its_travel_on_every_way_that_it_is_on(plan):
    world = World(3, plan)
    t = np.arange(0.0, world.duration, 0.02)
    zero = np.where(plan.bar == "bar46", 0.46, 0.61)[world.controller.pose[world.controller.stop_index(t)]]
    extension = world.length(t) - zero
    # The way is checked at 33 points: between two, a path whose bulge is 37.5 mm hides less than 37.5 mm · 4 / 64² / 2;
    # servo errors, ringing and repeatability add less than 0.5 mm.
    assert np.nanmax(np.abs(extension)) < 0.0375 + 0.0005 + 0.00005
    # Few ways need the bar off beside the 18 new pairings, or the plan's order is poor.
    assert 18 <= world.controller.mounting.sum() <= 18 + 0.01 * len(plan)


def test_what_cannot_be_planned_is_said():
    with pytest.raises(PlanError, match="too few for 9 pairings"):
        shells.plan_shells(KNOWN, "bar46", 8)
    far = Rig(chucks={"far": Point("far", (3.0, 0.0, 0.0))}, spheres=RIG.spheres, bars=RIG.bars)
    with pytest.raises(PlanError, match=r"between chuck far and sphere s\d"):
        shells.plan_shells(replace(KNOWN, rig=far), "bar46", 9)


def test_a_tour_is_short_and_may_leave_out_the_dearest_visit():
    x = np.array([0.0, 1.0, -1.2, 3.0, 7.0])  # the nearest first: 0, 1, 3, 7 and then all the way back to -1.2
    cost = np.abs(x[:, None] - x) ** 2
    order = tour.short_tour(np.abs(x), cost)
    assert np.sum(np.diff(x[order]) ** 2) < np.sum(np.diff([0.0, 1.0, 3.0, 7.0, -1.2]) ** 2) / 2
    x = np.array([0.0, 1.0, 50.0, 2.0, 3.0])
    order = shells.without_dearest(np.arange(5), np.abs(x[:, None] - x) ** 2, 4)
    assert x[order].tolist() == [0.0, 1.0, 2.0, 3.0]
