"""The controller: motion within limits, dwells, settling, and what it reports; clocks."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from truearm.types import Plan
from truearm_sim import robot
from truearm_sim.arm import PUMA_ACCELERATION, PUMA_SPEED
from truearm_sim.clocks import Clock
from truearm_sim.robot import Controller
from truearm_sim.world import RobotInput, Setup, World, standard_plan

CLOCKS = st.builds(Clock, st.floats(-1e4, 1e4), st.floats(-500.0, 500.0), st.floats(-1e-3, 1e-3), st.floats(60.0, 1e4))


def small_plan(n=12, seed=0):
    rng = np.random.default_rng(seed)
    chuck = np.repeat(["c1", "c2"], [n // 2, n - n // 2])
    same = [np.full(n, name) for name in ("bar46", "s1")]
    return Plan(rng.uniform(-1.5, 1.5, (n, 6)), chuck, same[0], chuck, same[1])


@given(CLOCKS, st.floats(0.0, 1e4))
def test_a_clock_is_inverted_to_the_last_bits(clock, t):
    # Readings reach 2e4 s, where neighbouring doubles lie 3.6e-12 s apart; the inverse adds and subtracts two of them.
    assert abs(clock.true(clock.reading(t)) - t) <= 2e-11
    assert abs(clock.reading(clock.true(t)) - t) <= 2e-11


def test_a_clock_by_hand():
    clock = Clock(offset=5.0, ppm=100.0, wander=1e-3, wander_period=1000.0)
    assert clock.reading(0.0) == 5.0
    assert clock.reading(500.0) == pytest.approx(5.0 + 500.0 + 0.05 + 2e-3, abs=1e-12)
    assert clock.reading(np.array([1000.0]))[0] == pytest.approx(1005.1, abs=1e-12)


def test_speeds_and_accelerations_are_kept_and_used():
    controller = Controller.from_plan(small_plan())
    step = 1e-3
    q = controller.q_commanded(np.arange(0.0, controller.duration, step))
    speed = np.abs(np.diff(q, axis=0)) / step / np.array(PUMA_SPEED)
    acceleration = np.abs(np.diff(q, 2, axis=0)) / step**2 / np.array(PUMA_ACCELERATION)
    # Differences over 1 ms of a quintic lie below its peaks by the mean value theorem.
    assert speed.max() <= 1.0 + 1e-9
    assert acceleration.max() <= 1.0 + 1e-6
    for i in range(1, len(controller.pose)):
        way = slice(int(controller.move_start[i] / step), int(controller.arrive[i] / step) + 2)
        assert max(speed[way].max(), acceleration[way].max()) > 0.98  # some joint is at its limit, but for the sampling


def test_dwells_pauses_and_remounting():
    plan = small_plan()
    controller = Controller.from_plan(plan)
    dwells = controller.dwells
    start, end = controller.arrive[dwells], controller.leave[dwells]
    assert controller.pose[dwells].tolist() == list(range(12))
    assert np.allclose(end - start, 2.0, rtol=0, atol=1e-9)
    assert np.allclose(controller.move_start[1:], controller.leave[:-1], rtol=0, atol=1e-9)
    assert controller.duration == end[-1]
    for t in (start + 1e-6, 0.5 * (start + end), end - 1e-6):
        assert np.array_equal(controller.stop_index(t), dwells)
        assert np.allclose(controller.q_commanded(t), plan.q, rtol=0, atol=1e-14)
    plan = small_plan()
    controller = Controller.from_plan(plan, remount=np.arange(12) == 3)
    waits = np.flatnonzero(controller.mounting)
    assert controller.pose[waits].tolist() == [0, 3, 6]  # the first pose, the one asked for, and the second chuck
    assert np.allclose(controller.leave[waits] - controller.arrive[waits], 4.0, rtol=0, atol=1e-9)
    assert np.array_equal(controller.pose[waits + 1], controller.pose[waits])
    turned = controller.q[waits] - plan.q[[0, 3, 6]]
    assert np.allclose(turned, [[0, 0, 0, 0, 0, -0.05]] * 3, rtol=0, atol=1e-15)
    controller = Controller.from_plan(small_plan(), remount=np.arange(12) == 3)
    t = np.arange(0.0, controller.duration, 0.01)
    off = ~controller.bar_is_on(t)
    waits = np.flatnonzero(controller.mounting)
    pauses = zip(controller.move_start[waits], controller.leave[waits] - robot.READY, strict=True)
    assert np.array_equal(off, np.any([(t >= a) & (t < b) for a, b in pauses], axis=0))
    assert controller.bar_is_on(controller.arrive[controller.dwells]).all()


def test_the_joints_ring_and_settle():
    controller = Controller.from_plan(small_plan())
    deviation = [np.abs(controller.q_true(controller.arrive + dt) - controller.q_held).max() for dt in (0.028, 0.5)]
    # A quarter of a period after arrival: RING_SHARE · a/ω² at decay exp(-0.56); for 4 … 15 rad/s² some 1e-4 rad.
    assert 1e-5 < deviation[0] < 1e-3
    limit = robot.RING_SHARE * np.array(PUMA_ACCELERATION) / (2 * np.pi * robot.RING_HZ) ** 2
    assert np.all(np.abs(controller.ring) <= limit + 1e-12)
    # The sphere lies within 1 m of the axes of joints 1 and 2, 0.6 m of joint 3, 0.2 m of the wrist: 30 nm in all.
    assert limit @ [1.0, 1.0, 0.6, 0.2, 0.2, 0.2] * np.exp(-10.0) < 30e-9
    assert deviation[1] <= limit.max() * np.exp(-10.0)
    assert not controller.is_settled(controller.arrive + 0.499).any()
    settled = controller.arrive + 0.501
    assert controller.is_settled(settled).all()
    assert np.allclose(controller.q_true(settled), controller.q_held, rtol=0, atol=1e-12)


def test_the_servo_holds_near_the_command_but_not_on_it():
    n = 2000
    to_and_fro = 0.01 * (np.arange(n)[:, None] % 2) * np.ones(6)
    plan = Plan(to_and_fro, *(np.full(n, "x") for _ in range(4)))
    controller = Controller.from_plan(plan, seed=5)
    error = (controller.q_held - controller.q)[controller.dwells] / robot.SERVO_SIGMA
    # χ² with 12,000 degrees of freedom: mean 12,000, σ 155.
    assert abs(np.sum(error**2) - 12_000) < 5 * 155


def test_readings_are_multiples_of_the_resolution_near_the_true_joints():
    assert robot.STEP <= 1e-4
    clock = Clock(100.0, 20.0)
    controller = Controller.from_plan(small_plan(), clock)
    t_robot, q = controller.readings(0.0, controller.duration)
    assert np.abs(q / robot.STEP - np.round(q / robot.STEP)).max() < 1e-9
    q_true = controller.q_true(clock.true(t_robot))
    assert np.abs(q - q_true).max() <= robot.STEP / 2 + 1e-12
    assert np.allclose(np.diff(t_robot), 0.02, rtol=0, atol=1e-9)


def test_lines_hold_the_readings():
    clock = Clock(1000.0, 12.0)
    controller = Controller.from_plan(small_plan(), clock, rate=125.0)
    t, lines = controller.reading_lines(3.0, 9.0)
    t_robot, q = controller.readings(3.0, 9.0)
    rows = [json.loads(line) for line in lines]
    assert all(line.endswith(b"}\n") for line in lines)
    assert len(rows) == len(t) == 750
    assert np.all((t >= 3.0) & (t < 9.0))
    # %.6f, %.9f and %.12f round by half a last digit.
    assert np.allclose([row["t"] for row in rows], t_robot, rtol=0, atol=5.1e-7)
    assert np.allclose([row["q"] for row in rows], q, rtol=0, atol=5.1e-13)
    assert np.allclose([row["q_cmd"] for row in rows], controller.q_commanded(t), rtol=0, atol=5.1e-10)
    assert np.array_equal(np.diff([row["seq"] for row in rows]), np.ones(749))
    assert json.loads(controller.reading_lines(0.0, 0.1)[1][0])["seq"] == 0


def test_without_a_wire_readings_have_no_inputs():
    world = World(4, standard_plan(9, 4))
    assert b"inputs" not in world.robot_lines(0, 10**9, lambda t: t > 0)[1][0]
    assert world.box_config()["trigger_ms"] == [0, 0]
    wired = World(4, standard_plan(9, 4), setup=Setup(robot_input=RobotInput(0)))
    assert not np.any(wired.robot_states(0, 10**9).inputs)
    assert np.all(wired.robot_states(0, 10**9, lambda t: t >= 0).inputs == 1)


def test_polarity_and_delays_of_an_input():
    """High from 1 s to 2 s; an NPN input is on without it. Each edge shows by its own delay later."""

    def output(t):
        return (t >= 1.0) & (t < 2.0)

    t = np.array([0.99, 1.05, 1.15, 1.99, 2.05, 2.15, 2.25, 2.35])
    late_off = RobotInput(0, rising_delay_s=0.1, falling_delay_s=0.3)
    assert late_off.level(output, t).tolist() == [False, False, True, True, True, True, True, False]
    late_on = RobotInput(0, rising_delay_s=0.3, falling_delay_s=0.1, inverted=True)
    assert late_on.level(output, t).tolist() == [True, True, True, False, False, True, True, True]
