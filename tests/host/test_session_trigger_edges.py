"""Edges of a trigger wire compared with the truth: always within the bound, about 1/n of a cycle wide; inconsistent
edges are left out and counted.
"""

import itertools
import json

import numpy as np
import pytest
from session_stream import columns_of

from truearm.clocks import fit
from truearm.session.clock import EdgeReport, RobotClock, fit_clock
from truearm.session.joint_format import NO_INPUTS, parse_lines
from truearm.session.joint_readings import InputTrack, JointReader
from truearm.session.trigger_edges import EDGE, fit_edges, match, with_edges
from truearm.types import Message

CYCLE_S = 0.002
BOOT_S = 5.0  # device time at true time 0
DEVICE_PPM = 20.0
LATENCY_S = 300e-6


class Controller:
    """A controller's clock: rate [ppm] and drift [ppm a minute]; it reads 100 s at true time 0."""

    def __init__(self, ppm=-30.0, ppm_per_minute=0.0):
        self.rate, self.drift = 1e-6 * ppm, 1e-6 / 60.0 * ppm_per_minute

    def reading(self, t):
        return 100.0 + t * (1.0 + self.rate) + 0.5 * self.drift * t * t

    def true(self, c):
        t = c - 100.0
        for _ in range(6):
            t = t - (self.reading(t) - c)
        return t


def finished(reader, messages):
    reader.take(columns_of(messages))
    return reader.finish()


def device_us(t):
    return 1e6 * (BOOT_S + t * (1.0 + 1e-6 * DEVICE_PPM))


def edges_at(rng, n, least=0.3, most=1.3):
    return 2.0 + np.cumsum(rng.uniform(least, most, n))


def errors(seed, n, controller, between=(0.3, 1.3), delays=(0.0, 0.0)):
    """Errors and bounds [µs] of host time at 500 controller times among n edges.

    ``delays`` [s] of the input: of rising and falling edges.
    """
    rng = np.random.default_rng(seed)
    t = edges_at(rng, n, *between)
    rising = np.arange(n) % 2 == 0
    tick = np.floor(controller.reading(t + np.where(rising, *delays)) / CYCLE_S)
    edges = np.zeros(n, EDGE)
    edges["host_ns"], edges["rising"] = 1000 * np.floor(1e6 * t), rising
    arrivals = RobotClock(100.0, fit(np.array([0, 10**11]), np.array([0, 10**11])), np.array([100.0]), np.zeros(1))
    span_s = tuple(controller.reading(t[[0, -1]]))
    readings_s = tick * CYCLE_S, (tick + 1) * CYCLE_S
    clock, report = fit_edges(EdgeReport(0, False, n, 0, 0, 0), arrivals, edges, *readings_s, span_s)
    assert (report.used, report.rejected) == (n, 0)
    assert report.falling_later_ns[0] <= 1e9 * (delays[1] - delays[0]) <= report.falling_later_ns[1]
    at = np.linspace(*span_s, 500)
    return 1e-3 * (clock.to_host_ns(at) - 1e9 * controller.true(at)), 1e-3 * clock.bound_at(at)


@pytest.mark.parametrize("seeds", [20, pytest.param(100, marks=pytest.mark.soak)])
def test_a_hundred_edges_at_a_cycle_of_2_ms(seeds):
    """80 s of edges leave a rate open by a few ppm, which is some 100 µs at the ends; a cycle's fiftieth is 40 µs."""
    worst, square = [], []
    for seed in range(seeds):
        error, bound = errors(seed, 100, Controller())
        assert np.all(np.abs(error) <= bound)
        worst.append(np.max(np.abs(error)))
        square.append(np.mean(np.square(error)))
    assert np.max(worst) < 0.2e6 * CYCLE_S
    assert np.sqrt(np.mean(square)) < 0.06e6 * CYCLE_S


DELAYS = [(5e-6, 150e-6), (150e-6, 5e-6), (10e-6, 300e-6), (300e-6, 10e-6), (15e-6, 18e-6)]


# --- which edge is which


def track_of(times, bits):
    track = InputTrack()
    for part in np.array_split(np.arange(len(times)), 3):  # as lines come, in pieces
        track.add(times[part], bits[part])
    return track


def level_at(t, edges):
    return np.searchsorted(edges, t, side="right") % 2


