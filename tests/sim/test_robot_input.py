"""The box's trigger output at the robot's input: each reading shows the level at its own instant, made ahead of time or not."""

import json
from functools import partial

import numpy as np
import pytest

from truearm_sim.lab import Lab
from truearm_sim.micropython import find
from truearm_sim.simbox import SimulatedBox
from truearm_sim.vmbox import VmBox
from truearm_sim.world import RobotInput, Setup, World, standard_plan
from truearm_wire.frame import frame
from truearm_wire.messages import START, encode_payload

INPUT = 3


@pytest.fixture
def lab():
    world = World(4, standard_plan(9, 4), setup=Setup(robot_rate=500.0, robot_input=RobotInput(INPUT, (300, 1300))))
    box = SimulatedBox(world, power_on=partial(VmBox, find()))
    yield Lab(world, box, 4)
    box.close()


def test_every_reading_shows_the_level_at_its_instant(lab):
    lab.box_link.read(0.5)
    lab.box_link.write(frame(encode_payload([START, 1])))
    lines = []
    while lab.now_ns < 14e9:
        lab.box_link.read(0.013)
        lines += lab.robot_link.read(0.0)
    rows = [json.loads(line) for _, line in lines]
    arrival = np.array([t for t, _ in lines])
    assert np.all(np.diff(arrival) >= 0)
    assert [row["seq"] for row in rows] == list(range(len(rows)))  # none twice, none left out
    t = lab.world.clocks.robot.true(np.array([row["t"] for row in rows]))
    assert arrival.min() - lab.host_ns(0) >= 1e9 * t.min()
    shown = np.array([row["inputs"] for row in rows])
    edges = lab.box.output_edges
    assert len(edges) > 8
    assert [level for _, level in edges] == [k % 2 == 0 for k in range(len(edges))]
    assert np.array_equal(shown, np.where(lab.box.output_at(t), 1 << INPUT, 0))
    # Each edge lies between two readings that differ, within a cycle of 2 ms.
    changes = np.flatnonzero(np.diff(shown))
    seen = [(1e9 * t[i], 1e9 * t[i + 1]) for i in changes]
    for (before, after), (at, _) in zip(seen, edges, strict=False):
        assert before <= at <= after
        assert after - before < 2.1e6


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
