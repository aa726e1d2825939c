"""The clock during a recording: within its bound at all times, consistent with the later fit, and cheap."""

import time
from dataclasses import replace

import numpy as np
import pytest
from tests.host.clock_scenarios import CHANGES, HOST_NS, exchanged
from tests.host.test_session_device_clock import TAIL_NS, True_, exchanges, shape

from truearm.session.box_frames import Exchange
from truearm.session.device_clock import MOST_EXCHANGES, OnlineClock, fit_clock


def in_order(every):
    """A link is a queue: what is asked first is answered first."""
    return sorted(every, key=lambda e: e.t1_us)


def run(every):
    """The estimates after each exchange, None where there is none."""
    online = OnlineClock()
    found = []
    for exchange in every:
        online.add(*exchange)
        found.append(online.estimate())
    return found


@pytest.mark.parametrize(("ppm", "drift_ppm_per_s"), [(37.0, 0.0), (-100.0, 1.0 / 60.0), (100.0, -1.0 / 60.0)])
def test_every_estimate_is_within_its_bound_and_agrees_with_the_fit_afterwards(ppm, drift_ppm_per_s):
    rng = np.random.default_rng(1)
    true = True_(ppm, drift_ppm_per_s)
    every = in_order(exchanges(rng, true, duration_s=70.0))
    clock, _ = fit_clock(0, every)
    found = [e for e in run(every) if e is not None]
    assert len(found) == len(every) - 2
    device = np.array([e.device_us for e in found])
    host = np.array([e.offset_ns for e in found]) + 1000 * device
    bound = np.array([e.bound_ns for e in found])
    # The true clock, solved for the host's time: s (1 + rate) + drift s²/2 = elapsed.
    elapsed = 1e-6 * (device - true.boot_us)
    a, b = 0.5 * true.drift, 1.0 + true.rate
    truth_ns = 1e9 * 2.0 * elapsed / (b + np.sqrt(b * b + 4.0 * a * elapsed))
    assert np.all(np.abs(host - truth_ns) <= bound + 1.0)
    rate = -(ppm + drift_ppm_per_s * elapsed)
    rate_bound = np.array([e.rate_bound_ppm for e in found])
    assert np.all(np.abs([e.rate_ppm for e in found] - rate) <= rate_bound + 1.0)  # the clocks drift by 1 ppm a minute
    assert rate_bound[0] > 100.0 > 10.0 > rate_bound[-1]
    afterwards, bound_afterwards = clock.to_host_ns(device)
    assert np.all(np.abs(host - afterwards) <= bound + bound_afterwards)
    assert found[-1].bound_ns < 1.5 * TAIL_NS  # 90 µs of half asymmetry, and what a minute of exchanges leaves open
    # The mean rate of the last minute, 30 s before the end; 100 µs of open bounds over 60 s are 1.7 ppm.
    assert found[-1].rate_ppm == pytest.approx(-(ppm + drift_ppm_per_s * 40.0), abs=1.7)


def test_a_host_clock_that_steps_is_not_covered_up():
    device_s = shape("step", 2000.0)
    rng = np.random.default_rng(4)
    every = []
    for t0 in np.arange(0.0, 120.0, 0.25):
        t1 = t0 + 125e-6 + rng.exponential(80e-6)
        t3 = t1 + 155e-6 + rng.exponential(120e-6)
        every.append(Exchange(int(1e9 * t0), int(1e6 * device_s(t1)), int(1e6 * device_s(t1)) + 5, int(1e9 * t3) + 1))
    online, found = OnlineClock(), {}
    for k, exchange in enumerate(every):
        online.add(*exchange)
        if 330 <= k < 370 or k % 10 == 9:
            found[k] = online.estimate()
    assert (
        max(found[k].bound_ns for k in range(330, 370)) > 0.9e6
    )  # half the step: on which side of it is the exchange?
    assert found[479].bound_ns < 1e6
    for e in found.values():
        # The host's time of what the device's clock shows; where that stepped over a time, either side of the step will do.
        elapsed = 1e-6 * e.device_us - 5.0
        truths = (elapsed / (1.0 + 20e-6), (elapsed - 2e-3) / (1.0 + 20e-6))
        truth = 1e9 * truths[truths[1] > 85.0]
        assert abs(e.offset_ns + 1000 * e.device_us - truth) <= e.bound_ns + 1000.0  # the device's whole µs


@pytest.mark.parametrize("name", ["steady", "lost"])
@pytest.mark.parametrize("seeds", [range(2), pytest.param(range(2, 100), marks=pytest.mark.soak)], ids=["2", "98"])
def test_the_bound_holds_while_nothing_steps(name, seeds):
    for seed in seeds:
        known, online = exchanged(seed, replace(CHANGES[name], steps=0)), OnlineClock()
        for k, row in enumerate(sorted(known.rows.tolist(), key=lambda row: row[1])):
            online.add(*row)
            if k % 7 == 6:
                found = online.estimate()
                error = found.offset_ns + 1000 * found.device_us - HOST_NS - known.truth_ns(np.array(found.device_us))
                assert abs(error) <= found.bound_ns, (seed, found)


def test_a_restart_forgets_what_was_before():
    rng = np.random.default_rng(2)
    before = in_order(exchanges(rng, True_(20.0), duration_s=20.0))
    after = [e._replace(t1_us=e.t1_us - 5_000_000_000, t2_us=e.t2_us - 5_000_000_000) for e in before]
    later = [e._replace(t0_ns=e.t0_ns + 10**11, t3_ns=e.t3_ns + 10**11) for e in after]
    found = run(before + later)
    assert found[len(before) + 1] is None
    assert found[-1].exchanges == len(later)
    assert found[-1].offset_ns == pytest.approx(10**11, abs=1e6)


def test_it_forgets_and_is_cheap_enough_to_be_asked_four_times_a_second():
    rng = np.random.default_rng(3)
    every = in_order(exchanges(rng, True_(20.0), duration_s=150.0))
    online = OnlineClock()
    for exchange in every:
        online.add(*exchange)
    assert online.estimate().exchanges <= MOST_EXCHANGES
    assert online.estimate().exchanges == pytest.approx(240, abs=12)  # 60 s at a mean rate of 4 Hz
    start = time.process_time()
    for _ in range(10):
        online.estimate()
    assert time.process_time() - start < 10 * 0.05  # a fifth of a quarter second, on any machine


def test_nothing_usable_is_no_estimate():
    online = OnlineClock()
    assert online.estimate() is None
    for k in range(4):
        online.add(100 * k + 50, k, k, 100 * k)  # answered before it was asked
    assert online.estimate() is None
