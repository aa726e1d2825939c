"""Complete sessions with a known truth: one observation per dwell, and no sample across a gap."""

import json
from dataclasses import replace
from itertools import chain, count

import numpy as np
import pytest
from session_stream import PERIOD_NS, RIG, Box, columns_of, counts_of, ident_document, renumber, session, stream_of
from tests.refusals import refused

from truearm.errors import RigError
from truearm.report.session_findings import REJECTED
from truearm.session.clock import fit_clock
from truearm.session.frames import parse_ident
from truearm.session.observations import observations, survey
from truearm.session.samples import ChannelSamples
from truearm.session.streams import BoxReader
from truearm.types import Message


def synced(messages, rig=RIG, ident=None, **options):
    return observations(survey(stream_of(messages), ident), rig, **options)


def blocks_between(messages, start_ns, end_ns):
    return [i for i, m in enumerate(messages) if m.topic == "/box/adc" and start_ns <= m.t_host_ns < end_ns]


@pytest.fixture(scope="module")
def clean():
    return session(np.random.default_rng(1), dwells=10)


def test_every_dwell_gives_its_length(clean):
    messages, truth = clean
    result = synced(messages, name="s.mcap")
    table = result.table
    assert result.reasons == {}
    assert len(table) == 10
    error = table.value - truth.length
    deviation = np.sqrt([dwell.value_var for dwell in result.dwells])
    assert np.all(np.abs(error) < 5.0 * deviation)  # five: one in two million
    assert np.allclose(table.sigma, np.sqrt(deviation**2 + 84e-6**2), rtol=1e-12)
    assert np.max(np.abs(table.q - truth.q)) <= 0.5e-4 + 1e-12  # half a step of the readings
    assert set(table.kind) == {"ball_bar"}
    assert (set(table.bar), set(table.chuck), set(table.sphere), set(table.shell)) == ({"b46"}, {"c1"}, {"s1"}, {"s46"})
    assert list(table.source[:2]) == ["s.mcap dwell 1", "s.mcap dwell 2"]
    assert result.samples_used == sum(dwell.n_samples for dwell in result.dwells) > 10 * 1000


def test_every_row_has_its_time_and_the_boxs_temperature():
    """Dwells of 2 s within 4 minutes, in which the box warms by 10 m°C a second: its mean over two minutes is its temperature then."""
    messages, truth = session(np.random.default_rng(2), dwells=80, warming=10.0)
    table = synced(messages).table
    middle = 0.5e-9 * (truth.start_ns + truth.end_ns)
    assert len(table) == 80
    assert (
        np.abs(table.time - middle)[1:].max() < 0.5
    )  # what settles is not used; the robot stands at the first pose before
    inner = (middle > 65.0) & (middle < middle[-1] - 65.0)
    # Half a second more or less of two minutes, and a reading's rounding.
    np.testing.assert_allclose(table.temperature[inner], 24.0 + 1e-2 * middle[inner], atol=0.02)
    silent = synced([message for message in messages if message.topic != "/box/heartbeat"]).table
    assert np.isnan(silent.temperature).all()


def test_a_gap_leaves_the_longest_whole_piece_if_long_enough(clean):
    messages, truth = clean
    lost = blocks_between(messages, truth.start_ns[3] + 6.3e8, truth.end_ns[3] - 1.3e9)[:2]
    result = synced([m for i, m in enumerate(messages) if i not in lost])
    whole = synced(messages)
    assert result.survey.losses.frames_lost == len(lost) == 2
    assert result.survey.losses.samples_lost == 26
    assert result.reasons == {}
    before, after = whole.dwells[3], result.dwells[3]
    assert after.n_samples < before.n_samples - 26
    assert [d.n_samples for i, d in enumerate(result.dwells) if i != 3] == [
        d.n_samples for i, d in enumerate(whole.dwells) if i != 3
    ]
    messages, truth = clean
    lost = blocks_between(messages, truth.start_ns[3] + 1.2e9, truth.start_ns[3] + 1.25e9)
    result = synced([m for i, m in enumerate(messages) if i not in lost])
    assert result.reasons == {"gap": 1}
    assert result.dwells[3].reason == "gap"
    assert len(result.table) == 9
    assert "session dwell 4" not in result.table.source


