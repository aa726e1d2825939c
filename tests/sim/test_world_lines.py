"""Lines that the robot drives past the line device: the drive itself, where the device lies, and what its sensors show and when."""

from dataclasses import replace

import numpy as np
import pytest

from truearm.errors import PlanError
from truearm.model.chain import forward, point_forward
from truearm.model.robot_file import builtin_robot
from truearm.model.transforms import rotation, rotation_vector
from truearm.types import Device
from truearm_sim import line_device, robot, sensors
from truearm_sim.line_device import BY_HAND, Flaws
from truearm_sim.line_plan import TARGETS, drawn_line_plan, line_rig
from truearm_sim.paths import ACCELERATION
from truearm_sim.world import Setup, World

PERIOD = 983_040
PLAN = drawn_line_plan(2, seed=3)
RIG = line_rig()
WORLD = World(6, PLAN, RIG)
START = WORLD.device_clock.from_true_ns(0)
P_TARGET = np.array(TARGETS["magnet"].xyz)


def drives():
    """Yield (stop, times while its line is driven) of every line row."""
    c = WORLD.controller
    return [(stop, np.linspace(c.move_start[stop], c.arrive[stop], 2001)) for stop in np.flatnonzero(c.is_line)]


def in_device(world, stop, t):
    """Return the true target in the true device's axes, without errors of the drive."""
    origin, axes = world.placed[str(PLAN.line[world.controller.pose[stop]])]
    return (point_forward(world.chain, world.params, world.controller.q_true(t), P_TARGET) - origin) @ axes


def test_lines_are_straight_and_even_by_the_controllers_own_model():
    chain = builtin_robot("puma560").chain
    c = WORLD.controller
    for _, t in drives():
        p = point_forward(chain, chain.params_nominal, c.q_commanded(t), P_TARGET)
        along = (p[-1] - p[0]) / np.linalg.norm(p[-1] - p[0])
        way = (p - p[0]) @ along
        assert (
            np.abs(p - p[0] - way[:, None] * along).max() < 30e-9
        )  # the spline between knots 5 mm apart, most at its ends
        assert way[-1] == pytest.approx(0.5, abs=1e-6)
        speed = np.gradient(way, t)
        ramp = 1.5 * 0.1 / ACCELERATION
        cruise = (t > t[0] + ramp + 0.01) & (t < t[-1] - ramp - 0.01)
        assert np.abs(speed[cruise] - 0.1).max() < 1e-6
        assert np.abs(np.gradient(speed, t)).max() < 1.01 * ACCELERATION
        assert np.allclose(c.way(t), way, rtol=0, atol=5e-8)  # its first knots
        # The tool turns at an even rate about one axis.
        turns = forward(chain, chain.params_nominal, c.q_commanded(t))[:, :3, :3]
        turned = rotation_vector(turns @ turns[0].T)
        assert np.abs(turned - (way / way[-1])[:, None] * turned[-1]).max() < 1e-6


def test_the_robot_waits_for_the_device_to_be_placed_and_rests_at_the_ends():
    c = WORLD.controller
    rest = c.leave - c.arrive
    begins = np.flatnonzero(c.is_line & ~np.append(False, c.is_line[:-1])) - 1
    assert len(begins) == 2
    assert np.allclose(rest[begins], robot.PAUSE + robot.TURN, rtol=0, atol=1e-9)
    assert np.allclose(rest[c.is_line], robot.TURN, rtol=0, atol=1e-9)
    assert not c.bar_is_on(np.arange(0.0, c.duration, 0.1)).any()
    assert c.dwells.size == 0
    assert np.isnan(WORLD.length(np.arange(0.0, c.duration, 0.1))).all()


def test_the_device_lies_along_the_true_way_within_its_reach():
    nominal = WORLD.chain.params_nominal
    for stop, t in drives():
        seen = in_device(WORLD, stop, t)
        # The operator centres the ends to SETUP; between them half a metre bends by a millimetre or two.
        assert np.abs(seen[[0, -1]][:, [0, 2]]).max() < 5 * line_device.SETUP
        assert np.abs(seen[:, [0, 2]]).max() < 0.5 * line_device.REACH
        assert (seen[:, 1] > line_device.STROKE[0]).all()
        assert (seen[:, 1] < line_device.STROKE[1]).all()
        origin, axes = WORLD.placed[str(PLAN.line[WORLD.controller.pose[stop]])]
        assert np.allclose(axes.T @ axes, np.eye(3), rtol=0, atol=1e-12)
        # Where the controller believes the target, the device would be out of reach: so it is not placed by the model.
        believed = (point_forward(WORLD.chain, nominal, WORLD.controller.q_commanded(t), P_TARGET) - origin) @ axes
        assert np.abs(believed - seen).max() > line_device.REACH