def test_changes_are_told_between_readings_whatever_the_pieces():
    t = np.arange(0.0, 1.0, 0.1)
    bits = np.array([0, 0, 4, 4, NO_INPUTS, 0, 8, 8, 12, 12])
    track = track_of(t, bits)
    assert track.inputs() == [2, 3]
    of_2, of_3 = track.changes(2), track.changes(3)
    assert of_2.level.tolist() == [True, False, True]
    assert of_2.before_s == pytest.approx([0.1, 0.3, 0.7])
    assert of_2.after_s == pytest.approx([0.2, 0.5, 0.8])  # a reading that says nothing widens it
    assert (of_3.before_s[0], of_3.after_s[0]) == pytest.approx((0.5, 0.6))
    assert track.changes(0).level.size == 0


@pytest.mark.parametrize("value", [None, -1, 2**63, 2**200, True, 1.0, "3", [1]])
def test_inputs_that_are_none(value):
    line = json.dumps({"t": 1.5, "q": [0.1], "inputs": value}).encode()
    assert "inputs" not in parse_lines([line], [0]).columns


def pairing(edges, readings, level, late_s=0.004):
    """The pairing of edges with what readings show; arrivals make them expected late."""
    track = track_of(readings, level.astype(np.int64))
    return match(edges + late_s, np.arange(edges.size) % 2 == 0, track.changes(0)), track.changes(0)


def test_bounces_missing_readings_and_changes_that_nobody_made():
    """What cannot be told is left out and counted, and costs no other edge."""
    edges, readings = edges_at(np.random.default_rng(2), 60, least=0.8), np.arange(0.0, 75.0, CYCLE_S)
    level = level_at(readings, edges)
    # A relay's contact opens once more 3 ms after an edge: three changes where one edge was.
    bounced = (readings > edges[20] + 0.003) & (readings < edges[20] + 0.006)
    found, _ = pairing(edges, readings, np.where(bounced, 1 - level, level))
    assert np.flatnonzero(found.change < 0).tolist() == [20]
    assert (found.unclear, found.unseen, found.stray) == (4, 0, 0)  # the edge and three changes
    alone = np.abs(readings - 0.5 * (edges[40] + edges[41])) < 0.01
    found, _ = pairing(edges, readings, np.where(alone, 1 - level, level))
    assert (found.stray, np.sum(found.change < 0)) == (2, 0)
    # Two edges in a gap: nothing changed. One: its bounds are wide, and true. Three: one change, which could be either.
    keep = np.ones(readings.size, bool)
    for first, last in ((10, 11), (20, 20), (30, 32)):
        keep &= ~((readings > edges[first] - 0.02) & (readings < edges[last] + 0.02))
    found, changes = pairing(edges, readings[keep], level[keep])
    assert np.flatnonzero(found.change < 0).tolist() == [10, 11, 30, 31, 32]
    assert (found.unseen, found.unclear) == (2, 4)
    assert changes.before_s[found.change[20]] <= edges[20] <= changes.after_s[found.change[20]]


# --- through readings, arrivals and exchanges


def session(
    seed,
    n=100,
    number=3,
    noisy=None,
    controller=None,
    wrong=None,
    between=(0.3, 1.3),
    delays=(0.0, 0.0),
    inverted=False,
):
    """What readings of 80 s say, tied to the box. ``noisy``: another input that toggles by itself. ``wrong``: µs that a stamp is off.

    ``delays`` [s] of the input: of rising and falling edges. ``inverted``: it is on while the output is low.
    """
    rng = np.random.default_rng(seed)
    controller = controller or Controller()
    edges = edges_at(rng, n, *between)
    end = edges[-1] + 2.0
    reader, messages = JointReader(), []
    ticks = np.arange(int(100.0 / CYCLE_S) + 1, int(controller.reading(end) / CYCLE_S)) * CYCLE_S
    t = controller.true(ticks)
    bits = (level_at(t, edges + np.where(np.arange(n) % 2 == 0, *delays)) ^ inverted) << number
    if noisy is not None:
        bits = bits | (level_at(t, edges_at(rng, 2 * n, 0.1, 0.5)) << noisy)
    arrival = np.maximum.accumulate(t + LATENCY_S + rng.exponential(200e-6, t.size))
    for c, bit, a in zip(ticks.tolist(), bits.tolist(), arrival.tolist(), strict=True):
        messages.append(Message("/robot/joints", int(1e9 * a), b'{"t":%.6f,"q":[0.0],"inputs":%d}' % (c, bit)))
    exchanges = []
    for t0 in np.arange(0.0, end, 0.25):
        t1 = t0 + 125e-6 + rng.exponential(80e-6)
        t3 = t1 + 155e-6 + rng.exponential(120e-6)
        exchanges.append((int(1e9 * t0), int(device_us(t1)), int(device_us(t1 + 5e-6)), int(1e9 * t3) + 1))
    stamps = device_us(edges).astype(np.int64)
    for k, off in (wrong or {}).items():
        stamps[k] += off
    output = [*zip(itertools.repeat(0), stamps.tolist(), itertools.cycle((True, False)))]
    joints = with_edges(finished(reader, messages), output, {0: fit_clock(0, exchanges)[0]})
    return joints, controller, t


