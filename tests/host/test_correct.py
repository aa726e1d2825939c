"""Corrections of a known robot: order of convergence, exactness, refusals."""

from dataclasses import replace

import numpy as np
import pytest
from correct_bench import good_poses, nominal_poses
from puma_bench import CHAIN, DESIGN, TRUTH
from term_bench import register

from truearm.correct.configurations import search, turned, within
from truearm.correct.correction import Configuration, ModelPair, correct
from truearm.correct.methods import Method
from truearm.model.chain import forward
from truearm.model.chain_structure import Parameter
from truearm.model.inverse import inverse, jacobian, singular_value
from truearm.model.robot_file import builtin_names, builtin_robot
from truearm.model.robot_mounting import mountings


@pytest.fixture(scope="module")
def q():
    return good_poses(60)


def pair(share=1.0, names=""):
    """Return the nominal robot and one with a share of the true errors, in parameters whose names end like this."""
    mine = np.array([name.endswith(names) for name in CHAIN.parameter_names])
    return ModelPair(CHAIN, DESIGN, DESIGN + share * mine * (TRUTH - DESIGN))


def rms(values):
    return float(np.sqrt(np.mean(values**2)))


@pytest.mark.parametrize("method", ["false-target", "joints"])
@pytest.mark.parametrize("share", [0.5, 0.25])
def test_halving_the_errors_quarters_what_one_step_leaves(q, method, share):
    """(32) and (34) are right to first order: the residual is of second order, but for terms of the third (ratio 3.3–5)."""
    whole, half = (
        correct(pair(s), nominal_poses(q), method, configuration=Configuration(q)) for s in (share, 0.5 * share)
    )
    assert not any(whole.problem + half.problem)
    for column in (0, 1):
        assert 3.3 <= rms(whole.after[:, column]) / rms(half.after[:, column]) <= 5.0
    assert rms(whole.after[:, 0]) < 0.1 * rms(whole.before[:, 0])


def test_newton_reaches_the_target_to_a_nanometre(q):
    done = correct(pair(), nominal_poses(q), "newton", configuration=Configuration(q))
    assert not any(done.problem)
    assert rms(done.before[:, 0]) > 10e-3
    assert done.after[:, 0].max() <= 1e-9
    there = forward(CHAIN, TRUTH, done.q)
    np.testing.assert_allclose(there[:, :3, 3], nominal_poses(q)[:, :3, 3], atol=1e-9)
    # what is told is what the controller, with its nominal model, turns into those joints
    np.testing.assert_allclose(forward(CHAIN, DESIGN, done.q), done.commanded, atol=1e-15)


@pytest.mark.parametrize("method", Method)
def test_every_method_corrects_the_whole_joint_law_and_links_if_it_says_so(q, method, monkeypatch):
    register(monkeypatch)
    waves = tuple(Parameter(f"joint{i}.sway", "rad", 0.0, "sway", i - 1) for i in (1, 2, 4))
    chain = replace(CHAIN, name="wavy", parameters=(*CHAIN.parameters, *waves))
    is_law = np.array([p.term != "geometry" for p in chain.parameters])
    error = 2e-3 * np.random.default_rng(8).normal(size=is_law.size)
    nominal, targets = chain.params_nominal, nominal_poses(q)
    law, links = (
        correct(ModelPair(chain, nominal, nominal + mine * error), targets, method, 20, configuration=Configuration(q))
        for mine in (is_law, ~is_law)
    )
    assert not any(law.problem + links.problem)
    assert law.before[:, 0].max() > 1e-3
    assert law.after[:, 0].max() < 2e-9
    if method.links:
        assert links.after[:, 0].max() < 2e-9
    else:
        np.testing.assert_allclose(links.after, links.before, atol=1e-12)


def test_in_the_robots_own_frames_offsets_leaves_the_mountings_alone(q):
    """The first and the last offset are then part of the mountings, as ``mountings`` takes them: the robot itself is corrected exactly."""
    offset = np.array([0.02 * name.endswith("offset") for name in CHAIN.parameter_names])
    identified = DESIGN + offset
    own = ModelPair(CHAIN, DESIGN, identified, mountings(CHAIN, DESIGN, identified))
    done = correct(own, nominal_poses(q), "offsets", configuration=Configuration(q))
    assert done.before[:, 0].min() > 1e-3
    assert done.after[:, 0].max() <= 1e-12


