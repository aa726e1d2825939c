"""Whether the errors that `map` claims are true, and whether it detects a device with undeclared errors. Robots are drawn from the prior."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy import stats
from tests.end_to_end.conftest import lab_with, measured_by_bars, recorded_with_plan

from truearm.estimate.identify import SolverOptions, identify
from truearm.estimate.uncertainty import weak_prior
from truearm.kinds.table import ObservationTable
from truearm.model.chain import point_forward
from truearm.model.robot_file import builtin_robot
from truearm.plan.plan_file import concatenate
from truearm.workflows.recorded_session import observations_of_session, open_finished
from truearm_sim.latency import FROM_ROBOT
from truearm_sim.line_device import Flaws, drive_errors
from truearm_sim.line_plan import TARGETS, drawn_line_plan, line_rig
from truearm_sim.world import Setup, World, standard_plan, standard_rig

ROBOT = builtin_robot("puma560")
CHAIN, FREE, SIGMA = ROBOT.chain, ROBOT.free, weak_prior(ROBOT.chain)
WORLDS = 50


@cache
def four_lines():
    return drawn_line_plan(4, seed=5)


def world_of(seed, **how):
    """Return a robot drawn from the weak prior, off by a few millimetres as in Renders, on four lines there and back."""
    drawn = np.random.default_rng([seed, 0xEE5]).standard_normal(SIGMA.size)
    truth = CHAIN.params_nominal + FREE * SIGMA * drawn
    return World(seed, four_lines(), line_rig(), params=truth, setup=Setup(robot_rate=125.0, **how))


def shown(world, flaws=None):
    """Rows of what the true device shows at 38 places of each drive, its declared errors included, sound and delays as they are."""
    flaws = flaws or Flaws()
    c, parts = world.controller, []
    for stop in np.flatnonzero(c.is_line):
        t = np.linspace(c.move_start[stop] + 0.3, c.arrive[stop] - 0.3, 38)
        row = int(c.pose[stop])
        name = str(c.plan.line[row])
        origin, axes = world.placed[name]
        late = t[:, None] - [flaws.adc_delay, flaws.mag_delay, flaws.adc_delay]
        p = [point_forward(CHAIN, world.params, c.q_true(when), np.array(TARGETS["magnet"].xyz)) for when in late.T]
        xyz = np.stack([((one - origin) @ axes)[:, k] for k, one in enumerate(p)], axis=1)
        xyz += np.array(world.rig.line_sigma) * drive_errors(world.seed, row, c.way(t))
        xyz[:, 1] /= 1.0 + flaws.sound
        rate = (c.q_true(t + 1e-3) - c.q_true(t - 1e-3)) / 2e-3
        parts.append((name, c.q_true(t), rate, xyz))
    lines = np.concatenate([np.full(len(q), name) for name, q, *_ in parts])
    q, rate, xyz = (np.concatenate([part[k] for part in parts]) for k in (1, 2, 3))
    return ObservationTable(q=q, kind="line", xyz=xyz, q_rate=rate, line=lines, target="magnet")


def found(world, table, **how):
    return identify(
        CHAIN, replace(world.rig, **how), table, free=FREE, prior_sigma=SIGMA, options=SolverOptions(solver="map")
    )


def in_band(estimate):
    low, high = estimate.chi2_band
    return low < estimate.chi2_reduced < high


def nees(world, estimate):
    """Return (θ − θ̂)ᵀ P⁻¹ (θ − θ̂) of the robot's free parameters."""
    free = estimate.free[: estimate.n_robot_parameters]
    error = (estimate.value[: free.size] - world.params)[free]
    return float(error @ np.linalg.solve(estimate.covariance[: free.size, : free.size][np.ix_(free, free)], error))


def recorded(world, path):
    """Return the world's session through firmware, recorder and synchronisation."""
    with lab_with(world) as lab:
        recorded_with_plan(lab, path, osr=8192)
    return observations_of_session(open_finished(path)).table


