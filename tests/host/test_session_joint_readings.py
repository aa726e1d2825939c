"""Joint readings: parsing, accounting, the robot's clock, and the bins that dwells are found in."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from session_stream import columns_of

from truearm.session import joint_readings as joints_module
from truearm.session.dwells import find_dwells
from truearm.session.joint_readings import JointReader
from truearm.types import Message


def message(t, seq, q, arrival_ns=None):
    line = json.dumps({"t": t, "seq": seq, "q": list(q)}).encode()
    return Message("/robot/joints", round(1e9 * t) if arrival_ns is None else arrival_ns, line)


def read(messages):
    reader = JointReader()
    reader.take(columns_of(messages))
    return reader.finish()


def arrived(messages):
    """Messages that arrived in this order: the host's clock never steps back."""
    latest = np.maximum.accumulate([m.t_host_ns for m in messages]).tolist()
    return [m._replace(t_host_ns=at) for m, at in zip(messages, latest, strict=True)]


def joints_of(stream):
    return stream.bins.joints(0, len(stream.bins))


def still(n=500, t0=10.0, hz=125.0, q=(0.1, -0.2)):
    return [message(t0 + k / hz, k, q) for k in range(n)]


def test_a_clean_stream():
    stream = read(still())
    assert (stream.readings, stream.lost, stream.duplicated, stream.late, stream.malformed) == (500, 0, 0, 0, 0)
    assert (stream.gaps, stream.restarts) == (0, 0)
    assert stream.rate_hz == pytest.approx(125.0, abs=1e-9)
    assert stream.bins.times.n.sum() == 500
    assert np.allclose(joints_of(stream).mean, (0.1, -0.2), atol=1e-15)
    assert list(np.flatnonzero(stream.bins.times.gap)) == [0]


def unnumbered(messages):
    rows = [{k: v for k, v in json.loads(m.data).items() if k != "seq"} for m in messages]
    return [m._replace(data=json.dumps(row).encode()) for m, row in zip(messages, rows, strict=True)]


@pytest.mark.parametrize("stranger", [[], [Message("/robot/joints", 0, b"nonsense")]])
def test_readings_without_numbers_are_as_good(stranger):
    """Together (the quick way) and beside a line that forces the careful way; what was lost is not known then."""
    lines = still()
    lines.insert(300, lines[299])  # doubled
    late = lines.pop(200)
    lines.insert(202, late)
    lines = arrived(lines)
    numbered, plain = read(lines), read(unnumbered(lines) + stranger)
    assert (numbered.lost, plain.lost) == (1, None)
    for name in ("readings", "duplicated", "late", "gaps", "rate_hz"):
        assert getattr(plain, name) == getattr(numbered, name)
    assert np.array_equal(joints_of(plain).mean, joints_of(numbered).mean)
    assert plain.malformed == len(stranger)


def test_no_readings_and_numbers_that_come_and_go():
    lines = still()
    lines[100:200] = unnumbered(lines[100:200])
    stream = read(lines)
    assert (stream.readings, stream.lost) == (500, None)
    stream = read([])
    assert len(stream.bins) == 0
    assert find_dwells(stream) == []


@pytest.mark.parametrize("chunk", [1, 7, 100])
def test_chunks_change_nothing(chunk, monkeypatch):
    rng = np.random.default_rng(1)
    lines = [message(10.0 + k / 125.0, k, rng.normal(0, 1e-5, 2)) for k in range(700)]
    lines[300:300] = [lines[299]]
    del lines[500:560]
    whole = read(lines)
    monkeypatch.setattr(joints_module, "CHUNK", chunk)
    # the period, and with it the bins, are taken from the first chunk; a chunk of one has none and gets the default
    parts = read(lines)
    for name in ("readings", "lost", "duplicated", "gaps", "rate_hz"):
        assert getattr(parts, name) == getattr(whole, name)
    for name in ("t_first_s", "n", "gap"):
        assert np.array_equal(getattr(parts.bins.times, name), getattr(whole.bins.times, name))
    for name in ("below", "above"):
        assert np.array_equal(getattr(joints_of(parts), name), getattr(joints_of(whole), name))
    assert np.allclose(joints_of(parts).scatter, joints_of(whole).scatter, rtol=1e-6, atol=0)
    assert repr(parts.reports) == repr(whole.reports)  # NaN is not equal to itself