def test_orientations_compose_as_rotation_vectors(q):
    """Of a robot that is only turned about its base by 0.2 rad, the mirror image of that turn about the same axis is exact;
    angles about fixed axes, subtracted, would be off by 0.2²/2."""
    base_turned = DESIGN + 0.2 * np.array([name == "link1.alpha" for name in CHAIN.parameter_names])
    done = correct(
        ModelPair(CHAIN, DESIGN, base_turned), nominal_poses(q), "false-target", 1, configuration=Configuration(q)
    )
    fine = np.array([not problem for problem in done.problem])
    assert fine.sum() > 5
    np.testing.assert_allclose(done.after[fine, 1], 0.0, atol=1e-9)


def test_positions_alone_move_the_joints_least(q):
    targets = nominal_poses(q)
    full = correct(pair(), targets, configuration=Configuration(q))
    position = correct(pair(), targets, oriented=False, configuration=Configuration(q))
    assert not any(position.problem)
    assert position.after[:, 0].max() <= 1e-9
    assert np.isnan(position.after[:, 1]).all()
    moved_by = [np.linalg.norm(d.q - d.q_nominal, axis=1) for d in (position, full)]
    assert (moved_by[0] < moved_by[1]).all()


@pytest.mark.parametrize("method", Method)
def test_a_singular_target_is_refused_and_never_a_wild_number(method):
    q = good_poses(5)
    q[:, 4] = np.radians([0.0, 0.01, 0.5, -1.0, 2.0])  # the wrist's axes nearly aligned
    done = correct(pair(), nominal_poses(q), method, 20, configuration=Configuration(q))
    assert all("singular" in p or "converge" in p or "configuration" in p for p in done.problem)
    assert (np.isnan(done.q) | (np.abs(done.q) < 2.0 * np.pi)).all()


@pytest.mark.parametrize("name", ["ur5e", "irb120"])
def test_a_target_at_an_exact_singularity_is_refused(name):
    """Two axes of the wrist on one line: no step towards it may divide by what is zero."""
    chain = builtin_robot(name).chain
    lower, upper = (np.array([getattr(joint, end) for joint in chain.joints]) for end in ("lower", "upper"))
    rng = np.random.default_rng(4)
    q = rng.uniform(np.maximum(lower, -1.5), np.minimum(upper, 1.5), (12, len(lower)))
    q[:, 4] = 0.0
    targets, pair_ = forward(chain, chain.params_nominal, q), ModelPair(chain, *2 * (chain.params_nominal,))
    for starts in (None, q + rng.normal(0.0, 0.05, q.shape)):  # a search may find another configuration
        done = correct(pair_, targets, configuration=Configuration(starts))
        assert np.isfinite(done.q).all()
        assert all(
            p if starts is not None else p or e < 1e-9 for p, e in zip(done.problem, done.after[:, 0], strict=True)
        )


def test_unreachable_targets_are_refused():
    q = good_poses(3)
    targets = nominal_poses(q)
    targets[0, :3, 3] *= 3.0
    done = correct(pair(), targets)
    assert done.problem[0]
    assert np.isnan(done.q_nominal[0]).all()
    assert done.problem[1:] == ("", "")
    lower = np.array([joint.lower for joint in CHAIN.joints])
    at_limit = q[:1].copy()
    at_limit[0, 0] = lower[0] + 1e-6
    done = correct(pair(), nominal_poses(at_limit), configuration=Configuration(at_limit))
    assert within(CHAIN, done.q).all() or "limits" in done.problem[0]


@pytest.mark.parametrize("name", builtin_names())
def test_any_robot_finds_its_own_poses(name):
    """Poses made from joints are found again, within the limits, by search as by inverse."""
    chain = builtin_robot(name).chain
    rng = np.random.default_rng(3)
    lower = [max(joint.lower, -np.pi) for joint in chain.joints]
    upper = [min(joint.upper, np.pi) for joint in chain.joints]
    q = rng.uniform(lower, upper, (40, len(lower)))
    q = q[singular_value(chain, chain.params_nominal, q) > 0.08]
    targets = forward(chain, chain.params_nominal, q)
    found = inverse(chain, chain.params_nominal, targets, q + 0.02 * rng.normal(size=q.shape))
    np.testing.assert_allclose(forward(chain, chain.params_nominal, found), targets, atol=1e-9)
    searched = search(chain, chain.params_nominal, targets)
    is_reached = np.isfinite(searched).all(axis=1)
    assert is_reached.mean() > 0.9
    assert within(chain, searched[is_reached]).all()
    np.testing.assert_allclose(
        forward(chain, chain.params_nominal, searched[is_reached]), targets[is_reached], atol=1e-9
    )


