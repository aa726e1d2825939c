"""The run that characterizes a robot: approach directions, travel, order."""

import numpy as np
import pytest
from approaches_bench import PAIRING, WANTED, planned
from plan_bench import Course

from truearm.errors import PlanError
from truearm.model.chain import distance_jacobian
from truearm.plan.approaches import FARTHEST, LEAST, approach_directions, most_informative, plan_approaches
from truearm.plan.bar_paths import Pace
from truearm.plan.measurement_limits import Limits, allowed, free_travel
from truearm.plan.options import ApproachOptions


@pytest.mark.parametrize("joints", [1, 4, 6, 7, 8])
def test_each_joint_comes_from_both_sides_independently_of_all_others(joints):
    signs = approach_directions(joints)
    assert signs.shape == (8 if 4 <= joints <= 7 else {1: 2, 8: 16}[joints], joints)
    assert np.array_equal(signs.T @ signs, len(signs) * np.eye(joints))
    assert np.array_equal(signs.sum(axis=0), np.zeros(joints))


def test_the_poses_are_those_that_tell_most_of_every_joint():
    tells = np.array([[1.0, 0.1], [0.9, 0.1], [0.1, 0.5], [0.0, 0.0]])
    step = np.array([0.01, 0.01])
    assert list(most_informative(tells, 2, lambda pose: step)) == [0, 2]
    assert list(most_informative(tells, 2, lambda pose: None if pose == 0 else step)) == [1, 2]


@pytest.fixture(scope="module")
def route():
    return planned()


def test_every_pose_is_reached_alike_often_on_ways_that_keep_the_bar_on(route):
    # Recomputed from the route alone, 12 places on every way: joints, travel with its reserve, cups, collisions.
    site, planned_route = route
    way = Course.of(planned_route)
    share = np.linspace(0.0, 1.0, 12)[:, None]
    for i in range(1, len(way.q)):
        if not way.mount[i] and not (i + 1 < len(way.q) and way.mount[i + 1]):
            assert allowed(site, way.q[i - 1] + share * (way.q[i] - way.q[i - 1]), PAIRING, Limits()).all()
    poses = np.unique(planned_route.plan.q, axis=0)
    assert len(poses) == WANTED.poses
    for q in poses:
        at = np.flatnonzero((way.pose >= 0) & np.all(way.q == q, axis=1))
        away = np.array([way.q[i - 1] - q for i in at if i and way.pose[i - 1] < 0])
        near = away[np.abs(away).max(axis=1) <= FARTHEST + 1e-12]
        _, counts = np.unique(np.sign(near[-8 * WANTED.rounds :]), axis=0, return_counts=True)
        assert counts.tolist() == [WANTED.rounds] * 8
        assert np.abs(near).min() >= LEAST
        assert (np.diff(at) == 1).sum() + 1 == WANTED.long_dwell / 2.0  # rows of the long rest
    bar, mounted = PAIRING.of(site.rig)
    ends = mounted.p_sphere, mounted.p_chuck
    jac = np.abs(distance_jacobian(site.arm.chain, site.arm.params, planned_route.plan.q[:1], *ends))[0]
    step = np.abs(way.q[np.flatnonzero(way.pose < 0)[0]] - planned_route.plan.q[0])
    assert jac @ step <= free_travel(bar, site.limits)


def test_plan_and_programs_say_the_same_and_too_many_poses_are_refused(route):
    _, way = route
    visits = way.visits
    assert np.array_equal(visits.q, Course.of(way).q)
    assert [stop.move for stop in way.stops] == visits.move.tolist()
    assert set(visits.bar[visits.move == "via"]) <= {"bar46", ""}
    site, _ = route
    with pytest.raises(PlanError, match="bar room"):
        plan_approaches(site, PAIRING, ApproachOptions(poses=50, candidates=20), Pace())
