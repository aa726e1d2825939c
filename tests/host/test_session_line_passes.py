"""Lines in motion compared with the truth: each row has the right time, and none spans missing data."""

import json
from dataclasses import replace
from functools import cache
from itertools import chain

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from line_stream import MAGNET, STEP, LineBox, line_session, some_lines, true_params
from session_stream import PERIOD_NS, renumber, stream_of

from truearm.errors import RigError
from truearm.report.session_findings import REJECTED
from truearm.session.line_passes import MISSED, find_legs, fit_locally
from truearm.session.observations import observations, survey
from truearm.types import Device, Point, Rig

LATENCY_S = 0.4e-3  # shortest of the robot's link: it stays in the joints' time, as part of τ
RIG = Rig(targets={"magnet": Point("magnet", tuple(MAGNET))})


def synced(messages, rig=RIG, **options):
    return observations(survey(stream_of(messages)), rig, **options)


@pytest.fixture(scope="module")
def lines():
    return some_lines(np.random.default_rng(1), 2, 0.25)


@pytest.fixture(scope="module")
def clean(lines):
    rng = np.random.default_rng(2)
    return line_session(rng, lines, true_params(rng))


@pytest.fixture(scope="module")
def found(clean):
    return synced(clean.messages, name="s.mcap")


def windows(one):
    """Return begin and end [ns, host] of the data that each row was made from."""
    return 1e9 * one.table.time - one.window_ns, 1e9 * one.table.time + one.window_ns


def test_a_leg_for_each_way_of_each_line(clean):
    legs = find_legs(survey(stream_of(clean.messages)).joints)
    for start, end, *_ in clean.truth.legs:
        near = [
            leg for leg in legs if abs(leg.start_s - 1000.0 - start) < 0.15 and abs(leg.end_s - 1000.0 - end) < 0.15
        ]
        assert len(near) == 1
        assert not near[0].cut


def test_every_pass_is_its_line_and_direction(found, clean):
    assert found.pass_reasons == {}
    assert [(one.mounted["line"], one.direction) for one in found.passes] == [
        ("l1", 1),
        ("l1", -1),
        ("l2", 1),
        ("l2", -1),
    ]
    assert [one.pose for one in found.passes] == [1, 2, 4, 5]
    table = found.table
    assert set(table.kind) == {"line"}
    assert set(table.shell) == {"l1-up", "l1-down", "l2-up", "l2-down"}
    assert set(table.target) == {"magnet"}
    assert table.source[0] == "s.mcap pass 1.1"
    assert len(table) == sum(len(one.table.xyz) for one in found.passes) >= 4 * 18
    assert found.samples_used == sum(one.n_samples for one in found.passes)
    for one in found.passes:
        assert one.speed == pytest.approx(0.1, rel=0.01)


def test_rows_are_the_truth_within_their_sigma(found, clean):
    """(measured − true) over the row's own sigma: the clock's share of it is a bound, so the squares' mean is below 1, and that
    of the transverse axes, where hardly any speed is, near it: 300 values of unknown scale, ± 5·sqrt(2/300)."""
    z = np.concatenate(
        [
            (one.table.xyz - clean.truth.xyz(one.table.time)) / one.table.xyz_sigma
            for one in found.passes
            if not one.reason
        ]
    )
    assert np.mean(z[:, 1] ** 2) < 1.0
    assert abs(np.mean(z[:, [0, 2]] ** 2) - 1.0) < 5.0 * np.sqrt(2.0 / 300.0)


def test_joints_are_those_of_the_instant_and_so_are_their_rates(found, clean):
    """Readings are quantised, σ = STEP/√12; of a joint that hardly moves all are off alike, and no mean of them is better.
    The bound of the interpolation holds for every one, with 10 µs for the joints' clock (it is 2 µs off)."""
    truth = clean.truth
    for one in found.passes:
        t = one.table.time - LATENCY_S
        error = one.table.q - truth.q(t)
        by_clock = 10e-6 * np.abs(one.table.q_rate)
        assert np.all(np.abs(error) < one.q_error + by_clock)
        assert one.q_error < 2.0 * STEP
        assert np.all(np.sqrt(np.mean(error**2, axis=0)) < np.sqrt(3.0) * one.q_noise)  # half a step
        rate = (truth.q(t + 1e-3) - truth.q(t - 1e-3)) / 2e-3
        assert np.max(np.abs(one.table.q_rate - rate)) < 1e-3  # of some 0.1 rad/s