@pytest.mark.parametrize("name", ["panda", "iiwa14", "irb120"])
def test_poses_of_joints_at_their_limits_are_found(name):
    """An arm with seven joints reaches them with many others, of which only some are within; six end there but for rounding."""
    chain = builtin_robot(name).chain
    rng = np.random.default_rng(4)
    q = rng.uniform(*chain.limits, (300, len(chain.joints)))
    for row in q:
        at = rng.choice(q.shape[1], 2, replace=False)
        row[at] = chain.limits[rng.integers(2, size=2), at]
    q = q[singular_value(chain, chain.params_nominal, q) > 0.05]
    found = search(chain, chain.params_nominal, forward(chain, chain.params_nominal, q))
    assert within(chain, found).all()
    np.testing.assert_allclose(
        forward(chain, chain.params_nominal, found), forward(chain, chain.params_nominal, q), atol=1e-9
    )


def test_an_arm_with_seven_joints_is_corrected_within_its_limits():
    """Where the shortest correction ends beyond a limit, the joint stays there and the others make up for it."""
    robot = builtin_robot("iiwa14")
    rng = np.random.default_rng(6)
    nominal = robot.chain.params_nominal
    arm = ModelPair(robot.chain, nominal, nominal + np.where(robot.free, rng.normal(0.0, 1e-3, nominal.size), 0.0))
    q = 0.9 * rng.uniform(*robot.chain.limits, (300, 7))
    at = rng.choice([0, 2, 4, 6], 300)  # the shoulder and the wrist; the elbow alone sets the reach
    q[np.arange(300), at] = robot.chain.limits[rng.integers(2, size=300), at]
    jac = jacobian(robot.chain, nominal, q)
    jac[np.arange(300), :, at] = 0.0
    q = q[np.linalg.svd(jac, compute_uv=False)[:, -1] > 0.1]  # the six others can make up for it
    targets = forward(robot.chain, nominal, q)
    freely = inverse(robot.chain, arm.identified, targets, q)
    done = correct(arm, targets, configuration=Configuration(q))
    assert not within(robot.chain, freely).all()
    assert within(robot.chain, done.q).all()
    assert set(done.problem) == {""}
    assert done.after.max() < 1e-9
    np.testing.assert_array_equal(done.q[within(robot.chain, freely)], freely[within(robot.chain, freely)])


def test_quadrants_choose_the_configuration(q):
    quadrants = np.full(q.shape, np.nan)
    quadrants[:, [0, 3, 5]] = np.floor(q[:, [0, 3, 5]] / (0.5 * np.pi))
    found = search(CHAIN, DESIGN, nominal_poses(q), quadrants=quadrants)
    same = np.floor(found[:, [0, 3, 5]] / (0.5 * np.pi)) == quadrants[:, [0, 3, 5]]
    # the starts of a target may miss its configuration; most have it
    assert same.all(axis=1).mean() > 0.9
    flipped = quadrants.copy()
    flipped[:, 3] += np.where(quadrants[:, 3] < 0, 2, -2)  # the other way to turn the wrist
    flipped[:, 5] = np.nan
    other = search(CHAIN, DESIGN, nominal_poses(q), quadrants=flipped)
    assert (np.abs(other[:, 4] - q[:, 4]) > 0.3).mean() > 0.2


def test_turns_leave_the_arm_where_it_is_and_go_on():
    chain = builtin_robot("ur5e").chain
    gains = chain.params_nominal + 2e-3 * np.array([name.endswith("gain") for name in chain.parameter_names])
    q = np.array([[0.4, -1.2, -1.5, -5.0, -1.0, 5.5]])
    other = turned(chain, gains, q, np.zeros(6))
    assert (np.abs(other - q)[0, [3, 5]] > 6.0).all()
    np.testing.assert_allclose(forward(chain, gains, other), forward(chain, gains, q), atol=1e-14)
    # A UR5e's joints turn by 360° either way: what comes after -179° is -181°, not another configuration or a turn back.
    chain = builtin_robot("ur5e").chain
    q = np.linspace([0.2, -1.2, -1.5, -2.9, -1.2, 2.9], [0.3, -1.3, -1.6, -3.6, -1.3, 3.7], 30)
    targets = forward(chain, chain.params_nominal, q)
    found = search(chain, chain.params_nominal, targets, home=q[0])
    np.testing.assert_allclose(found, q, atol=1e-8)
    # An IRB 120's sixth axis turns by 400° either way, and its configuration data say which turn.
    chain = builtin_robot("irb120").chain
    q = np.radians([[10.0, 20.0, 30.0, 40.0, 50.0, turns] for turns in (100.0, 200.0, 300.0, -300.0, 390.0)])
    quadrants = np.full(q.shape, np.nan)
    quadrants[:, [0, 3, 5]] = np.floor(q[:, [0, 3, 5]] / (0.5 * np.pi))
    found = search(chain, chain.params_nominal, forward(chain, chain.params_nominal, q), quadrants=quadrants)
    np.testing.assert_allclose(found, q, atol=1e-8)


