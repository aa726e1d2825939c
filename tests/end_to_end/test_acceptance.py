"""The box's acceptance, the same at every level: every sample is the world's, every stamp is right, every fault is counted."""

import numpy as np
import pytest
from tests.end_to_end.levels import LEVELS, MAG_PERIOD_NS, lab_of, record_lab, samples

from truearm.sensors.ident import find_channel
from truearm.sync.blocks import BoxReader
from truearm.types import Message
from truearm_sim import sensors
from truearm_sim.hardware import Edge
from truearm_sim.simbox import Fault
from truearm_wire import messages as wire

ADC_PERIOD_NS = 983_040
SECONDS = 10
EDGES = [Edge(3_000_000_000 + 37_000_123 * k, k % 2, k % 4 < 2) for k in range(40)]


@pytest.fixture(scope="module", params=LEVELS)
def level(request):
    return request.param


@pytest.fixture(scope="module")
def session(level, tmp_path_factory):
    """Ten seconds of both sources, edges on both lines, a hundredth of the stops missing."""
    with lab_of(level, edges=EDGES, lost_stops=0.01) as lab:
        yield record_lab(lab, tmp_path_factory.mktemp("acceptance") / "s.mcap", SECONDS)


def test_every_count_is_the_worlds(session):
    counts, _, index = samples(session.blocks(0), 4)
    assert np.array_equal(index, np.arange(len(index)))
    assert len(index) > 0.99 * SECONDS * 1e9 / ADC_PERIOD_NS
    expected, _ = session.world.samples(0, len(index), session.box.first_ns[0], ADC_PERIOD_NS)
    assert np.array_equal(counts, expected)
    assert all(b.flags == 0 for b in session.blocks(0))


def test_every_shot_is_the_worlds_rounded_down(session):
    blocks = session.blocks(1)
    ticks, _, index = samples(blocks, 1)
    assert np.array_equal(index, np.arange(len(index)))
    flights = session.world.flight_times(0, len(index), session.box.first_ns[1], MAG_PERIOD_NS)
    assert np.array_equal(ticks[:, 0], np.maximum(flights, 0) // sensors.TICK_PS)
    missing = int((flights < 0).sum())
    assert 0 < missing < 0.03 * len(index)
    flagged = [bool(b.flags & wire.FLAG_MISSING_STOP) for b in blocks]
    assert flagged == [bool((np.frombuffer(b.samples, "<i4") == 0).any()) for b in blocks]
    counted = session.counters()["missing_stops"]
    assert counted <= missing <= counted + 20, "what came after the last heartbeat is not in it"


@pytest.mark.parametrize("stream", [0, 1])
def test_every_stamp_is_that_of_its_sample(session, stream):
    blocks = session.blocks(stream)
    instants = session.box.first_ns[stream] - session.box.boot_device_ns
    error = np.array([b.t0_us - 1e-3 * (instants + b.n0 * b.period_ns) for b in blocks])
    assert np.abs(error).max() < 1.0
    assert {b.period_ns for b in blocks} == {(ADC_PERIOD_NS, MAG_PERIOD_NS)[stream]}


def test_the_position_of_the_magnet(session):
    """Within 30 µm a shot and 5 µm in the mean of 100, by the calibration that the box tells.

    Half a tick is 11.2 µm, and 3.7 σ of the head's 5.1 µm fit beside it: one shot in 10^5 is further off. A mean of 100 has its
    bias of at most 2.6 µm and three of its own σ of 0.75 µm.
    """
    reader = BoxReader()
    for frame in session.frames("/box/ident"):
        reader.feed(Message("/box/ident", 0, bytes(wire.encode_payload(frame))))
    stream, column = find_channel(reader.segment.ident, "magnetostrictive")
    channel = stream.channels[column]
    ticks, stamps, _ = samples(session.blocks(1), 1)
    good = ticks[:, 0] > 0
    seconds = ticks[good, 0] * channel.scale
    position = channel.poly[0] + channel.poly[1] * seconds
    error = position - session.world.magnet_position(session.box.true_s(stamps[good]))
    assert np.abs(error).max() < 30e-6
    assert np.abs(error[: len(error) // 100 * 100].reshape(-1, 100).mean(axis=1)).max() < 5e-6
    assert np.ptp(position) > 0.01, "the magnet moved"


def test_every_edge_has_its_time(session):
    events = session.frames("/box/event")
    assert [(e[2], e[4]) for e in events] == [(edge.line, int(edge.rising)) for edge in EDGES]
    due = [session.box.device_us(edge.t_ns) for edge in EDGES]
    assert np.abs(np.array([e[3] for e in events]) - due).max() <= 1


def test_nothing_is_lost(session):
    counters = session.counters()
    names = ("overruns", "dropped", "bad_frames", "crc_errors", "converter_resets")
    assert {name: counters[name] for name in names} == dict.fromkeys(names, 0)
    assert session.summary.reason == "duration"
    assert session.summary.faults == ()
    assert session.summary.counters.lost_frames == 0


def test_a_second_run_gives_the_same_bytes(session, level, tmp_path):
    with lab_of(level, edges=EDGES, lost_stops=0.01) as lab:
        again = record_lab(lab, tmp_path / "again.mcap", 2)
    for stream in (0, 1):
        n = len(again.blocks(stream)) * 3 // 4  # the rest is numbered otherwise: it came with the stop
        assert n > 20
        assert again.blocks(stream)[:n] == session.blocks(stream)[:n]


@pytest.mark.parametrize(
    ("kind", "counter", "stream", "flag"),
    [
        ("bad-crc", "crc_errors", 0, wire.FLAG_CONVERTER),
        ("converter-reset", "converter_resets", 0, wire.FLAG_CONVERTER),
        ("no-stop", "missing_stops", 1, wire.FLAG_MISSING_STOP),
    ],
)
def test_faults_of_the_sensors_are_flagged_and_counted(level, tmp_path, kind, counter, stream, flag):
    with lab_of(level, faults=[Fault(2.5, kind)]) as lab:
        session = record_lab(lab, tmp_path / "s.mcap", 4)
    counters = session.counters()
    expected = 10 if kind == "no-stop" else 1
    assert abs(counters[counter] - expected) <= (kind == "no-stop"), "10 ms are ten shots, or eleven"
    others = {"crc_errors", "converter_resets", "missing_stops"} - {counter}
    assert [counters[name] for name in others] == [0, 0]
    flagged = [b for b in session.blocks(stream) if b.flags]
    assert 1 <= len(flagged) <= 2
    assert all(b.flags & flag for b in flagged)
    assert not any(b.flags for b in session.blocks(1 - stream))


def test_a_firmware_that_hangs_is_restarted_by_its_watchdog(level, tmp_path):
    with lab_of(level, faults=[Fault(3.0, "hang")]) as lab:
        session = record_lab(lab, tmp_path / "s.mcap", 12)
    beats = session.frames("/box/heartbeat")
    causes = [beat[wire.names(wire.HEARTBEAT).index("reset_cause") + 1] for beat in beats]
    assert causes[0] == 1
    assert causes[-1] == 2
    assert session.summary.counters.restarts == 1
    assert session.blocks(0)[-1].n0 > 1000, "it streams again"


def test_an_exception_is_told_at_the_next_connect_and_kept_until_reset(level, tmp_path):
    with lab_of(level, faults=[Fault(2.0, "crash")]) as lab:
        record_lab(lab, tmp_path / "a.mcap", 6)
        again = record_lab(lab, tmp_path / "b.mcap", 2)
    (fault,) = again.summary.faults
    assert "its firmware once ended by an error" in fault
    assert "injected by the simulator" in fault
