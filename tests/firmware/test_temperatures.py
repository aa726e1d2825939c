"""Thermometers on the box: reading, reporting and counting, and that a failing thermometer affects nothing else."""

from functools import cache

import pytest

from tests.firmware.conftest import Bench, ident_document, real_micropython
from tests.wire_frames import command, frames
from truearm_wire.messages import DATA, GET_CONFIG, HEARTBEAT, SELF_TEST, TEMPERATURE

BAR = bytes.fromhex("28aa01020304050f")
SENSOR = bytes.fromhex("28bb0102030405f0")
NAMED = {"bar": BAR.hex(), "sensor": SENSOR.hex()}
ERRORS = 18  # place of thermometer_errors in a heartbeat


@cache
def configuration():
    """Return the configuration of a box without any settings."""
    bench = Bench(None)
    try:
        return bench.document(GET_CONFIG)
    finally:
        bench.box.close()


@pytest.fixture(params=["micropython", "cpython"])
def boot(request):
    """Return a function that boots a box with thermometers, some of which the configuration names."""
    booted = []

    def start(thermometers, named=None):
        settings = configuration() | ({} if named is None else {"thermometers": named})
        interpreter = real_micropython() if request.param == "micropython" else None
        booted.append(Bench(interpreter, config=settings, thermometers=thermometers))
        return booted[-1]

    yield start
    for bench in booted:
        bench.box.close()


def pass_time(bench, seconds):
    """Return all frames of this many seconds."""
    return [frame for _ in range(round(10 * seconds)) for frame in bench.give(us=100_000)]


def temperatures(found):
    """Return (thermometer, m°C) of each reading."""
    return [(f[3], f[4]) for f in found if f[0] == TEMPERATURE]


def errors(found):
    return [f for f in found if f[0] == HEARTBEAT][-1][ERRORS]


def test_each_is_read_every_two_seconds_with_the_time_of_its_conversion(boot):
    bench = boot([(BAR, 20_062), (SENSOR, -10_125)], NAMED)
    found = pass_time(bench, 11)
    assert temperatures(found) == 5 * [(0, 20_062), (1, -10_125)]
    times = [f[2] for f in found if f[0] == TEMPERATURE]
    assert times[0::2] == times[1::2], "they convert together"
    assert all(1_900_000 <= b - a <= 2_200_000 for a, b in zip(times[0::2], times[2::2], strict=False))
    assert errors(found) == 0


def test_the_configuration_names_them_and_others_follow(boot):
    bench = boot([(BAR, 20_000), (SENSOR, 21_000)], {"sensor": SENSOR.hex()})
    assert ident_document(bench.boot)["thermometers"] == [
        {"name": "sensor", "uid": SENSOR},
        {"name": BAR.hex(), "uid": BAR},
    ]
    assert temperatures(pass_time(bench, 3)) == [(0, 21_000), (1, 20_000)]


def test_a_box_without_thermometers_says_nothing_of_them(boot):
    bench = boot([])
    assert "thermometers" not in ident_document(bench.boot)
    found = pass_time(bench, 5)
    assert (temperatures(found), errors(found)) == ([], 0)
    assert "thermometers_missing" not in bench.document(SELF_TEST)


def test_one_that_is_missing_is_a_fault_that_stops_nothing(boot):
    bench = boot([(SENSOR, 21_000)], NAMED)
    assert "thermometers of the configuration that do not answer: 1" in ident_document(bench.boot)["fault"]
    found = pass_time(bench, 9)
    assert temperatures(found) == 4 * [(1, 21_000)], "the other keeps its place"
    assert errors(found) == 4
    bench.start()
    assert [f[0] for f in bench.sample(13)].count(DATA) == 1


def test_one_that_fails_and_comes_back_is_counted_and_read_again(boot):
    bench = boot([(BAR, 20_000), (SENSOR, 21_000)], NAMED)
    pass_time(bench, 5)
    bench.thermometers = [(BAR, None), (SENSOR, 21_500)]
    found = pass_time(bench, 4)
    assert (set(temperatures(found)), errors(found)) == ({(1, 21_500)}, 2)
    bench.thermometers = [(BAR, None), (SENSOR, None)]  # the cable is off
    found = pass_time(bench, 4)
    assert (temperatures(found), errors(found)) == ([], 6)
    bench.thermometers = [(BAR, 20_125), (SENSOR, 21_000)]
    found = pass_time(bench, 4)
    assert (temperatures(found), errors(found)) == (2 * [(0, 20_125), (1, 21_000)], 6)


def test_a_new_configuration_names_them_anew(boot):
    bench = boot([(BAR, 20_000), (SENSOR, 21_000)], NAMED)
    found = bench.put(configuration() | {"thermometers": {"bar": SENSOR.hex(), "sensor": BAR.hex()}})
    assert [entry["uid"] for entry in ident_document(found)["thermometers"]] == [SENSOR, BAR]
    assert temperatures(pass_time(bench, 3)) == [(0, 21_000), (1, 20_000)]


def test_reading_them_allocates_nothing_and_loses_nothing():
    """Two thermometers, one of which fails half of the time, both streams and requests: heap_free stays, every sample comes."""
    bench = Bench(real_micropython(), thermometers=[(BAR, 20_000), (SENSOR, 21_000)])
    try:
        bench.start()
        free, samples, readings, tx = [], 0, 0, b""
        for i in range(1500):  # 19 s
            bench.thermometers = [(BAR, 20_000 + i), (SENSOR, None if i // 300 % 2 else 21_000)]
            bench.sample(13, both=True, rx=command(32, i) if i % 20 == 0 else b"")
            tx += bench.answer.tx
        for f in frames(tx):
            samples += len(f[6].data) // 16 if f[0] == DATA and f[2] == 0 else 0
            readings += f[0] == TEMPERATURE
            if f[0] == HEARTBEAT:
                free.append(f[11])
        assert readings >= 12
        assert samples == 1500 * 13
        assert set(free[1:]) == {free[1]}, "heap_free moved while streaming"
    finally:
        bench.box.close()


def test_readings_wait_while_the_link_is_held_back(boot):
    bench = boot([(BAR, 20_000)])
    for _ in range(60):
        assert bench.give(us=100_000, tx_room=0) == []
    found = pass_time(bench, 0.5)
    assert temperatures(found) == [(0, 20_000)], "the latest is read when the one before it was sent"