def test_without_a_plan_the_events_say_which_line(lines, clean):
    rng = np.random.default_rng(2)
    made = line_session(rng, lines, true_params(rng), plan=False)
    result = synced(made.messages)
    assert [(one.mounted["line"], one.direction, one.reason) for one in result.passes] == [
        *(("l1", 1, ""), ("l1", -1, "")),
        *(("l2", 1, ""), ("l2", -1, "")),
    ]
    silent = [m for m in clean.messages if m.topic not in ("/plan", "/events")]
    result = synced(silent)
    assert (result.passes, len(result.table)) == ((), 0)


def test_a_recording_that_ends_before_the_first_motion(clean):
    """Or whose robot was never connected."""
    result = synced([m for m in clean.messages if not m.topic.startswith("/robot/")])
    assert (result.passes, len(result.table)) == ((), 0)


def test_a_line_that_the_rig_has_not(clean):
    with pytest.raises(RigError, match="names line 'l1', which"):
        synced(clean.messages, replace(RIG, lines={"other": Device("other", tuple(map(tuple, 1e-8 * np.eye(3))))}))
    with pytest.raises(RigError, match="names target 'magnet', which"):
        synced(clean.messages, Rig())


def test_as_many_points_as_wanted(clean, found):
    result = synced(clean.messages, line_points=7)
    assert [len(one.table.xyz) for one in result.passes] == [7] * 4
    most = synced(clean.messages, line_points=10_000)
    for one in (*found.passes, *most.passes):
        begin, end = windows(one)
        assert np.all(begin[1:] > end[:-1] - 2 * PERIOD_NS)  # rows are snapped to interrogations


# ---------------------------------------------------------------------------------------------- what is missing


# a window may end a fifth of a period of 8 ms beyond a reading that is missing, and uses none beyond
EDGE_NS = 2_000_000


def host_ns_of(reading):
    """Return the time of a reading on the host's clock, including the link's shortest latency."""
    return 1e9 * ((json.loads(reading.data)["t"] - 1000.0) / (1.0 - 20e-6) + LATENCY_S)


def middle_of(clean, leg=0):
    start, end, *_ = clean.truth.legs[leg]
    return int(1e9 * 0.5 * (start + end))


def assert_clear(one, begin_ns, end_ns):
    """No row was made of a time that touches the missing one, and rows stand on both sides of it."""
    begin, end = windows(one)
    assert np.all((end < begin_ns) | (begin > end_ns))
    assert np.any(end < begin_ns)
    assert np.any(begin > end_ns)


@pytest.mark.parametrize("lost", [1, 5, 60])
def test_no_row_across_lost_readings(clean, found, lost):
    at = middle_of(clean)
    readings = [i for i, m in enumerate(clean.messages) if m.topic == "/robot/joints"]
    gone = [i for i in readings if clean.messages[i].t_host_ns >= at][:lost]
    first, last = (host_ns_of(clean.messages[i]) for i in (gone[0], gone[-1]))
    result = synced([m for i, m in enumerate(clean.messages) if i not in gone])
    one = result.passes[0]
    assert one.reason == ""
    assert_clear(one, first + EDGE_NS, last - EDGE_NS)
    assert one.dropped["gap"] >= 1
    assert len(one.table.xyz) < len(found.passes[0].table.xyz)
    assert np.array_equal(result.passes[1].table.xyz, found.passes[1].table.xyz)


@pytest.mark.parametrize("topic", ["/box/mag", "/box/adc"])
def test_no_row_across_a_lost_block(clean, found, topic):
    at = middle_of(clean)
    gone = next(i for i, m in enumerate(clean.messages) if m.topic == topic and m.t_host_ns >= at)
    n = {"/box/mag": 52, "/box/adc": 13}[topic]
    end_ns = clean.messages[gone].t_host_ns - 300_000 - (1_500_000 if topic == "/box/adc" else 0)
    result = synced([m for i, m in enumerate(clean.messages) if i != gone])
    assert (result.survey.losses.frames_lost, result.survey.losses.samples_lost) == (1, n)
    assert result.passes[0].reason == ""
    # The last sample of the block lies one period before its end; a microsecond is the stamps'.
    assert_clear(result.passes[0], end_ns - n * PERIOD_NS + 2_000, end_ns - PERIOD_NS - 2_000)