def test_bins_hold_the_scatter_of_the_readings():
    rng = np.random.default_rng(2)
    q = 2.0 + rng.normal(0, 1e-4, (400, 3)) @ np.array([[1, 0.5, 0], [0, 1, 0], [0, 0, 2]])
    (dwell,) = find_dwells(read([message(k / 125.0, k, row) for k, row in enumerate(q)]))
    q = q[400 - dwell.n_readings :]
    assert dwell.n_readings > 350
    assert np.allclose(dwell.q, q.mean(axis=0), atol=1e-14)
    # single precision of the bins' scatter: 6e-8 of the variances, and the smallest step seen, next to nothing
    assert np.allclose(dwell.q_var, np.var(q, axis=0, ddof=1), rtol=1e-4, atol=1e-14)


def test_losses_of_the_robot_are_counted_apart():
    lines = still()
    late = lines.pop(200)
    lines.insert(202, late)  # a datagram overtaken by two others
    lines.insert(300, lines[299])  # doubled
    del lines[400:403]  # lost
    lines += [Message("/robot/joints", 0, b"{}"), Message("/robot/joints", 0, b"nonsense")]
    stream = read(arrived(lines))
    assert (stream.late, stream.duplicated, stream.lost, stream.malformed) == (1, 1, 4, 2)
    assert stream.readings == 496
    # It is not used. Time steps back by half a second; seq runs on.
    lines = still()
    lines[100] = message(10.0 + 100 / 125.0 - 0.5, 100, (0.1, -0.2))
    stream = read(arrived(lines))
    assert (stream.late, stream.lost, stream.readings) == (1, 1, 499)


def test_times_that_are_none_are_no_thousand_restarts(monkeypatch):
    """A source whose times jump at random: after the last segment, what lies behind the latest time is late."""
    monkeypatch.setattr(joints_module, "MOST_SEGMENTS", 20)
    monkeypatch.setattr(joints_module, "CHUNK", 50)
    times = np.random.default_rng(1).uniform(0.0, 1e6, 400).tolist()
    reader = JointReader()
    for k, t in enumerate(times):
        reader.take(columns_of([message(t, k, (0.1, -0.2), arrival_ns=10**7 * k)]))
    stream = reader.finish()
    assert (len(stream.clocks), stream.restarts, stream.readings + stream.late) == (20, 19, 400)


def test_controller_restart_is_another_segment():
    stream = read(still(t0=500.0) + [m._replace(t_host_ns=m.t_host_ns + 510 * 10**9) for m in still(t0=1.0)])
    assert stream.restarts == 1
    assert len(stream.clocks) == 2
    dwells = find_dwells(stream)
    assert [dwell.segment for dwell in dwells] == [0, 1]
    assert [len(set(stream.bins.times.segment[a:b])) for a, b in ((0, 79), (81, 160))] == [1, 1]


def assert_same(one, other):
    assert one.columns.keys() == other.columns.keys()
    for name in ("arrival_ns", "t", "seq", "q"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), strict=True)
    for key, values in one.columns.items():
        np.testing.assert_array_equal(values, other.columns[key], strict=True)


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(st.floats(0, 4e9, exclude_max=True), st.integers(-9, 9)), max_size=30))
def test_arbitrary_times_end_in_a_result(rows):
    messages = [message(t, seq, (0.0, 1.0), arrival_ns=k) for k, (t, seq) in enumerate(rows)]
    stream = read(messages)
    assert stream.readings + stream.late + stream.duplicated == len(rows)
    assert stream.lost >= 0
    find_dwells(stream)