def check(joints, controller, t):
    (clock,) = joints.clocks
    assert joints.reports[0].edges.in_use
    c = controller.reading(t[::50])
    error = clock.to_host_ns(c) - 1e9 * t[::50]
    assert np.all(np.abs(error) <= clock.bound_at(c))
    return joints.reports[0].edges


def test_the_input_that_follows_is_found_and_contradictions_rejected():
    report = check(*session(5, number=7, noisy=2))
    assert (report.input, report.used, report.edges) == (7, 100, 100)
    assert report.shortest_latency_ns == pytest.approx(1e9 * LATENCY_S, abs=report.bound_ns)
    # A stamp that is 30 ms off is within what arrivals leave open, and beyond every bound.
    report = check(*session(6, wrong={50: 30_000}))
    assert (report.used, report.rejected) == (99, 1)


def regular(step_s, levels, edges):
    """Readings every ``step_s`` of an input with these levels, tied to a box whose output has these edges [s]."""
    times = step_s * np.arange(len(levels))
    lines = [b'{"t":%.3f,"q":[0.0],"inputs":%d}' % row for row in zip(times, levels, strict=True)]
    messages = [Message("/robot/joints", int(1e9 * t), line) for t, line in zip(times, lines, strict=True)]
    t_ns = np.arange(0, int(1e9 * times[-1]), 250_000_000)
    exchanges = np.stack([t_ns, t_ns // 1000 + 50, t_ns // 1000 + 55, t_ns + 200_000], axis=1)
    output = [*zip(itertools.repeat(0), (1e6 * edges).astype(int).tolist(), itertools.cycle((True, False)))]
    joints = with_edges(finished(JointReader(), messages), output, {0: fit_clock(0, exchanges)[0]})
    assert not joints.reports[0].edges.in_use
    return joints.reports[0].edges


def test_no_input_that_follows_is_said():
    """The output is not wired; another input toggles by itself."""
    joints, *_ = session(7, number=62, noisy=2)
    assert joints.reports[0].edges.input == 62
    silent = with_edges(joints, [(0, 6_000_000, True), (0, 7_000_000, False), (0, 8_000_000, True)], {})
    assert silent is joints  # of a box whose clock is not known
    report = regular(0.01, np.arange(5000) // 37 % 2, edges_at(np.random.default_rng(8), 40))
    assert report.input is None
    assert report.unseen == report.edges > 30


def test_slow_readings_leave_the_clock_to_arrivals():
    """Ten readings a second and few edges bound nothing better than some milliseconds."""
    edges = edges_at(np.random.default_rng(9), 12)
    assert regular(0.1, level_at(0.1 * np.arange(150), edges), edges).used > 0


@pytest.mark.parametrize("inverted", [False, True], ids=["as-is", "inverted"])
@pytest.mark.parametrize("delays", DELAYS[:4])
def test_inputs_of_either_polarity_with_unequal_delays(delays, inverted):
    """PNP and NPN inputs, couplers that switch on and off at different speed: the clock is within its bound, and what differs is said."""
    report = check(*session(11, n=600, number=5, noisy=2, between=(0.05, 0.15), delays=delays, inverted=inverted))
    assert (report.input, report.inverted, report.used, report.rejected) == (5, inverted, 600, 0)
    least, most = report.falling_later_ns
    assert least <= 1e9 * (delays[1] - delays[0]) <= most
    assert (least > 0.0) == (delays[1] > delays[0])  # told, not only allowed


def test_an_input_that_toggles_by_itself_is_none_of_either_polarity():
    """Twenty inputs that have nothing to do with the output, in turn; half of the edges would have to fit one of them by chance."""
    readings, rising = np.arange(0.0, 30.0, CYCLE_S), np.arange(300) % 2 == 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        edges, others = (edges_at(rng, 300, 0.05, 0.15) for _ in range(2))
        changes = track_of(readings, level_at(readings, others)).changes(0)
        assert all(np.sum(match(edges, level, changes).change >= 0) < 120 for level in (rising, ~rising))
