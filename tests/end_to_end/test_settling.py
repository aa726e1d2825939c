"""A slow, flexible arm: the error caused by joint angles that are read too early, which dwells found by robot and sensor avoid."""

from dataclasses import replace

import numpy as np
import pytest
from tests.end_to_end.conftest import record_session

from truearm.estimate.identify import identify
from truearm.model.robot_file import builtin_robot
from truearm.workflows.recorded_session import observations_of_session, open_finished
from truearm_sim.arm import Arm
from truearm_sim.lab import HOST_AT_START_NS
from truearm_sim.robot import STEP, quantised

# Joints stop 0.6 mrad short of their place and come up in 0.15 s; links swing on by 0.1 mrad, which no encoder sees.
SLOW = Arm(lag=6e-4, lag_s=0.15, swing=1e-4, swing_hz=4.0, swing_s=0.15)


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    return record_session(tmp_path_factory.mktemp("slow") / "slow.mcap", 60, osr=16384, arm=SLOW)


@pytest.fixture(scope="module")
def result(session):
    return observations_of_session(open_finished(session.path))


def stops(session, result):
    """The dwells that gave an observation, and the controller's stops that they are."""
    used = [dwell for dwell in result.dwells if not dwell.reason]
    return used, session.world.controller.dwells[[dwell.pose for dwell in used]]


def test_every_dwell_is_used_from_where_the_arm_rests(session, result):
    used, stop = stops(session, result)
    assert len(used) == 120
    world, robot = session.world, session.world.controller
    begin = np.array([1e-9 * (dwell.start_host_ns - HOST_AT_START_NS) for dwell in used])
    # A quarter of the repeatability may be left of the bar's swing. Between two blocks of 25 ms it grows by e^(1/6) at most.
    left = np.abs(world.length(begin) - world.truth.length[[dwell.pose for dwell in used]])
    assert left.max() < 1.2 * 0.25 * 84e-6
    # Of the joints a step of the reading may be left, and half a step by which the level of their second half is rounded.
    short = np.abs(robot.q_driven(begin) - robot.q_held[stop])
    assert short.max() < 1.5 * STEP
    assert np.median(begin - robot.arrive[stop]) < 1.0


def test_dwell_detection_brings_back_what_reading_too_early_spoils(session, result):
    """Held-out errors with joints as they stood when their command did, as sync has them, and as the simulator knows them."""
    world, robot = session.world, builtin_robot("puma560")
    used, stop = stops(session, result)
    controller = world.controller
    early = replace(result.table, q=quantised(controller.q_driven(controller.arrive[stop])))
    length = world.truth.length[[dwell.pose for dwell in used]]
    settled = replace(result.table, q=quantised(controller.q_held[stop]), value=length)

    def error(table):
        fit = identify(robot.chain, world.rig, table, free=robot.free, hold_out=table.bar == "bar61")
        return fit.held_out.figures["m"].rms

    best, spoilt, found = error(settled), error(early), error(result.table)
    print(f"held out [mm]: settled {1e3 * best:.4f}, read too early {1e3 * spoilt:.4f}, dwells found {1e3 * found:.4f}")
    assert spoilt > 2.0 * best
    assert found < 1.1 * best
