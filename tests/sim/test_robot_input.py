"""The box's trigger output at the robot's input: no wire, polarity and delays; end_to_end/test_trigger.py has the rest."""

import numpy as np

from truearm_sim.world import RobotInput, Setup, World, standard_plan


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