def test_what_is_written_down_of_a_device_is_its_orientation_by_hand():
    turned = []
    for seed in range(40):
        world = World(seed, PLAN, RIG)
        for name, device in world.rig.lines.items():
            assert (device.xyz, device.sigma, device.turn_sigma) == (None, None, BY_HAND)
            turned.append(rotation_vector(rotation(np.array(device.rotation)) @ world.placed[name].axes.T))
    # χ² of 240 angles: mean 240, σ 22.
    assert abs(np.sum((np.array(turned) / BY_HAND) ** 2) - 240) < 5 * 22
    assert WORLD.truth.lines is WORLD.placed


def test_a_device_whose_place_is_declared_stands_there():
    placed = WORLD.placed["l1"]
    cov = tuple(tuple(1e-8 * (i == k) for k in range(3)) for i in range(3))
    devices = {
        "l1": Device("l1", cov, tuple(placed.origin.tolist()), tuple(rotation_vector(placed.axes).tolist()), 0.0, 0.0),
        "l2": Device("l2", cov, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0, 0.0),
    }
    world = World(77, PLAN, replace(RIG, lines=devices))
    assert np.allclose(world.placed["l1"].origin, placed.origin, rtol=0, atol=1e-12)
    assert np.allclose(world.placed["l1"].axes, placed.axes, rtol=0, atol=1e-12)
    t = np.arange(0.0, world.duration, 0.01)
    first = world.controller.pose[world.controller.stop_index(t)] <= 2
    assert np.isfinite(world.magnet_position(t)[first]).any()
    assert np.isnan(world.magnet_position(t)[~first]).all()  # the second lies where the arm never comes


def decoded(world, k0, k1, period=PERIOD):
    """Return x, y, z (n, 3) [m] of samples and shots with the same numbers, as the host reads them; NaN where one is missing."""
    counts, _ = world.samples(k0, k1, START, period)
    flights = world.flight_times(k0, k1, START, period)
    out = np.full((k1 - k0, 3), np.nan)
    for column, channel, poly in zip((0, 2), (1, 2), sensors.TRANSVERSE_POLY, strict=True):
        zero, gain = (mantissa * 10.0**exponent for mantissa, exponent in poly)
        good = counts[:, channel] > -(2**23)
        out[good, column] = zero + gain * sensors.VOLTS_PER_COUNT * counts[good, channel]
    good = flights >= 0
    out[good, 1] = (1e-12 * flights[good] - 1e-9 * sensors.MAG_DELAY_NS) * sensors.SOUND
    return out


def numbers_of(world, t0, t1, period=PERIOD):
    return [int((world.device_clock.from_true_ns(int(1e9 * t)) - START) / period) for t in (t0, t1)]


def test_the_box_shows_the_magnet_where_it_is_at_the_right_moment():
    """Position at the interrogation edge, transverse readings the converter's group delay before the stamp."""
    period = sensors.period_ns(16384)
    delay = 1e-9 * sensors.group_delay_ns(16384)
    for stop, t in drives()[:2]:
        k0, k1 = numbers_of(WORLD, t[300], t[-300], period)
        seen = decoded(WORLD, k0, k1, period)
        stamp = WORLD.device_clock.true(1e-9 * (START + np.arange(k0, k1) * period))
        drive = int(WORLD.controller.pose[stop])
        for column, when in ((0, stamp - delay), (1, stamp), (2, stamp - delay)):
            error = line_device.drive_errors(6, drive, WORLD.controller.way(when)) * RIG.line_sigma
            left = seen[:, column] - in_device(WORLD, stop, when)[:, column] - error[:, column]
            noise = (18e-6 * 7.2e-3, 5.1e-6, 18e-6 * 7.2e-3)[column]
            assert np.abs(left).max() < 5 * noise
            if column == 1:  # at 100 mm/s the delay, 2.2 ms, is 220 µm
                assert abs(delay - 2.2e-3) < 1e-4
                late = seen[:, 1] - in_device(WORLD, stop, when - delay)[:, 1] - error[:, 1]
                assert np.abs(late).min() > 100e-6


