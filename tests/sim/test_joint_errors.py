"""What a true arm's joints do beyond geometry, checked against physics."""

import numpy as np
import pytest

from truearm.model.chain import forward, joint_frames
from truearm.model.robot_file import builtin_robot
from truearm.plan.first_rig import reach
from truearm_sim.arm import Arm
from truearm_sim.joint_errors import GRAVITY, GearError, Sag
from truearm_sim.true_robot import Tolerance, moving, true_params
from truearm_sim.world import World, standard_plan, standard_rig


def test_a_gear_errs_by_sines_of_its_own_angle():
    """Two teeth a turn and nine a turn: their amplitudes come back from readings all over the turn, nothing else does."""
    periods = np.deg2rad([180.0, 40.0])
    error = GearError.drawn(2e-4, tuple(periods), 3, seed=5)
    q = np.linspace(0.0, 2.0 * np.pi, 720, endpoint=False)
    found = error.at(np.stack([q, q + 0.3, q], axis=1))
    for joint in found.T:
        spectrum = 2.0 * np.abs(np.fft.rfft(joint)) / len(q)
        assert spectrum[[2, 9]] == pytest.approx(2e-4, rel=1e-9)
        assert np.delete(spectrum, [2, 9]).max() < 1e-15
    assert np.abs(found[:, 0] - found[:, 2]).max() > 1e-5  # each joint has phases of its own


@pytest.mark.parametrize("name", ["puma560", "ur5e", "panda"])
def test_joints_give_by_what_lowers_the_potential_energy(name):
    """Δθ = −(∂V/∂θ)/k, with ∂V/∂θ by central differences of the links' heights."""
    robot = builtin_robot(name)
    chain, params = robot.chain, robot.chain.params_nominal
    j, k = len(chain.joints), 2e4
    masses = np.linspace(8.0, 1.0, j)
    q = np.random.default_rng(3).uniform(robot.branch.lower, robot.branch.upper, (5, j))

    def energy(at):
        origins = joint_frames(chain, params, at)[:, :, :3, 3]
        ends = np.concatenate([origins[:, 1:], forward(chain, params, at)[:, None, :3, 3]], axis=1)
        return GRAVITY * (0.5 * (origins + ends))[..., 2] @ masses

    step = 1e-5
    gradient = np.stack([(energy(q + step * e) - energy(q - step * e)) / (2.0 * step) for e in np.eye(j)], axis=1)
    by_angle = gradient / chain.law.gain.of(params)  # θ = offset + gain·q
    sag = Sag(chain, params, masses, k).at(q)
    assert sag == pytest.approx(-by_angle / k / chain.law.gain.of(params), abs=1e-9)
    assert 1e-4 < np.abs(sag).max() < 2e-2


def test_the_truth_is_drawn_to_its_tolerances():
    """Lengths and angles as declared, over many arms; encoders count whole turns, and what a robot file holds is as designed."""
    robot = builtin_robot("ur5e")
    chain, tolerance = robot.chain, Tolerance(3e-4, 1e-3)
    drawn = np.array([true_params(robot, seed, tolerance) for seed in range(400)]) - chain.params_nominal
    for unit, sigma in (("m", 3e-4), ("rad", 1e-3)):
        mine = np.array([p.unit == unit for p in chain.parameters]) & robot.free
        n = 400 * mine.sum()
        assert drawn[:, mine].std() == pytest.approx(sigma, rel=4.0 / np.sqrt(2.0 * n))  # 4 σ
        assert abs(drawn[:, mine].mean()) < 4.0 * sigma / np.sqrt(n)
    assert (drawn[:, ~robot.free] == 0.0).all()
    assert (drawn[:, [p.unit == "1" for p in chain.parameters]] == 0.0).all()
    puma = builtin_robot("puma560")
    assert np.array_equal(true_params(puma, 1), puma.parameter_sets["optimised"])
    assert not np.array_equal(true_params(puma, 1, tolerance), puma.parameter_sets["optimised"])


@pytest.mark.parametrize("name", ["panda", "irb120", "ulb"])
def test_every_arm_has_a_rig_and_moves_within_its_speeds(name):
    robot = builtin_robot(name)
    rig, size = standard_rig(robot), reach(robot, robot.branch)
    assert max(np.linalg.norm(c.xyz) for c in rig.chucks.values()) < size
    plan = standard_plan(9, 1, rig, robot)
    world = World(1, plan, rig, robot=robot, arm=Arm(backlash=(4e-4, 2e-4)))
    arm = moving(robot)
    t = np.arange(0.0, world.duration, 0.01)
    speed = np.abs(np.diff(world.controller.q_commanded(t), axis=0)).max(axis=0) / 0.01
    assert (speed < np.array(arm.speed) * 1.001).all()
    assert len(world.controller.arm.backlash) == len(robot.chain.joints)
    zero = np.array([rig.bars[bar].zero for bar in plan.bar])
    assert np.abs(world.truth.length - zero).max() < 0.0375  # half the bars' travel
