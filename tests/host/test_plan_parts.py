"""Parts of planning: distances, paths, branches."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.host import plan_bench as bench

from truearm.errors import PlanError
from truearm.model.builtin import names_with_branch
from truearm.model.robot import builtin_robot
from truearm.model.workspace import Branch
from truearm.plan.ball_bar_plan import all_pairings
from truearm.plan.bar_paths import onto_shell, samples, way_without_bar, ways_with_bar
from truearm.plan.branches import branch_of
from truearm.plan.collision_shapes import make_shapes, segment_distance
from truearm.plan.measurement_limits import Pairing, allowed, bar_vectors
from truearm.plan.shells import candidates

coordinate = st.floats(-1.0, 1.0).map(lambda v: round(v, 3))
ends = st.tuples(*(st.tuples(coordinate, coordinate, coordinate) for _ in range(4)))


@settings(max_examples=150, deadline=None)
@given(ends)
def test_segment_distance_is_that_of_the_nearest_points(points):
    a0, a1, b0, b1 = map(np.array, points)
    share = np.linspace(0.0, 1.0, 101)[:, None]
    a, b = a0 + share * (a1 - a0), b0 + share * (b1 - b0)
    apart = np.linalg.norm(a[:, None] - b[None], axis=2).min()
    exact = segment_distance(a0, a1, b0, b1)
    # points a hundredth of a segment apart miss the nearest by at most half of that on either
    half_step = 0.005 * (np.linalg.norm(a1 - a0) + np.linalg.norm(b1 - b0))
    assert exact <= apart + 1e-9
    assert exact >= apart - half_step - 1e-9


def test_ways_are_found_or_none_is():
    site, pairing = bench.site("puma560"), Pairing("bar46", "c1", "s1")
    q = candidates(site, [pairing], 12).q
    middle = onto_shell(site, 0.5 * (q[:1] + q[-1:]), pairing)
    bar, mounted = pairing.of(site.rig)
    assert abs(np.linalg.norm(bar_vectors(site, middle, mounted)[0]) - bar.zero) < 1e-9
    assert ways_with_bar(site, q[:1], q[:1], pairing)[0].shape == (0, 6)
    # A pose on the other side of the wrist's singularity cannot be gone to with the bar on.
    site, pairing = bench.site("puma560"), Pairing("bar46", "c1", "s1")
    q = candidates(site, [pairing], 12).q[0]
    flipped = q + np.array([0, 0, 0, -np.pi, -2.0 * q[4], np.pi])
    assert ways_with_bar(site, q[None], flipped[None], pairing) == [None]
    site = bench.site("irb120")
    q = candidates(site, all_pairings(site.rig, ["bar25"]), 27).q
    low = [q[i] for i in np.argsort(q[:, 0])[[0, -1]]]
    stops = [low[0], *way_without_bar(site, *low, "it"), low[1]]
    assert allowed(site, samples(np.array(stops[:-1]), np.array(stops[1:]))[0], None).all()


@pytest.mark.parametrize("name", names_with_branch())
def test_branches_lie_inside_the_joints_limits(name):
    robot = builtin_robot(name)
    chain, branch = robot.chain, branch_of(robot)
    assert (branch.lower >= [j.lower for j in chain.joints]).all()
    assert (branch.upper <= [j.upper for j in chain.joints]).all()


def test_a_branch_that_does_not_fit_the_robot_is_refused():
    robot = builtin_robot("puma560")
    for size, bound in ((5, 0.1), (7, 0.1), (6, 99.0)):
        with pytest.raises(PlanError, match=r"^branch: "):
            branch_of(robot, Branch(np.full(size, -bound), np.full(size, bound)))
    bare = replace(robot, branch=None)
    with pytest.raises(PlanError, match=r"robot puma560 has no \[branch\] in its file"):
        branch_of(bare)
    given = Branch(np.full(6, -0.1), np.full(6, 0.1))
    assert branch_of(bare, given) is given


def test_every_limit_is_looked_at():
    """A good pose is refused as soon as any one limit is drawn past it."""
    site, pairing = bench.site("puma560"), Pairing("bar46", "c1", "s1")
    q = candidates(site, [pairing], 12).q[:1]
    assert allowed(site, q, pairing).all()
    for change in (
        {"joint_margin": 1.5},
        {"singular_value": 0.9},
        {"reserve": 0.0376},
        {"chuck_angle": 0.01},
        {"sphere_angle": 0.01},
    ):
        assert not allowed(site, q, pairing, replace(site.limits, **change)).any()
    for change in ({"table": 2.0}, {"link": 0.5}, {"post": 0.6}):
        sizes = replace(site.shapes.sizes, **change)
        shapes = make_shapes(site.arm.chain, site.arm.params, site.rig, sizes)
        assert not allowed(replace(site, shapes=shapes), q, pairing).any()