def test_quantisation_is_seen_although_the_robot_moves_fast():
    step = 9.6e-5
    path = np.interp(np.arange(600) / 125.0, [0, 1, 2.3, 5], [0.0, 0.0, 1.37, 1.37])
    stream = read([message(k / 125.0, k, [step * np.rint(x / step)]) for k, x in enumerate(path)])
    assert stream.step[0] == pytest.approx(step, rel=1e-9)


def test_robot_clock_follows_the_fastest_packets():
    """The fastest of 250 packets a second is late by 1.6 µs on average, and the estimate is no later.

    The rate may change by 1 ppm from one second to the next, so the estimate can follow the quicker ones of the seconds
    around, but not the quickest of a minute (0.03 µs).
    """
    rng = np.random.default_rng(4)
    floor, tail, hz, rate = 350e3, 400e3, 250.0, 45e-6
    t = 7000.0 + np.arange(int(200 * hz)) / hz
    sent = 3e15 + 1e9 * (t - 7000.0) * (1.0 + rate)
    queued = (rng.random(t.size) < 0.02) * rng.pareto(1.2, t.size) * 2e6
    arrival = np.maximum.accumulate(sent + floor + rng.exponential(tail, t.size) + queued).astype(np.int64)
    stream = read([message(a, k, (0.0,), int(b)) for k, (a, b) in enumerate(zip(t, arrival, strict=True))])
    (report,) = stream.reports
    error = stream.clocks[0].to_host_ns(t[::50]) - (sent[::50] + floor)
    assert np.all(np.abs(error) <= stream.clocks[0].bound_at(t[::50]))
    assert error.min() > -50.0  # it lies under no packet
    assert np.mean(error) < tail / hz
    assert report.rate_ppm == pytest.approx(45.0, abs=0.03)
    half = np.floor((t - 7000.0) / 30.0)
    means = [np.mean((arrival - sent - floor)[half == k]) for k in np.unique(half)]
    assert report.jitter_ns == pytest.approx(np.median(means), abs=5000.0)


def test_robot_clock_of_one_reading():
    stream = read([message(5.0, 0, (0.0,), 10**15)])
    assert stream.clocks[0].to_host_ns(np.array([5.0, 6.0])) - 10**15 == pytest.approx([0, 10**9], abs=1000)  # 1 ppm


@pytest.mark.parametrize("digits", [6, 7, 9, 12])
def test_rounding_of_what_is_printed_is_no_step(digits):
    """An encoder's step of 4.8e-5, printed with few digits; the robot slows down before it stands."""
    step = 2 * np.pi / 2**17
    t = np.arange(600) / 125.0
    path = 0.7 * (1 - np.cos(np.pi * np.clip(t - 1, 0, 2) / 2)) + 4e-6 * np.sin(40 * t)
    stream = read([message(s, k, [round(step * np.rint(x / step), digits)]) for k, (s, x) in enumerate(zip(t, path))])
    assert stream.step[0] == pytest.approx(step, abs=1.01 * 10.0**-digits)


class TestCommandedJoints:
    @staticmethod
    def rows(*q_cmd):
        rows = [{"t": 10.0 + k / 125.0, "seq": k, "q": [0.1, -0.2]} for k in range(len(q_cmd))]
        lines = [json.dumps(row | ({} if q is None else {"q_cmd": q})) for row, q in zip(rows, q_cmd, strict=True)]
        return [Message("/robot/joints", 8_000_000 * k, line.encode()) for k, line in enumerate(lines)]

    def test_they_are_kept_apart_from_the_measured(self):
        """250 readings at 125 Hz; the command leads by 0.01 rad: a mean that mixed the two would be off by half of it."""
        stream = read(self.rows(*[[0.11, -0.21]] * 250))
        assert np.allclose(joints_of(stream).mean, (0.1, -0.2), atol=1e-15)
        (dwell,) = find_dwells(stream)
        assert np.allclose(dwell.q, (0.1, -0.2), atol=1e-15)
