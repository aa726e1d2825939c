"""Whatever a host sends while the box streams at its highest rate: no sample is lost, no heartbeat, and the watchdog does not bite."""

import itertools
import random

import numpy as np
import pytest

from tests.noise import PATTERNS
from tests.wire_frames import command
from truearm_wire.messages import CONFIGURE, ERROR, ERROR_RANGE, IDENTIFY, START, STOP, SYNC_REPLY, SYNC_REQUEST

from .conftest import MS, Chip, ident
from .test_box import heartbeats, indices

OSR = 1024  # 4069 Hz
BYTES = 3_000  # of each pattern


@pytest.fixture(scope="module")
def box(tmp_path_factory):
    """Return a box at 4 kHz, not started. Both tests use it."""
    chip = Chip(tmp_path_factory.mktemp("box"))
    chip.boot()
    chip.ask(CONFIGURE, 0, OSR)
    yield chip
    chip.close()


def answered(chip, number):
    """Send a clock request; return the frames up to its answer."""
    found = chip.hear(MS, rx=b"\0" + command(SYNC_REQUEST, number))
    for _ in range(100):
        if chip.end or any(f[0] == SYNC_REPLY and f[2] == number for f in found):
            break
        found += chip.hear(100 * MS)
    return found


def lost(found):
    """Return how many samples of both streams are missing by their indices; check that no frame is."""
    assert all(b[1] - a[1] == 1 for a, b in itertools.pairwise(found))
    return int((np.diff(indices(found, 0)) // 4 - 1).sum() + (np.diff(indices(found, 1)) - 1).sum())


def assert_punctual(beats):
    assert np.abs(np.diff([b["t_us"] for b in beats]) - 1e6).max() < 30_000
    assert all(b["reset_cause"] == 1 for b in beats)


def test_no_input_costs_samples_heartbeats_or_a_restart(box):
    found = box.ask(START, ms=20)
    for number, (name, pattern) in enumerate(PATTERNS.items()):
        found += box.hear(MS, rx=pattern(random.Random(1), BYTES))
        found += answered(box, number)
        assert (name, box.end, found[-1][1]) == (name, "", found[0][1] + len(found) - 1)
    found += box.hear(1050 * MS)
    assert [f[2] for f in found if f[0] == SYNC_REPLY and f[2] < 100] == [*range(len(PATTERNS))]
    beats = heartbeats(found)
    assert beats[-1]["overruns"] == lost(found) == 0
    assert beats[-1]["bad_frames"] > 30
    assert_punctual(beats)
    box.ask(STOP)


def test_two_hundred_requests_a_second_are_answered_and_cost_nothing(box):
    numbers = range(100, 300)
    found = box.ask(START, ms=20)
    for number in numbers:
        found += box.hear(5 * MS, rx=command(SYNC_REQUEST, number))
    found += answered(box, 7)
    assert [f[2] for f in found if f[0] == SYNC_REPLY] == [*numbers, 7]
    assert lost(found) == 0
    assert len(indices(found, 0)) > 0.9 * 4069
    assert_punctual(heartbeats(found))
    box.ask(STOP)


def test_a_start_above_the_announced_rate_is_refused(box):
    box.ask(CONFIGURE, 0, OSR // 2)
    (stream, _) = ident(box.ask(IDENTIFY))["streams"]
    assert stream["period_ns"] < stream["shortest_period_ns"] == 240 * OSR
    (error,) = [f for f in box.ask(START) if f[0] == ERROR]
    assert (error[3], box.sampling) == (ERROR_RANGE, False)
    assert "adc at 8138 Hz" in error[4]