def test_reboot_inside_a_dwell(clean):
    """Two sessions of one box, the second after a reboot: its clock is another, no dwell spans both."""
    messages, truth = clean
    cut = int(truth.start_ns[5] + 1.2e9)
    box = Box(ppm=-44.0, boot_host_ns=cut, boot_id=99)
    box.ident(cut + 10)
    times = np.arange(cut + 10**8, truth.end_ns[-1] + 4e8, PERIOD_NS).astype(np.int64)
    corners = np.stack([truth.start_ns, truth.end_ns], axis=1).ravel()
    counts = np.zeros((times.size, 4), np.int64)
    counts[:, 0] = counts_of(np.interp(times - 1_500_000, corners, np.repeat(truth.length - 0.46, 2)))
    next_probe = cut + 10**8
    for k in range(0, times.size - 13, 13):
        box.data(int(times[k]), counts[k : k + 13])
        if times[k] > next_probe:
            box.sync(int(times[k]) + 13 * PERIOD_NS, 95e3, 95e3)
            next_probe += 250_000_000
    old = [m for m in messages if m.t_host_ns < cut or m.topic.startswith("/robot")]
    new = renumber(sorted(box.messages, key=lambda m: m.t_host_ns))
    result = synced(sorted(old + new, key=lambda m: m.t_host_ns))
    assert result.survey.losses.restarts == 1
    assert [segment.boot_id for segment in result.survey.segments] == [7, 99]
    assert [report.segment for report in result.survey.clock_reports] == [0, 1]
    assert [dwell.reason for dwell in result.dwells] == [""] * 5 + ["gap"] + [""] * 4
    # noise-free in the second segment: half a count is 2.5 nm
    assert np.allclose(result.table.value[5:], truth.length[6:], rtol=0, atol=5e-9)


def with_lvdt(messages, start_ns, end_ns, change):
    """Return the same session with other LVDT counts in the blocks of an interval."""
    result = list(messages)
    for i in blocks_between(messages, start_ns, end_ns):
        at = messages[i].data.index(b"\xd8\x4e") + 2
        header = 2 if messages[i].data[at] == 0x58 else 1
        counts = np.frombuffer(messages[i].data[at + header : -1], "<i4").reshape(-1, 4).copy()
        counts[:, 0] = change(counts[:, 0])
        data = messages[i].data
        result[i] = messages[i]._replace(data=data[: at + header] + counts.tobytes() + data[-1:])
    return result


def added(metres):
    """Return a change for ``with_lvdt()``: adds metres(t), t [s] from the first changed block."""
    blocks = count()

    def change(counts):
        t = 1e-9 * PERIOD_NS * (13 * next(blocks) + np.arange(counts.size))
        return counts + np.rint(metres(t) / 0.035 / 143e-9).astype(counts.dtype)

    return change


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda counts: np.where(np.arange(counts.size) == 5, 2**23 - 1, counts), "rail"),
        (lambda counts: np.full(counts.size, -(2**23)), "rail"),
        (lambda counts: counts_of(np.full(counts.size, 0.0376)), "out of travel"),
        (lambda counts: counts + np.where(np.arange(counts.size) % 2, 40_000, -40_000), "noisy"),
    ],
)
def test_readings_that_cannot_be_trusted(clean, change, reason):
    messages, truth = clean
    start = truth.start_ns[4]
    result = synced(with_lvdt(messages, start + 9e8, start + 1.3e9, change))
    assert result.reasons == {reason: 1}
    assert result.dwells[4].reason == reason
    assert set(result.reasons) <= set(chain.from_iterable(REJECTED.values()))


def test_a_sensor_that_still_moves(clean):
    """The sensor moves by 0.1 mm a second while the joints stand still."""
    messages, truth = clean
    start = truth.start_ns[4]
    result = synced(with_lvdt(messages, start, start + 2e9, added(lambda t: 0.1e-3 * t)))
    assert result.reasons == {"drift": 1}
    assert float(result.dwells[4].detail.split()[0]) > 21.0  # µm: a quarter of the declared repeatability


def test_a_sensor_that_rings_on(clean):
    """A swing of 0.1 mm at 6 Hz over the whole stop, while the joints stand still: no noise, however steady it is."""
    messages, truth = clean
    start = truth.start_ns[4]
    swing = iter(0.1e-3 * np.cos(2.0 * np.pi * 6.0 * 13e-9 * PERIOD_NS * np.arange(400)))
    result = synced(
        with_lvdt(messages, start, start + 2e9, lambda counts: counts + round(next(swing) / 0.035 / 143e-9))
    )
    assert result.reasons == {"ringing": 1}
    assert float(result.dwells[4].detail.split()[0]) == pytest.approx(100.0, abs=25.0)  # µm, in means over 25 ms


def test_a_swing_that_ends_is_left_out(clean):
    """It has died down to a quarter of the repeatability when the dwell begins, and costs no more than that."""
    messages, truth = clean
    start = truth.start_ns[4]
    t = 13e-9 * PERIOD_NS * np.arange(400)
    swing = iter(1e-3 * np.exp(-t / 0.12) * np.cos(2.0 * np.pi * 6.0 * t))
    result = synced(
        with_lvdt(messages, start, start + 2e9, lambda counts: counts + round(next(swing) / 0.035 / 143e-9))
    )
    assert result.reasons == {}
    dwell = result.dwells[4]
    assert 0.3 < dwell.start_s - dwell.stood_s < 0.7  # 0.12 · ln(1 mm / 21 µm) = 0.46 s
    assert [d.start_s - d.stood_s < 0.3 for d in result.dwells] == [i != 4 for i in range(10)]
    assert abs(dwell.value - truth.length[4]) < 5e-6


