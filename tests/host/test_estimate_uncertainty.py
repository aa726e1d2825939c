"""Covariances turned into errors of the end, and two results in one gauge."""

import numpy as np
import pytest
from puma_bench import CHAIN, DESIGN, FREE, RIG, SIGMA, SPHERES, TRUTH, random_poses, random_table

from truearm.errors import ProblemError
from truearm.estimate.compare import compare
from truearm.estimate.identify import identify
from truearm.estimate.uncertainty import predicted_error, tolerance_error
from truearm.model.chain import Chain, Element, Joint, Parameter, forward, point_forward

AT = {name: i for i, name in enumerate(CHAIN.parameter_names)}


def two_links():
    """A planar arm, 0.4 and 0.3 m, whose errors are known by hand."""
    parameters = (Parameter("o1", "rad", 0.0, "offset", 0), Parameter("a1", "m", 0.4), Parameter("a2", "m", 0.3))
    elements = (
        Element("rz", joint=0),
        Element("tx", parameter=1),
        Element("rz", joint=1),
        Element("tx", parameter=2),
    )
    joints = tuple(Joint(f"j{i}", "revolute", -3.0, 3.0) for i in (1, 2))
    return Chain("planar", elements, parameters, joints)


def test_tolerances_of_a_planar_arm_by_hand():
    """Stretched along x: an angle error moves the end sideways by 0.7 m, lengths along x, nothing along z."""
    e = tolerance_error(
        two_links(), np.array([1e-3, 2e-4, 1e-4]), np.array([[0.0, 0.0], [0.0, np.pi / 2]]), np.zeros(3)
    )
    np.testing.assert_allclose(e.covariance[0], np.diag([5e-8, 0.49e-6, 0.0]), atol=1e-20)
    assert e.rms[0] == pytest.approx(np.sqrt(5e-8 + 0.49e-6))
    np.testing.assert_allclose(np.abs(e.direction_smallest[0]), [0, 0, 1], atol=1e-9)
    np.testing.assert_allclose(np.abs(e.direction_largest[0]), [0, 1, 0], atol=1e-9)
    assert e.sigma_largest[0] == pytest.approx(0.7e-3)
    assert e.worst == 0  # stretched out, the arm has its longest lever


def test_prediction_is_the_spread_of_sampled_robots():
    rng = np.random.default_rng(0)
    sigma = np.where([p.unit == "m" for p in CHAIN.parameters], 1e-5, 2e-5)
    q, tool = random_poses(40, rng), np.array([0.01, 0.02, 0.1])
    e = tolerance_error(CHAIN, sigma, q, tool)
    runs = 1000
    ends = np.array([point_forward(CHAIN, DESIGN + sigma * rng.normal(size=54), q, tool) for _ in range(runs)])
    moved = ends - point_forward(CHAIN, DESIGN, q, tool)
    # The mean square of a norm with up to three unequal components has a relative standard error ≤ sqrt(2/runs).
    ratio = (moved**2).sum(axis=2).mean(axis=0) / e.rms**2
    np.testing.assert_allclose(ratio, 1.0, atol=4.5 * np.sqrt(2 / runs))
    along = (moved * e.direction_smallest).sum(axis=2).std(axis=0)
    np.testing.assert_allclose(along, e.sigma_smallest, rtol=4.5 / np.sqrt(2 * runs))


def test_the_posterior_predicts_where_single_parameters_are_unseen():
    """54 free: 18 of them are uncertain without bound, the end is not."""
    t = random_table(300, np.random.default_rng(1), SIGMA)
    all_free = identify(CHAIN, RIG, t)
    few_free = identify(CHAIN, RIG, t, free=FREE)
    q = random_poses(30, np.random.default_rng(2))
    tool = np.array(SPHERES["s1"].xyz)
    many, few = (predicted_error(CHAIN, e.value, e.covariance[:54, :54], q, tool) for e in (all_free, few_free))
    np.testing.assert_allclose(many.rms, few.rms, rtol=1e-3)  # the two ends differ by 1e-6 σ and in the gauge
    assert (few.rms < 10 * SIGMA).all()