def test_no_row_across_a_restart_of_the_controller(clean):
    """Its time begins again inside the first pass: the halves are not lines of the plan, and without a plan two passes."""
    at = middle_of(clean)
    restarted = []
    for m in clean.messages:
        if m.topic == "/robot/joints" and m.t_host_ns >= at:
            line = json.loads(m.data)
            m = m._replace(data=json.dumps(line | {"t": line["t"] - 1000.0, "seq": line["seq"]}).encode())
        restarted.append(m)
    result = synced(restarted)
    assert result.survey.joints.restarts == 1
    assert [one.reason for one in result.passes] == ["", "", ""]
    words = json.dumps({"kind": "mounted", "line": "l1", "target": "magnet"}).encode()
    unplanned = [m for m in restarted if m.topic != "/plan"]
    said = unplanned[0]._replace(topic="/events", t_host_ns=0, data=words)
    result = synced([said, *unplanned])
    first, second = result.passes[:2]
    assert (first.reason, second.reason) == ("", "")
    assert first.leg.segment != second.leg.segment
    assert np.all(windows(first)[1] < at)
    assert np.all(windows(second)[0] > at - 3_000_000)


def test_no_row_across_a_restart_of_the_box(clean):
    """Another boot inside a pass: each half is placed by its own clock, and no row is made of both."""
    at = middle_of(clean)
    truth = clean.truth
    box = LineBox(ppm=-44.0, boot_host_ns=at, boot_id=99)
    box.ident(at + 10)
    begin = at + 50_000_000
    for t in range(begin, clean.end_ns, 250_000_000):
        box.sync(t, 95e3, 95e3)
    times = np.arange(begin, clean.end_ns, PERIOD_NS)
    ticks = np.nan_to_num(np.floor(truth.xyz(1e-9 * times)[:, 1] / (25400.0 / 9.05) / 8e-9)).astype(np.int64)
    aside = np.zeros((times.size, 4), np.int64)
    aside[:, 1:3] = np.nan_to_num(truth.xyz(1e-9 * (times - 1_500_000))[:, [0, 2]] / 0.02 / 143e-9)
    for k in range(0, times.size - 52, 52):
        box.flights(int(times[k]), ticks[k : k + 52])
        for i in range(k, k + 52, 13):
            box.data(int(times[i]), aside[i : i + 13])
    new = renumber([box.messages[0], *sorted(box.messages[1:], key=lambda m: m.t_host_ns)])
    old = [m for m in clean.messages if m.t_host_ns < at or not (m.topic.startswith("/box") or m.topic == "/sync")]
    result = synced(sorted(old + new, key=lambda m: m.t_host_ns))
    assert result.survey.losses.restarts == 1
    assert [one.reason for one in result.passes] == [""] * 4
    assert_clear(result.passes[0], at - 40_000_000, begin - 3_000_000)  # the last whole blocks before, the first after
    error = np.concatenate([one.table.xyz - truth.xyz(one.table.time) for one in result.passes])
    assert np.max(np.abs(error)) < 40e-6


def test_passes_that_give_no_rows_say_why(lines, clean):
    # Some are missing: rows are made of the others. Most are: the pass says so.
    few = synced(line_session(np.random.default_rng(3), lines[:1], lost_stops=0.05).messages)
    assert few.pass_reasons == {}
    many = synced(line_session(np.random.default_rng(3), lines[:1], lost_stops=0.5).messages)
    assert many.pass_reasons == {"no stop pulses": 2}
    assert len(many.table) == 0
    # The magnet is farther to the side than the transducers can measure.
    railed = line_session(
        np.random.default_rng(3), [replace(clean.truth.lines[0], origin=clean.truth.lines[0].origin - 0.05)]
    )
    assert synced(railed.messages).pass_reasons == {"out of range": 2}
    # The head sees a magnet that stands: it is not on the robot.
    still = []
    for m in clean.messages:
        if m.topic == "/box/mag":
            at = m.data.rindex(b"\xd8\x4e\x58") + 4
            n = (len(m.data) - at - 1) // 4
            m = m._replace(data=m.data[:at] + np.full(n, 12_000, "<i4").tobytes() + m.data[-1:])
        still.append(m)
    assert synced(still).pass_reasons == {"not along the line": 4}
    assert synced([m for m in clean.messages if m.topic != "/sync"]).pass_reasons == {"no clock": 4}
    assert synced([m for m in clean.messages if m.topic != "/box/mag"]).pass_reasons == {"no samples": 4}


def test_beyond_the_travel_that_the_rig_declares(clean):
    """The true arm leaves its lines by some millimetres: rows are made only where the transducers are believed."""
    widest = np.abs(synced(clean.messages).table.xyz[:, [0, 2]]).max()
    assert synced(clean.messages, replace(RIG, line_travel=2.1 * widest)).pass_reasons == {}
    found = synced(clean.messages, replace(RIG, line_travel=1.6 * widest))
    assert np.abs(found.table.xyz[:, [0, 2]]).max() <= 0.8 * widest
    kept, dropped = (
        [len(one.table.xyz) for one in found.passes],
        [one.dropped.get("out of range", 0) for one in found.passes],
    )
    whole = [len(one.table.xyz) for one in synced(clean.messages).passes]
    assert sum(kept) < sum(whole)
    # every row that is not made is told, but for those whose windows reach across the border
    np.testing.assert_allclose(np.add(kept, dropped), whole, atol=2)