def test_a_clock_too_poor_to_say_which_samples_are_of_the_dwell(clean):
    """Requests that wait 0.3 s before they are sent leave ±0.15 s open."""
    messages = []
    for m in clean[0]:
        if m.topic == "/sync":
            exchange = json.loads(m.data)
            m = m._replace(data=json.dumps({**exchange, "t0_ns": exchange["t0_ns"] - 300_000_000}).encode())
        messages.append(m)
    result = synced(messages)
    assert result.reasons == {"clock": 10}
    assert result.dwells[0].detail.startswith("±15")


def test_mounted_events_serve_without_a_plan():
    messages, truth = session(np.random.default_rng(3), dwells=4, plan=False)
    assert synced(messages).reasons == {"no plan match": 4}
    first = {"kind": "mounted", "bar": "b46", "chuck": "c1", "sphere": "s1", "shell": "a"}
    at = int(truth.end_ns[1] + 3e8)
    events = [Message("/events", 1, json.dumps(first).encode())]
    events.append(Message("/events", at, json.dumps({**first, "chuck": "c2", "shell": "b"}).encode()))
    result = synced(sorted(messages + events, key=lambda m: m.t_host_ns))
    assert list(result.table.chuck) == ["c1", "c1", "c2", "c2"]
    assert list(result.table.shell) == ["a", "a", "b", "b"]


def test_a_plan_that_leaves_the_chuck_open_gives_no_observation(clean):
    """The plan visits all poses again with another chuck; the recording holds one of the two rounds."""
    messages, _ = clean
    planned = [json.loads(m.data) for m in messages if m.topic == "/plan"]
    again = [Message("/plan", 0, json.dumps({**pose, "chuck": "c2"}).encode()) for pose in planned]
    assert synced(again + messages).reasons == {"ambiguous": 10}
    said = {"kind": "mounted", "bar": "b46", "chuck": "c1", "sphere": "s1"}
    result = synced([Message("/events", 1, json.dumps(said).encode()), *again, *messages])
    assert result.reasons == {}
    assert set(result.table.chuck) == {"c1"}


@pytest.mark.parametrize("key", ["bars", "chucks", "spheres"])
def test_a_rig_that_lacks_what_the_plan_names(clean, key):
    with pytest.raises(RigError, match="session names"):
        synced(clean[0], replace(RIG, **{key: {}}))


def test_without_exchanges_samples_channel_or_ident(clean):
    result = synced([m for m in clean[0] if m.topic not in ("/sync", "/box/sync")])
    assert result.reasons == {"no clock": 10}
    assert len(result.table) == 0
    assert result.table.q.shape == (0, 6)
    messages, _ = clean
    assert synced([m for m in messages if m.topic != "/box/adc"]).reasons == {"no samples": 10}
    nothing = synced([m for m in messages if m.topic != "/robot/joints"])
    assert (nothing.dwells, len(nothing.table)) == ((), 0)
    assert len(synced([]).table) == 0
    named = [m._replace(data=m.data.replace(b"lvdt", b"gage")) if m.topic == "/box/ident" else m for m in clean[0]]
    with refused("invalid-input", "'lvdt'", "gage"):
        synced(named)
    messages = [m for m in clean[0] if m.topic != "/box/ident"]
    assert synced(messages).reasons == {"no samples": 10}
    assert len(synced(messages, ident=parse_ident(ident_document())).table) == 10


def test_samples_are_those_of_the_interval_by_signal_time():
    """Counts that tell their index; the signal lies the group delay before the stamp."""
    box = Box()
    box.ident(0)
    for k in range(400):
        index = np.arange(13 * k, 13 * k + 13)
        box.data(10**9 + 13 * k * PERIOD_NS, np.stack([index] * 4, axis=1))
    exchanges = [(t, t // 1000 + 1, t // 1000 + 1, t + 2000) for t in range(0, 8 * 10**9, 250_000_000)]
    clocks = {0: fit_clock(0, exchanges)[0]}
    samples, reader = ChannelSamples(("lvdt",)), BoxReader()
    for begin in range(0, len(box.messages), 100):
        samples.keep(reader.feed(columns_of(box.messages[begin : begin + 100])))
    samples.keep(reader.finish())
    samples.place(clocks)
    intervals = [(2 * 10**9, 3 * 10**9), (3_000_000_001, 3_000_500_000), (4 * 10**9, 60 * 10**9)]
    signal = 10**9 + np.arange(13 * 400) * PERIOD_NS - 1_500_000
    for start, end in intervals:
        # stamps are cut to 1 µs: a sample within 2 µs of an end may fall on either side, and none does here
        assert np.min(np.abs(signal - start)) > 2000 or start == 3_000_000_001
        expected = np.flatnonzero((signal >= start) & (signal <= end))
        taken = samples.during(start, end)
        assert np.array_equal(taken.counts[:, 0] if taken else [], expected)
        assert not expected.size or np.array_equal(taken.longest()[1], expected)