def test_a_position_that_is_late_is_noticed_or_found_as_a_delay():
    """At 100 mm/s a millisecond is the device's σ, with a sign for each direction. It looks like a robot that is early."""
    world = world_of(1)
    clean, late = shown(world), shown(world, Flaws(mag_delay=1e-3))
    assert in_band(found(world, clean, time_offset_sigma=0.0))
    noticed = found(world, late, time_offset_sigma=0.0)
    assert noticed.chi2_reduced > noticed.chi2_band[1]
    free = found(world, late, time_offset_sigma=None)
    assert in_band(free)
    k = free.parameter_names.index("time_offset")
    assert abs(free.value[k] + 1e-3) < 4 * free.sigma[k] < 0.4e-3


def test_a_clock_that_is_wrong_otherwise_after_a_restart_is_no_robots_error():
    """A bound of 0.25 ms on two lines and of the other sign on two: 25 µm, a quarter of the device's σ, alike in 152 rows each.
    A parameter that looked like it would be wrong by 3 σ or more; none does."""
    world = world_of(3)
    clean = shown(world)
    wrong_s = np.where(np.isin(clean.line, ["l1", "l2"]), 0.25e-3, -0.25e-3)
    before, after = (found(world, t) for t in (clean, replace(clean, q=clean.q + clean.q_rate * wrong_s[:, None])))
    free = before.free[: before.n_robot_parameters]
    change = (after.value - before.value)[: free.size][free]
    within = before.covariance[: free.size, : free.size][np.ix_(free, free)]
    assert change @ np.linalg.solve(within, change) < 0.01
    k = before.parameter_names.index("time_offset")
    assert abs(after.value[k] - before.value[k]) < 0.1e-3  # what is alike in all is τ's; this is not


def test_a_wrong_velocity_of_sound_is_noticed_beside_a_ball_bar():
    """Lines alone would make the arm smaller, which fits; a bar knows how long it is."""
    plan = concatenate(standard_plan(45, 2), four_lines())
    world = World(2, plan, line_rig(standard_rig()), params=world_of(2).params, setup=Setup(robot_rate=125.0))
    bars = measured_by_bars(world)
    for flaws, wrong in ((Flaws(), False), (Flaws(sound=5e-3), True)):
        lines = shown(world, flaws)
        assert in_band(found(world, lines))  # by themselves they are none the wiser
        table = ObservationTable.joined([bars, lines])
        estimate = found(world, table)
        assert in_band(estimate) is not wrong
        assert not wrong or estimate.chi2_reduced > estimate.chi2_band[1]


@pytest.mark.soak
@pytest.mark.parametrize("through", ["truth", "recorder and sync"])
def test_map_knows_how_far_it_errs(through, tmp_path):
    """NEES of robots drawn from the prior that is used is χ² with as many degrees of freedom as there are parameters."""
    delay = 8e-3
    values, delays = [], []
    for seed in range(WORLDS):
        world = world_of(seed, robot_delay_s=delay)
        table = shown(world) if through == "truth" else recorded(world, tmp_path / "session.mcap")
        estimate = found(world, table)
        values.append(nees(world, estimate))
        if through != "truth":
            k = estimate.parameter_names.index("time_offset")
            true = delay + 1e-9 * FROM_ROBOT.least
            delays.append((estimate.value[k] - true) / estimate.sigma[k])
    total = WORLDS * int(FREE.sum())
    low, high = stats.chi2.ppf([0.005, 0.995], total) / WORLDS
    print(f"{through}: NEES {np.mean(values):.2f} of {FREE.sum()}, band {low:.2f} to {high:.2f}; delays [σ]", delays)
    assert low < np.mean(values) < high
    assert max(values) < stats.chi2.ppf(1 - 1e-3 / WORLDS, FREE.sum())
    if delays:
        assert np.abs(delays).max() < 4.0
