"""Clocks in random scenarios (clock_scenarios.py): the truth is always within the bound, and no bound is absurdly wide."""

from dataclasses import replace

import numpy as np
import pytest
from tests.host.clock_scenarios import CHANGES, box_scenario, changing_scenario, robot_scenario, table

from truearm.session.clock_bounds import SPAN


def judge(outcomes, widest_us):
    """Every error within its bound; bounds that say something."""
    said = table(outcomes)
    print("\n" + said)
    assert all(np.all(np.abs(o.error) <= o.bound) for o in outcomes), said
    ratios = np.array([o.ratio.max() for o in outcomes])
    assert np.median(ratios) > 0.1, said  # a bound ten times the largest error of a session were none
    assert np.median([np.median(o.bound) for o in outcomes]) < widest_us, said


@pytest.mark.parametrize("seeds", [range(20), pytest.param(range(20, 200), marks=pytest.mark.soak)], ids=["20", "180"])
def test_the_box_in_every_life(seeds):
    """Half a round trip is 0.1 to 0.8 ms here, and no exchange can show less; the drift's allowance adds some 10 µs."""
    judge([box_scenario(seed) for seed in seeds], widest_us=800.0)


# Half a round trip is 0.1 to 0.8 ms; half the asymmetry comes on top, and 30 ppm for a minute where exchanges are that rare.
WIDEST_US = dict.fromkeys(CHANGES, 800.0) | {"asymmetry": 1800.0, "sparse": 3600.0, "all": 1050.0}


@pytest.mark.parametrize("name", CHANGES)
@pytest.mark.parametrize("seeds", [range(12), pytest.param(range(12, 1000), marks=pytest.mark.soak)], ids=["12", "988"])
def test_the_box_while_clocks_change(name, seeds):
    """Steps, slews, lasting changes of a rate, rare, lost and wrong exchanges: the bound holds, and is no wider for all that."""
    judge([changing_scenario(seed, CHANGES[name]).outcome for seed in seeds], WIDEST_US[name])


@pytest.mark.parametrize("seed", range(12))
def test_a_step_is_shown_and_not_bridged(seed):
    """A step that is larger than any round trip but stalled ones: the report has it, and nobody claims to know when it was."""
    found = changing_scenario(seed, CHANGES["steps"])
    host, bound = found.known.host, np.median(found.outcome.bound)
    at_us = 1e6 * found.known.crystal.reading(host.at)
    large = np.abs(host.by) > 3e-3
    assert np.all(found.at_step >= 0.5e6 * np.abs(host.by) - 1.0)
    for at, by in zip(at_us[large], host.by[large], strict=True):
        (change,) = [one for one in found.report.changes if one.device_us[0] <= at <= one.device_us[1]]
        assert 1e-3 * change.by_ns == pytest.approx(1e6 * by, abs=2.0 * bound)
        assert change.device_us[1] - change.device_us[0] < 4e6  # SPAN exchanges, of which one in five is lost


@pytest.mark.parametrize("name", ["steady", "asymmetry"])
def test_no_step_is_invented(name):
    change = replace(CHANGES[name], steps=0)
    for seed in range(12):
        assert changing_scenario(seed, change).report.changes == ()


def test_wrong_exchanges_are_no_steps():
    """They are rejected; the clock goes on. One of them may hide or fake what its neighbours say, but hardly ever does."""
    reports = [changing_scenario(seed, CHANGES["wrong"]).report for seed in range(12)]
    assert sum(len(report.changes) for report in reports) <= 1
    assert (
        np.median([report.rejected for report in reports]) >= 4
    )  # of up to 8; those by less than a round trip cannot be seen


@pytest.mark.parametrize("seeds", [range(12), pytest.param(range(12, 1000), marks=pytest.mark.soak)], ids=["12", "988"])
def test_steps_that_nothing_can_show(seeds):
    """Only in a stretch of fewer than SPAN exchanges, between two steps or at an end, may the bound be broken (session/clock_bounds.py)."""
    for seed in seeds:
        found = changing_scenario(seed, replace(CHANGES["steps"], apart=0.0))
        at, exchange = np.sort(found.known.host.at), np.sort(found.known.crystal.true(1e-6 * found.known.rows[:, 1]))
        beyond = found.t[np.abs(found.outcome.error) > found.outcome.bound]
        in_stretch = np.diff(np.searchsorted(exchange, at), prepend=0, append=exchange.size)
        assert np.all(in_stretch[np.searchsorted(at, beyond)] < SPAN)


@pytest.mark.parametrize("seeds", [range(20), pytest.param(range(20, 200), marks=pytest.mark.soak)], ids=["20", "180"])
def test_the_robot_in_every_life_beside_its_links_shortest_latency(seeds):
    """What the arrivals of a window leave open, 7.5 µs of drift's allowance with it; the shortest latency is in no bound."""
    judge([robot_scenario(seed) for seed in seeds], widest_us=100.0)


@pytest.mark.parametrize("changes", [{"host_steps": 3}, {"robot_steps": 3}, {"slews": 2}], ids=" ".join)
@pytest.mark.parametrize("seeds", [range(12), pytest.param(range(12, 1000), marks=pytest.mark.soak)], ids=["12", "988"])
def test_the_robot_while_clocks_change(changes, seeds):
    """Steps of up to 10 ms and slews by up to 10 ms: the windows about them are as wide as that."""
    judge([robot_scenario(seed, **changes) for seed in seeds], widest_us=10_000.0)


def test_the_shortest_latency_of_the_robots_link_cannot_be_seen():
    """It is said: the error with it exceeds the bound, however long the session."""
    outcome = robot_scenario(3)
    assert outcome.floor > outcome.bound.max()
    assert np.all(outcome.error + outcome.floor > outcome.bound)


@pytest.mark.parametrize("seed", range(3))
def test_a_nominal_session_strays_by_less_than_2_us(seed):
    outcome = box_scenario(seed, nominal=True)
    assert np.std(outcome.error) <= 2.0
    assert np.all(np.abs(outcome.error) <= outcome.bound)