def test_bad_input_is_refused():
    with pytest.raises(ProblemError, match="54 × 54"):
        predicted_error(CHAIN, DESIGN, np.eye(3), np.zeros((1, 6)), np.zeros(3))
    with pytest.raises(ProblemError, match="no poses"):
        predicted_error(CHAIN, DESIGN, np.eye(54), np.zeros((0, 6)), np.zeros(3))
    with pytest.raises(ProblemError, match="tolerances"):
        tolerance_error(CHAIN, np.full(54, -1.0), np.zeros((1, 6)), np.zeros(3))
    with pytest.raises(ProblemError, match="one robot"):
        compare(CHAIN, DESIGN, np.zeros(3), np.zeros((1, 6)))
    with pytest.raises(ProblemError, match="poses to compare"):
        compare(CHAIN, DESIGN, DESIGN, np.zeros((0, 6)))


# --- two results in one gauge ---------------------------------------------------------------------------------------


def test_results_that_differ_by_the_gauge_alone_are_the_same():
    t = random_table(500, np.random.default_rng(3))
    few, many = identify(CHAIN, RIG, t, free=FREE), identify(CHAIN, RIG, t)
    assert np.abs(few.value - many.value).max() > 1e-3
    found = compare(CHAIN, few.value, many.value, random_poses(60, np.random.default_rng(4)))
    assert found.aligned
    assert found.position.max() < 1e-9
    assert found.orientation.max() < 1e-9
    assert np.abs(found.delta_params).max() < 1e-8


def test_a_true_difference_is_found_in_the_gauge_of_a():
    """b is a with a longer forearm, then walked along directions that move no pose: offset 1 against link 1."""
    q = random_poses(60, np.random.default_rng(5))
    b = DESIGN.copy()  # link 1 stands upright there, so its alpha turns about joint 1
    b[AT["link4.x"]] += 1e-3
    plain = compare(CHAIN, DESIGN, b, q)
    b[AT["joint1.offset"]] += 0.02
    b[AT["link1.alpha"]] -= 0.02
    walked = compare(CHAIN, DESIGN, b, q)
    assert plain.aligned
    assert walked.aligned
    np.testing.assert_allclose(walked.delta_params, plain.delta_params, atol=1e-9)
    assert walked.delta_params[AT["link4.x"]] == pytest.approx(1e-3, rel=0.6)  # shared with its equals in the gauge
    assert np.linalg.norm(plain.delta_params) <= 1e-3 * (1 + 1e-3)  # no longer than the way b itself took
    np.testing.assert_allclose(forward(CHAIN, DESIGN + walked.delta_params, q), forward(CHAIN, b, q), atol=1e-10)
    assert walked.position.max() == pytest.approx(1e-3, rel=1e-6)  # the forearm carries all beyond it


def test_fixtures_mounted_anew_are_no_difference_of_the_robot():
    q = random_poses(60, np.random.default_rng(6))
    b = TRUTH.copy()
    b[[AT["link1.x"], AT["link1.z"], AT["link1.beta"]]] += [0.02, -0.01, 0.05]
    b[[AT["link7.y"], AT["link7.gamma"]]] += [0.003, 0.03]
    plain, moved = (compare(CHAIN, TRUTH, b, q, fixtures_moved=flag) for flag in (False, True))
    assert plain.position.min() > 1e-3
    assert moved.aligned
    assert moved.position.max() < 1e-9
    assert moved.orientation.max() < 1e-9
    assert np.abs(moved.delta_params).max() < 1e-9
    b[AT["link3.x"]] += 5e-4
    longer = compare(CHAIN, TRUTH, b, q, fixtures_moved=True)
    assert longer.delta_params[AT["link3.x"]] == pytest.approx(5e-4, rel=0.5)
    assert longer.aligned