def test_positions_are_reached_in_the_robots_own_frames_too(q):
    """The tool's mounting turns with the end, whose orientation the targets leave free."""
    mounted = TRUTH + 2e-3 * np.array([name.startswith("link7.") for name in CHAIN.parameter_names])
    own = ModelPair(CHAIN, DESIGN, mounted, mountings(CHAIN, DESIGN, mounted))
    assert np.linalg.norm(own.mountings.tool[:3, 3]) > 1e-3
    targets = nominal_poses(q)
    targets[:, :3, :3] = np.eye(3)
    done = correct(own, targets, oriented=False, configuration=Configuration(q), margin=0.0)
    good = np.array([not problem for problem in done.problem])
    assert good.mean() > 0.9
    assert done.before[good, 0].max() > 1e-4
    assert done.after[good, 0].max() < 1e-7


def test_mountings_are_exactly_what_first_and_last_link_hold(q):
    found = mountings(CHAIN, DESIGN, TRUTH)
    target = ModelPair(CHAIN, DESIGN, TRUTH, found)
    # R(q) between nominal base and flange: B⁻¹·T_i·E⁻¹ does not depend on what the fixtures do
    moved_fixtures = TRUTH.copy()
    mine = np.array([name.startswith(("link1.", "link7.")) for name in CHAIN.parameter_names])
    moved_fixtures[mine] += np.random.default_rng(0).normal(0.0, 0.01, mine.sum())
    other = ModelPair(CHAIN, DESIGN, moved_fixtures, mountings(CHAIN, DESIGN, moved_fixtures))
    done = [correct(p, nominal_poses(q), configuration=Configuration(q)) for p in (target, other)]
    np.testing.assert_allclose(done[0].q, done[1].q, atol=1e-9)
    np.testing.assert_allclose(done[0].before, done[1].before, atol=1e-12)
    assert rms(done[0].before[:, 0]) < rms(
        correct(pair(), nominal_poses(q), configuration=Configuration(q)).before[:, 0]
    )


@pytest.mark.parametrize("name", ["puma560", "ur5e"])
def test_rounding_does_not_decide_between_configurations(name):
    """Solutions tie in the largest motion where they differ in other joints alone."""
    chain, rng = builtin_robot(name).chain, np.random.default_rng(3)
    nominal = chain.params_nominal
    q = rng.uniform(*np.clip(chain.limits, -np.pi, np.pi), (300, 6))
    targets = forward(chain, nominal, q[singular_value(chain, nominal, q) > 0.05][:100])
    noisy = targets.copy()
    noisy[:, :3, 3] += rng.normal(0.0, 1e-13, (len(targets), 3))
    near, also = (search(chain, nominal, poses, home=q[0]) for poses in (targets, noisy))
    assert np.isfinite(near).all()
    np.testing.assert_allclose(also, near, atol=1e-6)


@pytest.mark.parametrize("n", [43, pytest.param(429, marks=pytest.mark.soak)])
@pytest.mark.parametrize("name", builtin_names())
def test_no_random_target_is_corrected_in_another_configuration(name, n):
    """The arm stays in its configuration, and the identified robot reaches the target to rounding."""
    chain, rng = builtin_robot(name).chain, np.random.default_rng(7)
    nominal = chain.params_nominal
    truth = nominal + rng.uniform(-1e-3, 1e-3, nominal.size)
    lower, upper = np.clip(chain.limits, -np.pi, np.pi)
    q = rng.uniform(lower + 0.2, upper - 0.2, (6 * n, len(lower)))
    arms = ModelPair(chain, nominal, truth)
    q = q[np.minimum(*(singular_value(chain, params, q) for params in (nominal, truth))) > 0.1][:n]
    assert len(q) == n
    near = q + rng.uniform(-0.05, 0.05, q.shape)
    done = correct(arms, forward(chain, nominal, q), configuration=Configuration(q_start=near))
    assert not any(done.problem)
    assert np.abs(done.q - done.q_nominal).max() < 0.2
    assert np.abs(done.q_nominal - q).max() < (1e-9 if len(lower) <= 6 else 0.2)
    assert done.after[:, 0].max() < 1e-12
