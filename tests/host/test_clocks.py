"""Two clocks related by rows: the bounds are those of all rows, the estimate is within them, steps are seen."""

import numpy as np
import pytest

from truearm.clocks import WANDER, Band, fit

NS = 10**9


def world(seed=1, n=400, ppm=40.0, step_ns=0, wrong=()):
    """Stamps, latest and earliest times [ns] of n requests in 100 s; the true time of a stamp."""
    rng = np.random.default_rng(seed)
    true = np.sort(rng.uniform(0.0, 100e9, n))
    stamps = (7e9 + true * (1.0 + 1e-6 * ppm)).astype(np.int64)
    told = true + step_ns * (true > 50e9)
    sent, arrived = told - 1e5 - rng.exponential(1e5, n), told + 1e5 + rng.exponential(1e5, n)
    for k in wrong:
        stamps[k] += 20_000_000
    order = rng.permutation(n)
    return stamps[order], arrived.astype(np.int64)[order] + NS, sent.astype(np.int64)[order] + NS, told[order] + NS


def test_the_range_is_what_each_row_alone_allows():
    """The running minima against all rows one by one, at rows, between them and beyond them."""
    rng = np.random.default_rng(3)
    x = np.sort(rng.uniform(0.0, 1e10, 50))
    low, high = rng.uniform(-3e5, -1e5, 50), rng.uniform(1e5, 3e5, 50)
    band = Band(x, low, high, -2e-5, 4e-5)
    for t in [*x[::9], *rng.uniform(-1e9, 1.1e10, 20)]:
        after = np.maximum(t - x, 0.0), np.maximum(x - t, 0.0)
        most = np.min(high + band.fast * after[0] - band.slow * after[1])
        least = np.max(low + band.slow * after[0] - band.fast * after[1])
        assert np.concatenate(band.range(np.array([t]))) == pytest.approx([least, most], abs=1e-6)


def test_time_and_stamp_are_inverse_and_within_the_bound():
    stamps, latest, earliest, truth = world()
    clock = fit(stamps, latest, earliest)
    time, bound = clock.to_time(stamps)
    assert np.all(np.abs(time - truth) <= bound)
    assert np.max(bound) < 3e5
    assert np.sqrt(np.mean((time - truth) ** 2)) < 2e4
    assert np.max(np.abs(clock.to_stamp(time) - stamps)) <= 1
    assert (clock.wrong.size, clock.steps) == (0, ())
    assert clock.rate == pytest.approx(-40e-6, abs=1e-6)


def test_beyond_the_rows_the_bound_grows_as_the_rate_may():
    stamps, latest, earliest, _ = world()
    _, bound = fit(stamps, latest, earliest).to_time(stamps.max() + np.array([0, NS, 10 * NS]))
    assert (np.diff(bound) / [1e9, 9e9]).tolist() == pytest.approx([WANDER, WANDER], rel=0.3)
