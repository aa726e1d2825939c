"""A request's t1 is as early as the box can know it and never before the request's arrival, however requests and stray bytes are mixed."""

import gc
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.wire_frames import command, frames
from truearm_wire.frame import close
from truearm_wire.messages import SYNC_REPLY

sys.path.insert(0, str(Path(__file__).parents[2] / "firmware"))
from truearm_box.box import Box

BYTE_US = 50  # a Pico reads one byte at a time
STEP_US = 300


@pytest.fixture(autouse=True)
def no_collections(monkeypatch):
    """The box collects its own small heap; here it would be that of the whole test run."""
    monkeypatch.setattr(gc, "collect", lambda: 0)


class Source:
    channels = 4
    crc_errors = resets = missing = 0


class Bus:
    """A bus without a thermometer."""

    uids = ()


class Slow:
    """A board whose clock advances while it reads: data that arrive meanwhile are read in the same call."""

    name, uid, boot_id, reset_cause, ring_slots = "slow", b"12345678", b"\1\2\3\4", 1, 64
    shortest_period_ns = 245760
    config_path = error_path = "/nowhere/at/all"
    edges_lost = 0
    thermometers, sensors = Bus(), ()

    def __init__(self, arrivals):
        self.now_us = 0
        self.sent = b""
        self._waiting = [(at, byte) for at, data in arrivals for byte in data]
        self.adc = self.mag = Source()

    def now(self, buf):
        buf[:] = self.now_us.to_bytes(8, "big")

    def ticks(self):
        return self.now_us

    def ticks_diff(self, a, b):
        return a - b

    def receive(self, buf, stamp):
        n = 0
        while n < len(buf) and self._waiting and self._waiting[0][0] <= self.now_us:
            if n == 0:
                self.now(stamp)
            buf[n] = self._waiting.pop(0)[1]
            self.now_us += BYTE_US
            n += 1
        return n

    def send(self, buf, at, n):
        self.sent += bytes(buf[at : at + n])
        return n

    def send_stamped(self, buf, at, end, place):
        buf[place : place + 8] = self.now_us.to_bytes(8, "big")
        return self.send(buf, at, close(buf, at, end) - at)

    def self_test(self, settings):
        return {}

    def edge(self, edge):
        return False

    def configure(self, settings):
        pass

    def alive(self):
        pass

    def led(self, code):
        pass

    def heap_free(self):
        return 0

    def temperature_mdegc(self):
        return 25_000


def t1_of(arrivals, until_us):
    """Return t1 by id for all requests."""
    board = Slow(arrivals)
    box = Box(board)
    gc.enable()  # the box turned it off
    while board.now_us < until_us:
        box.step()
        board.now_us += STEP_US
    return {f[2]: f[3] for f in frames(board.sent) if f[0] == SYNC_REPLY}


def test_a_request_alone_is_stamped_at_its_first_byte():
    request = command(32, 1_000_000)
    at = 10_000
    stamped = t1_of([(at, request)], 30_000)[1_000_000]
    assert at <= stamped <= at + STEP_US  # reading it would take 0.7 ms
    assert len(request) * BYTE_US > 600


@pytest.mark.parametrize("ahead", [b"\0", b"rubbish", b"\0stray\0\0"])
def test_bytes_before_a_request_do_not_make_it_early(ahead):
    """They arrive, and while they are being read the request does."""
    for late in range(0, 500, 120):
        at = 10_000 + late
        found = t1_of([(10_000, ahead), (at, command(32, 7))], 30_000)
        if not ahead.endswith(b"h"):  # else the request's delimiter ends the rubbish, as it should
            assert found
        assert all(t1 >= at for t1 in found.values())


@pytest.mark.parametrize("rounds", [8, pytest.param(300, marks=pytest.mark.soak)])
def test_requests_in_every_constellation(rounds):
    rng = np.random.default_rng(3)
    for _ in range(rounds):
        at = 5000 + np.cumsum(rng.choice([0, 10, 60, 200, 700, 5000], 8))
        arrivals = []
        for i, t in enumerate(at.tolist()):
            if rng.random() < 0.3:
                arrivals.append((t, bytes(rng.choice([0, 0, 65, 66], rng.integers(1, 5)).tolist()) + b"\0"))
            data = command(32, 1000 + i)
            cut = int(rng.integers(0, len(data)))  # in two pieces: USB packets end anywhere
            arrivals += [(t, data[:cut]), (t + int(rng.choice([0, 300])), data[cut:])]
        # A link is a queue: nothing overtakes.
        times = np.maximum.accumulate([t for t, _ in arrivals]).tolist()
        arrivals = [(t, data) for t, (_, data) in zip(times, arrivals, strict=True)]
        when = {1000 + i: t for i, t in enumerate(at.tolist())}
        for number, t1 in t1_of(arrivals, int(at[-1]) + 20_000).items():
            assert t1 >= when[number]