def test_drives_have_errors_of_the_declared_size_that_are_not_white():
    step, grain = 25e-6, line_device.GRAIN
    way = np.arange(0.0, 2.0, step)
    errors = np.concatenate([line_device.drive_errors(seed, row, way) for seed in range(20) for row in (1, 2)])
    # Their integrated correlation length is (4/π)² grains: of n independent numbers σ is known to 1/√(2 n), correlation to 1/√n.
    n = 2.0 / (grain * (4 / np.pi) ** 2)
    assert np.abs(errors.std(axis=0) - 1.0).max() < 5 / np.sqrt(2 * 40 * n)
    one = line_device.drive_errors(0, 1, way)
    near, far = int(0.1 * grain / step), int(2 * grain / step)
    assert np.corrcoef(one[:-near, 0], one[near:, 0])[0, 1] > 0.95
    assert abs(np.corrcoef(one[:-far, 0], one[far:, 0])[0, 1]) < 5 / np.sqrt(n)
    for other in (line_device.drive_errors(0, 2, way), line_device.drive_errors(1, 1, way)):
        assert abs(np.corrcoef(one[:, 0], other[:, 0])[0, 1]) < 5 / np.sqrt(n)
    assert np.array_equal(line_device.drive_errors(0, 1, way[100:200]), one[100:200])


def test_out_of_reach_nothing_is_shown():
    c = WORLD.controller
    away = next(s for s in range(len(c.pose)) if not c.is_line[s] and s and c.is_line[s - 1])
    k0, k1 = numbers_of(WORLD, c.move_start[away] + 0.01, c.arrive[away] - 0.01)
    counts, _ = WORLD.samples(k0, k1, START, PERIOD)
    assert (counts[:, 1:3] == -(2**23)).all()
    assert (WORLD.flight_times(k0, k1, START, PERIOD) == -1).all()


def test_a_late_robot_reports_where_it_was():
    late = World(6, PLAN, RIG, setup=Setup(robot_delay_s=0.008))
    assert late.truth.robot_delay == 0.008
    clock = late.clocks.robot
    t_robot, q = late.controller.readings(5.0, 9.0)
    assert np.abs(q - WORLD.controller.q_true(clock.true(t_robot) - 0.008)).max() <= robot.STEP / 2 + 1e-12
    states = late.controller.states(5.0, 9.0)
    assert np.array_equal(states.q, q)
    # q(t) = q_reading(t + τ) with τ = 8 ms: the joints are late, not the box.
    assert np.array_equal(late.samples(6000, 9000, START, PERIOD)[0], WORLD.samples(6000, 9000, START, PERIOD)[0])
    moved = np.abs(states.q - WORLD.controller.states(5.0, 9.0).q).max(axis=1)
    speed = np.abs(states.qd).max(axis=1)
    assert np.allclose(moved[speed > 0.05], 0.008 * speed[speed > 0.05], rtol=0.05, atol=2 * robot.STEP)


def test_flaws_are_what_they_say():
    _, t = drives()[0]
    k0, k1 = numbers_of(WORLD, t[300], t[-300])
    clean = decoded(WORLD, k0, k1)
    fast = decoded(World(6, PLAN, RIG, setup=Setup(flaws=Flaws(sound=2e-3))), k0, k1)
    assert np.allclose(fast[:, 1] * 1.002, clean[:, 1], rtol=0, atol=30e-6)  # the noise of a shot is scaled too
    late = decoded(World(6, PLAN, RIG, setup=Setup(flaws=Flaws(mag_delay=1e-3))), k0, k1)
    assert np.mean(clean[:, 1] - late[:, 1]) == pytest.approx(100e-6, rel=0.02)
    assert np.array_equal(late[:, [0, 2]], clean[:, [0, 2]])
    slow = decoded(World(6, PLAN, RIG, setup=Setup(flaws=Flaws(adc_delay=10 * PERIOD * 1e-9))), k0 + 10, k1)
    assert np.abs(slow[:, [0, 2]] - clean[:-10, [0, 2]]).max() < 1e-6
    bent = decoded(World(6, PLAN, RIG, setup=Setup(flaws=Flaws(bend=1e-3))), k0, k1)
    x = clean[:, 0]
    assert np.abs(bent[:, 0] - x - 1e-3 * (x / line_device.REACH) ** 3).max() < 1e-6


def test_lines_that_cannot_be_driven_are_refused():
    here = PLAN.select(np.array([0, 1]))
    for q, says in (
        (here.q[[0, 0]], "0.0 mm long"),
        (np.stack([here.q[0], here.q[1] + [0, 0, 0, 0, 0, 2 * np.pi]]), "one posture|singularity"),
        (np.stack([here.q[0] + [np.pi, 0, 0, 0, 0, 0], here.q[1]]), "one posture|singularity"),
    ):
        with pytest.raises(PlanError, match=says):
            World(1, replace(here, q=q), RIG)