def test_a_pass_that_the_plan_has_not(clean):
    """The operator says that a line is mounted, the plan's second line is another one: what moved along is listed."""
    plan = [m for m in clean.messages if m.topic == "/plan"][:3]
    said = plan[0]._replace(topic="/events", data=json.dumps({"kind": "mounted", "line": "l1"}).encode())
    rest = [m for m in clean.messages if m.topic != "/plan"]
    result = synced([*plan, said, *rest])
    assert [one.reason for one in result.passes[:2]] == ["", ""]
    assert result.pass_reasons["no plan match"] >= 2
    assert set(result.pass_reasons) <= set(chain.from_iterable(REJECTED.values()))


# ---------------------------------------------------------------------------------------------- invariants


@given(
    coefficients=st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4),
    centre=st.floats(0.2, 0.8),
    seed=st.integers(0, 2**31),
)
def test_a_cubic_is_itself_however_it_is_sampled(coefficients, centre, seed):
    t = np.sort(np.random.default_rng(seed).uniform(0.0, 1.0, 200))
    y = np.polynomial.polynomial.polyval(t, coefficients)
    found = fit_locally(t, y[:, None], np.array([centre]), 0.15)
    if found.n[0] < 6:
        assert np.isnan(found.value[0, 0])
        return
    derivative = np.polynomial.polynomial.polyder(coefficients)
    slack = 1e-9 * max(1.0, found.leverage[0])  # a centre that samples lie on one side of is an extrapolation
    assert abs(found.value[0, 0] - np.polynomial.polynomial.polyval(centre, coefficients)) < slack
    assert abs(found.rate[0, 0] - np.polynomial.polynomial.polyval(centre, derivative)) < 100.0 * slack


@given(amplitude=st.floats(0.1, 10.0), phase=st.floats(0.0, 6.3), omega=st.floats(1.0, 5.0))
def test_the_bound_of_the_interpolation_holds(amplitude, phase, omega):
    """A sine of up to 4 rad in the window, densely sampled: more than a robot does in a tenth of a second. Of its even terms
    beyond a cubic the fourth is by far the largest (J₆/J₄ is 0.04 at 2 rad); a tenth allows for the others."""
    t = np.linspace(0.0, 1.0, 1001)
    y = amplitude * np.sin(omega * t + phase)
    found = fit_locally(t, y[:, None], np.array([0.5]), 0.4)
    missed = abs(found.value[0, 0] - amplitude * np.sin(omega * 0.5 + phase))
    odd = amplitude * abs(np.cos(omega * 0.5 + phase))  # an odd remainder is nought in the middle
    assert missed <= 1.1 * MISSED * found.rms[0, 0] + 1e-9 * (amplitude + odd)


@settings(max_examples=8, deadline=None)
@given(data=st.data())
def test_any_readings_and_blocks_may_be_missing(data):
    """Whatever is taken away, rows lie clear of it."""
    messages = short_session()
    usable = [i for i, m in enumerate(messages) if m.topic in ("/robot/joints", "/box/mag", "/box/adc")]
    gone = set(data.draw(st.lists(st.sampled_from(usable), max_size=6)))
    result = synced([m for i, m in enumerate(messages) if i not in gone], line_points=10)
    for one in (p for p in result.passes if not p.reason):
        begin, end = windows(one)
        assert np.all(np.diff(one.table.time) > 0)
        assert np.all(np.isfinite(np.concatenate([one.table.xyz, one.table.q, one.table.q_rate], axis=1)))
        assert np.all(one.table.xyz_sigma > 0.0)
        for i in gone:
            at = host_ns_of(messages[i]) if messages[i].topic == "/robot/joints" else middle_of_block(messages[i])
            assert np.all((end < at + EDGE_NS) | (begin > at - EDGE_NS))


def middle_of_block(message):
    """Return the host time of the signal shown by the block's middle sample."""
    n, delay_ns = {"/box/mag": (52, 0), "/box/adc": (13, 1_500_000)}[message.topic]
    return message.t_host_ns - 300_000 - n * PERIOD_NS // 2 - delay_ns


@cache
def short_session():
    """Return one line there and back at 300 mm/s."""
    rng = np.random.default_rng(7)
    return line_session(rng, some_lines(rng, 1), speed=0.3).messages
