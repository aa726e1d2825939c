"""The box's trigger output at a robot's input, from the random times to the robot's clock, compared with the simulator's truth."""

import json

import numpy as np
import pytest
from tests.end_to_end.conftest import lab_with, recorded_with_plan, truearm
from tests.host.findings_bench import listed

from truearm.session.observations import survey
from truearm.session.session_file import open_session
from truearm_sim.lab import HOST_AT_START_NS
from truearm_sim.world import RobotInput, Setup, World, standard_plan

INPUT = 3
SECONDS = 62.0  # some 600 edges
# an NPN input behind a slow coupler
WIRED = RobotInput(INPUT, inverted=True, rising_delay_s=10e-6, falling_delay_s=300e-6)


def recorded(path, seed, seconds, rate=500.0):
    """The world of a session with a trigger wire, and its box."""
    world = World(seed, standard_plan(27, seed), setup=Setup(robot_rate=rate, robot_input=WIRED))
    with lab_with(world) as lab:
        recorded_with_plan(lab, path, duration_s=seconds)
        return world, lab.box


def surveyed(path):
    session = open_session(path)
    return survey(session.batches)


def errors_us(world, box, found):
    """Errors [µs] of the host's time of the robot's readings, with bounds, and of robot time against device time."""
    (clock,), (report,) = found.joints.clocks, found.joints.reports
    t_robot = np.linspace(*report.t_robot_s, 2000)
    true_s = world.clocks.robot.true(t_robot)
    host_ns = clock.to_host_ns(t_robot)
    device_us = 1e6 * (world.clocks.device.reading(true_s) - 1e-9 * box.boot_device_ns)
    whole = np.floor(device_us).astype(np.int64)
    by_device_ns = found.clocks[0].to_host_ns(whole)[0] + 1e3 * (device_us - whole)
    return (
        1e-3 * (host_ns - HOST_AT_START_NS - 1e9 * true_s),
        1e-3 * clock.bound_at(t_robot),
        1e-3 * (host_ns - by_device_ns),
    )


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    path = tmp_path_factory.mktemp("trigger") / "session.mcap"
    return path, *recorded(path, 11, SECONDS)


def test_edges_tie_the_robot_to_the_box_whatever_its_input_does(session):
    path, world, box = session
    found = surveyed(path)
    (report,) = found.joints.reports
    edges = report.edges
    assert edges.input == INPUT
    assert edges.in_use
    assert edges.inverted
    assert edges.falling_later_ns[0] <= 290e3 <= edges.falling_later_ns[1]
    assert 500 <= edges.used <= 700
    assert (edges.unseen, edges.unclear, edges.stray, edges.rejected) == (0, 0, 0, 0)
    error, bound, robot_to_device = errors_us(world, box, found)
    print(
        f"{edges.used} edges: robot to device {np.median(np.abs(robot_to_device)):.1f} µs off, {np.max(np.abs(robot_to_device)):.1f} at most; "
        f"host {np.max(np.abs(error)):.1f}, bound {np.max(bound):.1f} µs"
    )
    assert np.all(np.abs(error) <= bound)
    assert np.median(np.abs(robot_to_device)) <= 25.0
    assert np.max(np.abs(robot_to_device)) <= 70.0  # anywhere in the session
    assert np.max(bound) < 700.0  # box to host has 137 µs of half a round trip in it
    # inspect prints both: that of the edges alone is not widened by box to host
    assert np.median(np.abs(robot_to_device)) <= 1e-3 * edges.to_box_ns <= 70.0
    assert 1e-3 * edges.bound_ns > 1e-3 * edges.to_box_ns + 137.0
    # What arrivals alone cannot know: 300 µs of the link's, and what their own clock's half asymmetry takes off.
    assert 1e-3 * edges.shortest_latency_ns == pytest.approx(300.0, abs=150.0)
    path, *_ = session
    trigger = listed(json.loads(truearm("inspect", path, "--json").stdout))["trigger"]
    assert (trigger["input"], trigger["inverted"], trigger["in_use"]) == (INPUT, True, True)
    assert trigger["to_box"]["us"] <= 70.0 < trigger["bound"]["us"]
