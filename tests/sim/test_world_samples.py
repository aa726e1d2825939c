"""What the box's converter sees: noise that belongs to the sample, repeatability, rails, stamps, delay, calibration."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from truearm.model.chain import point_forward
from truearm_sim import sensors
from truearm_sim.clocks import Clock
from truearm_sim.world import Setup, World, standard_plan, standard_rig

PERIOD = 983_040
PLAN = standard_plan(27, seed=7)
WORLD = World(11, PLAN)
START = WORLD.device_clock.from_true_ns(0)


def extension_of(counts):
    """Return the host's extension [m] for the LVDT's counts, with the box's configuration."""
    channel = WORLD.box_config()["channels"][0]
    volts = counts[:, 0] * (channel["scale"][0] * 10.0 ** channel["scale"][1])
    zero, gain = (mantissa * 10.0**exponent for mantissa, exponent in channel["calibration"]["poly"])
    return zero + gain * volts


def test_noise_of_another_seed_channel_or_block_is_other_noise():
    streams = [sensors.sample_noise(s, c, b) for s, c, b in [(1, 0, 0), (2, 0, 0), (1, 1, 0), (1, 0, 1)]]
    correlations = np.corrcoef(streams)[np.triu_indices(4, 1)]
    assert np.abs(correlations).max() < 5.0 / np.sqrt(sensors.BLOCK)  # σ of a correlation of independent numbers: 1/√n
    assert np.array_equal(sensors.sample_noise(1, 0, 0), streams[0])
    for noise in streams:
        assert stats.kstest(noise, "norm").pvalue > 1e-4


def test_the_length_in_motion_joins_the_dwells_without_a_jump_but_for_the_scatter():
    controller = WORLD.controller
    calm = np.flatnonzero(~controller.mounting)[1:]
    before, after = (WORLD.length(controller.arrive[calm] + 0.5 + dt) for dt in (-1e-6, 1e-6))
    assert np.abs(after - before).max() < 30e-9 + 1e-9  # what SETTLED leaves, and the ringing in 2 µs
    # At the start of a move the bar's scatter changes to that of the next dwell: 84 µm · √2, 5 σ.
    before, after = (WORLD.length(controller.move_start[calm] + dt) for dt in (-1e-9, 1e-9))
    assert np.abs(after - before).max() < 5 * np.sqrt(2) * 84e-6


def test_the_worlds_scatter_is_the_declared_repeatability():
    rig = standard_rig()
    world = World(5, PLAN)
    p_sphere = np.array([rig.spheres[name].xyz for name in PLAN.sphere])
    p_chuck = np.array([rig.chucks[name].xyz for name in PLAN.chuck])
    exact = np.linalg.norm(
        point_forward(world.chain, world.params, world.controller.q_held[world.controller.dwells], p_sphere) - p_chuck,
        axis=1,
    )
    scatter = (world.truth.length - exact) / 84e-6
    assert np.allclose(scatter, sensors.repeatability(5, len(PLAN)), rtol=0, atol=1e-9)


def test_the_bar_off_lies_at_the_rail_and_the_converter_saturates_and_rounds():
    counts, _ = WORLD.samples(0, 9000, START, PERIOD)
    t = WORLD.device_clock.true(1e-9 * (START + np.arange(9000) * PERIOD - sensors.group_delay_ns(4096)))
    off = ~WORLD.controller.bar_is_on(t)
    assert 0 < off.sum() < 9000
    assert np.array_equal(counts[:, 0] == -(2**23), off)
    volts = np.array([-5.0, -1.2, 0.0, 0.6 * sensors.VOLTS_PER_COUNT, 1.2, 5.0])
    assert sensors.counts_of_volts(volts).tolist() == [-(2**23), -(2**23), 0, 1, 2**23 - 1, 2**23 - 1]


def test_periods_and_delays_are_those_that_the_firmware_says():
    path = Path(__file__).parents[2] / "firmware" / "truearm_box" / "config.py"
    spec = importlib.util.spec_from_file_location("box_config", path)
    firmware = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(firmware)
    assert firmware.check(WORLD.box_config())["osr"] == 4096
    assert sensors.period_ns(4096) == PERIOD
    for osr in firmware.OSRS:
        assert sensors.period_ns(osr) == 240 * osr
        assert sensors.group_delay_ns(osr) == firmware.group_delay_ns(osr)
    with pytest.raises(ValueError, match="4097"):
        sensors.period_ns(4097)


def test_a_sample_shows_what_was_a_group_delay_earlier():
    t = np.arange(0.0, WORLD.truth.dwell_end[2], 1e-3)  # the first pairing
    t_ns = int(1e6 * np.nanargmax(np.abs(np.gradient(WORLD.length(t)))))  # where the bar moves fastest
    counts, _ = WORLD.samples(0, 1, WORLD.device_clock.from_true_ns(t_ns), sensors.period_ns(16384))
    length = WORLD.length(np.array([1e-9 * (t_ns - sensors.group_delay_ns(16384))]))
    undelayed = WORLD.length(np.array([1e-9 * t_ns]))
    assert abs(extension_of(counts)[0] - (length[0] - 0.46)) < 6 * sensors.SAMPLE_SIGMA
    assert abs(undelayed[0] - length[0]) > 50 * sensors.SAMPLE_SIGMA


def test_a_controller_goes_on_when_its_program_has_ended():
    end = WORLD.robot_end_ns
    states = WORLD.robot_states(end, end + 10**9)
    assert len(states.t) == 50
    assert np.ptp(states.q_cmd, axis=0).max() == 0.0


def test_the_truth_is_what_was_asked_for():
    params = WORLD.params + 0.0
    params[0] += 1e-3
    clocks = type(WORLD.clocks)(device=Clock(2.0, 5.0), robot=Clock(3.0, -5.0))
    world = World(1, PLAN, params=params, setup=Setup(clocks=clocks))
    assert world.truth.params is params
    assert world.device_clock.from_true_ns(10**9) == 3_000_005_000
    # Link 1 moved by 1 mm along x: every length changes by the bar's direction along x.
    change = world.truth.length - World(1, PLAN, setup=Setup(clocks=clocks)).truth.length
    assert 0.1e-3 < np.abs(change).max() <= 1e-3 + 1e-7
