"""Clocks through many lives (clock_scenarios.py): the truth is within the bound in every one, and no bound is absurdly wide."""

import numpy as np
import pytest
from tests.host.clock_scenarios import box_scenario, robot_scenario, table


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


@pytest.mark.parametrize("seeds", [range(20), pytest.param(range(20, 200), marks=pytest.mark.soak)], ids=["20", "180"])
def test_the_robot_in_every_life_beside_its_links_shortest_latency(seeds):
    """What the arrivals of a window leave open, 7.5 µs of drift's allowance with it; the shortest latency is in no bound."""
    judge([robot_scenario(seed) for seed in seeds], widest_us=100.0)


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
