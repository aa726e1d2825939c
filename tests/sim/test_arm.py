"""Arms that are not stiff and quick: backlash, a late joint, a link that swings, noisy readings."""

import numpy as np

from truearm.types import Plan
from truearm_sim import robot
from truearm_sim.arm import Arm
from truearm_sim.robot import Controller

BACKLASH = (4e-4, 0.0, 2e-4, 0.0, 0.0, 1e-3)


def plan_of(q):
    q = np.asarray(q, dtype=float)
    return Plan(q, *(np.full(len(q), "x") for _ in range(4)))


def steps(n=9, seed=3):
    return plan_of(np.cumsum(np.random.default_rng(seed).uniform(-0.4, 0.4, (n, 6)), axis=0))


def test_the_links_lie_behind_their_encoders_on_the_side_they_come_from():
    plan = plan_of([[0.0] * 6, [0.5, 0.5, -0.5, 0, 0, -0.5], [0.5, 0.7, -0.2, 0, 0, -0.9]])
    worn, sound = (Controller.from_plan(plan, seed=1, arm=arm) for arm in (Arm(backlash=BACKLASH), None))
    behind = (worn.q_rest - worn.q_held)[worn.dwells]
    half = 0.5 * np.array(BACKLASH)
    assert np.allclose(behind[1], [-half[0], 0, half[2], 0, 0, half[5]], rtol=0, atol=1e-15)
    assert np.allclose(behind[2], [-half[0], 0, -half[2], 0, 0, half[5]], rtol=0, atol=1e-15)  # joint 1 stayed
    for t0, t1 in ((0.0, 3.0), (3.0, worn.duration)):
        assert np.array_equal(worn.readings(t0, t1)[1], sound.readings(t0, t1)[1])
    at = worn.leave - 0.01
    assert np.array_equal(worn.q_true(at), sound.q_true(at) + worn.arm.behind(worn.direction))


def test_a_robot_told_to_go_where_it_stands_stays():
    plan = plan_of([[0.0] * 6, [0.3] * 6, [0.3] * 6, [0.3] * 6, [0.0] * 6])
    controller = Controller.from_plan(plan, seed=1)
    held = controller.q_held[controller.dwells]
    assert np.array_equal(held[1], held[2])
    assert np.array_equal(held[1], held[3])
    assert not np.array_equal(held[0], held[4])


def test_a_slow_arm_comes_up_and_its_encoders_say_so():
    arm = Arm(lag=1e-3, lag_s=0.2)
    controller = Controller.from_plan(steps(), seed=1, arm=arm)
    quick = Controller.from_plan(steps(), seed=1)
    for since in (0.0, 0.2, 0.6):
        short = controller.q_driven(controller.arrive + since) - quick.q_driven(controller.arrive + since)
        assert np.allclose(short, -1e-3 * np.exp(-since / 0.2) * controller.direction, rtol=0, atol=1e-12)
        assert np.array_equal(
            controller.q_true(controller.arrive + since), controller.q_driven(controller.arrive + since)
        )
    assert not controller.is_settled(controller.arrive + 1.99).any()
    # No jump when the commanded motion ends: the joint has fallen behind on its way.
    before, after = (controller.q_true(controller.arrive + dt) for dt in (-1e-6, 1e-6))
    assert np.abs(after - before).max() < 1e-7


def test_a_link_swings_while_its_encoder_stands():
    controller = Controller.from_plan(steps(), seed=1, arm=Arm(swing=5e-4, swing_hz=4.0, swing_s=0.15))
    quarter = controller.arrive + 1 / 16
    beyond = controller.q_true(quarter) - controller.q_driven(quarter)
    assert np.allclose(beyond, 5e-4 * np.exp(-1 / 16 / 0.15) * controller.direction, rtol=0, atol=1e-12)
    rest = controller.arrive + controller.arm.rest_s(robot.SETTLED)
    assert np.abs(controller.q_true(rest) - controller.q_rest).max() < 5e-4 * np.exp(-9.9)
