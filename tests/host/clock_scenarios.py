"""Random histories of clocks and links from seeds: a box whose time is requested, and a robot whose readings arrive.

The truth is kept with the recorded data. A crystal is within 100 ppm and drifts with its temperature: by at most 1 ppm
per minute, or (in one scenario of four) by up to 20 ppm back and forth, which is faster but stays near its mean. Links
have a shortest latency, different in each direction, tails, stalls, losses. Boxes reboot; their time passes 2^30 and
2^32 µs.

Clocks also step, are slewed, change their rate permanently; exchanges are rare, lost, wrong (``CHANGES``).
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from session_stream import columns_of

from truearm.clocks import SLEWED_WANDER, WANDER
from truearm.session.clock import Arrivals, ClockReport, fit_clock, fit_robot_clock
from truearm.session.streams import BoxReader
from truearm.types import Message
from truearm_wire.messages import HEARTBEAT, SYNC_REPLY, encode_payload, names

PPM = 1e-6
HOST_NS = 10**15


@dataclass(frozen=True)
class Crystal:
    """A crystal that reads ``begin`` s at true time ``since``: a rate, a decaying drift (warming up), a slow swing."""

    since: float
    begin: float
    rate: float
    warming: float  # 1/s, of the rate at first
    warming_s: float
    swing: float
    swing_s: float

    def reading(self, t):
        t = np.asarray(t) - self.since
        x = t / self.warming_s
        warm = self.warming * self.warming_s**2 * (np.exp(-x) - 1.0 + x)  # twice the integral of warming · e^(-x)
        slow = self.swing * self.swing_s / (2.0 * np.pi) * (1.0 - np.cos(2.0 * np.pi * t / self.swing_s))
        return self.begin + t * (1.0 + self.rate) + warm + slow

    def true(self, reading):
        t = np.asarray(reading) - self.begin + self.since
        for _ in range(6):
            t = t - (self.reading(t) - reading)
        return t


def crystal(rng, since=0.0, begin=0.0, fast=False):
    """Return a crystal that drifts by at most 1 ppm per minute, or if ``fast`` by 20 ppm about its mean."""
    share = rng.random()
    period = rng.uniform(60.0, 600.0)
    # The rate of a swing changes by 2π/period of its amplitude per second.
    steady = (1.0 - share) * PPM / 60.0 * period / (2.0 * np.pi)
    return Crystal(
        since,
        begin,
        rng.uniform(-100.0, 100.0) * PPM,
        0.0 if fast else share * PPM / 60.0 * rng.choice([-1.0, 1.0]),
        rng.uniform(30.0, 600.0),
        rng.uniform(0.0, 20.0) * PPM if fast else steady,
        period,
    )


@dataclass(frozen=True)
class Way:
    """Latencies of a link in one direction [s]."""

    least: float
    tail: float
    shape: float  # of the gamma distribution of the additional part; 1: exponential
    stalls: float  # share
    stall: float

    def draw(self, rng, n):
        stalled = np.where(rng.random(n) < self.stalls, rng.exponential(self.stall, n), 0.0)
        return self.least + rng.gamma(self.shape, self.tail / self.shape, n) + stalled


def way(rng):
    return Way(
        rng.uniform(10e-6, 500e-6), rng.uniform(20e-6, 300e-6), rng.uniform(1.0, 3.0), rng.uniform(0.0, 0.05), 10 ** rng.uniform(-3.0, -1.0)
    )  # fmt: skip


NOMINAL = (Way(125e-6, 80e-6, 1.0, 0.01, 5e-3), Way(150e-6, 120e-6, 1.0, 0.01, 8e-3))  # the simulated USB's


@dataclass(frozen=True)
class Outcome:
    """Errors and bounds [µs] throughout one scenario; the shortest latency or round trip [µs] included in them."""

    error: np.ndarray
    bound: np.ndarray
    floor: float

    @property
    def ratio(self):
        return np.abs(self.error) / self.bound


def box_scenario(seed, seconds=240.0, nominal=False):
    """Run a box whose time is requested four times a second, through the reader of recorded messages."""
    rng = np.random.default_rng([seed, 0xB0C])
    there, back = NOMINAL if nominal else (way(rng), way(rng))
    lost = 0.0 if nominal else rng.uniform(0.0, 0.2)
    boots = [0.0, *np.sort(rng.uniform(30.0, seconds - 30.0, 0 if nominal else rng.integers(0, 3)))]
    wrap = rng.choice([0.0, 2**30 * 1e-6, 2**32 * 1e-6])
    lives = []
    for k, since in enumerate(boots):
        begin = max(0.0, wrap - rng.uniform(5.0, seconds)) if k == 0 else 2.0
        lives.append(crystal(rng, since, begin, fast=not nominal and rng.random() < 0.25))
    messages, seq, last_life = [], 0, 0
    t0 = np.arange(0.0, seconds, 0.25) + rng.uniform(0.0, 0.01, round(4 * seconds))
    arrive = np.maximum.accumulate(t0 + there.draw(rng, t0.size))
    leave = arrive + rng.uniform(20e-6, 600e-6, t0.size)
    t3 = np.maximum.accumulate(leave + back.draw(rng, t0.size))
    for k in range(t0.size):
        life = int(np.searchsorted(boots, arrive[k], side="right")) - 1
        if rng.random() < lost or life != int(np.searchsorted(boots, leave[k], side="right")) - 1:
            row = {"id": k, "t0_ns": HOST_NS + int(1e9 * t0[k]), "t1_us": None, "t2_us": None, "t3_ns": None}
            messages.append(Message("/sync", HOST_NS + int(1e9 * t3[k]), json.dumps(row).encode()))
            continue
        if life != last_life:
            seq, last_life = 0, life
        t1, t2 = (int(np.floor(1e6 * lives[life].reading(t))) for t in (arrive[k], leave[k]))
        host = HOST_NS + int(np.ceil(1e9 * t3[k]))
        if k % 4 == 0:
            beat = dict.fromkeys(names(HEARTBEAT), 0) | {"seq": seq, "boot_id": 100 + life, "t_us": t1}
            messages.append(Message("/box/heartbeat", host, bytes(encode_payload([HEARTBEAT, *beat.values()]))))
            seq += 1
        messages.append(Message("/box/sync", host, bytes(encode_payload([SYNC_REPLY, seq, k, t1, t2]))))
        seq += 1
        row = {"id": k, "t0_ns": HOST_NS + int(1e9 * t0[k]), "t1_us": t1, "t2_us": t2, "t3_ns": host}
        messages.append(Message("/sync", host, json.dumps(row).encode()))
    reader = BoxReader()
    reader.feed(columns_of(messages))
    reader.finish()
    assert len(reader.segments) == len(lives)
    return _judged_box(reader, lives, [*boots, seconds])


def _judged_box(reader, lives, ends):
    errors, bounds = [], []
    for segment, life, begin, end in zip(reader.segments, lives, ends, ends[1:], strict=False):
        clock, _ = fit_clock(segment.index, reader.exchanges(segment))
        device_us = np.floor(1e6 * life.reading(np.linspace(begin, end, 2000))).astype(np.int64)
        host, bound = clock.to_host_ns(device_us)
        errors.append(1e-3 * (host - HOST_NS - 1e9 * life.true(1e-6 * device_us)))
        bounds.append(1e-3 * bound)
    return Outcome(np.concatenate(errors), np.concatenate(bounds), 0.0)


ROBOT_APART_S = 15.0
APART_S = 5.0  # between changes: more than SPAN exchanges at 4 Hz of which one in five is lost


def times_apart(rng, n, begin, end, apart=APART_S):
    """Return n random ascending times with at least this distance between them."""
    return np.sort(rng.uniform(begin, end - (n - 1) * apart, n)) + apart * np.arange(n)


@dataclass(frozen=True)
class HostClock:
    """A clock that steps by ``by`` at ``at``, and changes its rate by ``rate`` from ``begin`` to ``end`` (true s)."""

    at: np.ndarray
    by: np.ndarray
    begin: np.ndarray
    end: np.ndarray
    rate: np.ndarray

    def reading(self, t):
        t = np.asarray(t)[..., None]
        return (
            t[..., 0]
            + np.sum((t >= self.at) * self.by, -1)
            + np.sum(self.rate * (np.clip(t, self.begin, self.end) - self.begin), -1)
        )


def host_clock(rng, seconds, steps=0, slews=0, rates=0, apart=APART_S):
    """Return steps of 50 µs to 10 ms, slews by 50 to 500 ppm for 1 to 20 s, permanent rate changes of 20 to 400 ppm."""
    slewed_s = 20.0 if slews else 0.0
    times = times_apart(rng, steps + slews + rates, apart, seconds - slewed_s - apart, slewed_s + apart)
    at, begin, lasting = np.split(rng.permutation(times), [steps, steps + slews])
    size = np.concatenate([rng.uniform(50.0, 500.0, slews), 10.0 ** rng.uniform(1.3, 2.3, rates)]) * PPM
    return HostClock(
        at,
        rng.choice([-1.0, 1.0], steps) * 10.0 ** rng.uniform(-4.3, -2.0, steps),
        np.concatenate([begin, lasting]),
        np.concatenate([begin + rng.uniform(1.0, 20.0, slews), np.full(rates, np.inf)]),
        rng.choice([-1.0, 1.0], slews + rates) * size,
    )


@dataclass(frozen=True)
class Change:
    """The events of a scenario other than crystals and links."""

    steps: int = 0
    slews: int = 0
    rates: int = 0
    spacing: float = 0.25  # s between exchanges
    seconds: float = 240.0
    asymmetry: float = 0.0  # s of additional latency on the way to the box
    lost: float = 0.2  # at most this share of the exchanges
    wrong: int = 0  # exchanges with the box's stamps wrong by up to 50 ms
    apart: float = APART_S


CHANGES = {
    "steady": Change(),
    "steps": Change(steps=5),
    "slews": Change(slews=3),
    "rates": Change(rates=2),
    "asymmetry": Change(steps=2, asymmetry=2e-3),
    "sparse": Change(steps=3, spacing=60.0, seconds=10_800.0, apart=1200.0),
    "lost": Change(steps=3, lost=0.7, apart=15.0),
    "wrong": Change(wrong=8),
    "all": Change(steps=3, slews=1, rates=1, wrong=0, asymmetry=0.5e-3, seconds=480.0),
}


class Exchanged(NamedTuple):
    """The record of a box whose time was requested, and its truth."""

    rows: np.ndarray  # (n, 4) t0 ns, t1 µs, t2 µs, t3 ns
    crystal: Crystal
    host: HostClock

    def truth_ns(self, device_us):
        """Return host time minus HOST_NS."""
        return 1e9 * self.host.reading(self.crystal.true(1e-6 * device_us))


def exchanged(seed, change):
    """Return the exchanges of one life of a box."""
    rng = np.random.default_rng([seed, 0xC10C])
    there, back = way(rng), way(rng)
    life = crystal(rng, 0.0, 2.0, fast=rng.random() < 0.25)
    host = host_clock(rng, change.seconds, change.steps, change.slews, change.rates, change.apart)
    n = round(change.seconds / change.spacing)
    t0 = np.arange(n) * change.spacing + rng.uniform(0.0, 0.01, n)
    arrive = np.maximum.accumulate(t0 + there.draw(rng, n) + change.asymmetry)
    leave = arrive + rng.uniform(20e-6, 600e-6, n)
    t3 = np.maximum.accumulate(leave + back.draw(rng, n))
    stamps = (np.floor(1e9 * host.reading(t0)), np.floor(1e6 * life.reading(arrive)))
    stamps += (np.floor(1e6 * life.reading(leave)), np.ceil(1e9 * host.reading(t3)))
    rows = np.stack(stamps, axis=1).astype(np.int64) + np.array([HOST_NS, 0, 0, HOST_NS])
    at = np.searchsorted(t0, times_apart(rng, change.wrong, 5.0, change.seconds - 5.0))
    off = rng.choice([-1.0, 1.0], change.wrong) * 10.0 ** rng.uniform(2.0, 4.7, change.wrong)
    rows[at, 1:3] += np.rint(off).astype(np.int64)[:, None]
    return Exchanged(rows[rng.random(n) >= rng.uniform(0.0, change.lost)], life, host)


class Changing(NamedTuple):
    """Errors and bounds at true times [s] of a scenario with changes, its report, and the largest bound near each step.

    The largest bound [µs] is within 50 ms of each step.
    """

    t: np.ndarray
    outcome: Outcome
    report: ClockReport
    known: Exchanged
    at_step: np.ndarray


def changing_scenario(seed, change):
    """Run a box whose clock, or whose host's clock, changes."""
    known = exchanged(seed, change)
    clock, report = fit_clock(0, known.rows, SLEWED_WANDER if change.slews or change.rates else WANDER)
    t = np.sort(
        np.concatenate([np.linspace(0.5, change.seconds - 0.5, 3000), *(known.host.at + dt for dt in (-1e-5, 1e-5))])
    )
    device_us = np.floor(1e6 * known.crystal.reading(t)).astype(np.int64)
    host, bound = clock.to_host_ns(device_us)
    error = (host - HOST_NS) - known.truth_ns(device_us)
    near = np.abs(t - known.host.at[:, None]) < 0.05
    at_step = np.max(np.where(near, 1e-3 * bound, 0.0), axis=1)
    return Changing(t, Outcome(1e-3 * error, 1e-3 * bound, 0.0), report, known, at_step)


def robot_scenario(seed, seconds=240.0, host_steps=0, robot_steps=0, slews=0):
    """Run a controller whose readings arrive over a network; the error is relative to the shortest latency."""
    rng = np.random.default_rng([seed, 0x20B])
    clock, link = crystal(rng, begin=rng.uniform(0.0, 1e5)), way(rng)
    rate = rng.choice([50.0, 125.0, 250.0, 500.0])
    ticks = np.arange(np.ceil(clock.begin * rate), np.floor(float(clock.reading(seconds)) * rate)) / rate
    ticks = ticks[rng.random(ticks.size) > rng.uniform(0.0, 0.05)]
    sent = clock.true(ticks)
    arrival = np.maximum.accumulate(sent + link.draw(rng, sent.size))
    host = host_clock(rng, seconds, host_steps, slews, apart=ROBOT_APART_S)
    robot = host_clock(rng, seconds, robot_steps, apart=ROBOT_APART_S)
    arrival_ns = HOST_NS + np.ceil(1e9 * host.reading(arrival)).astype(np.int64)
    stamps = np.round(ticks + (robot.reading(sent) - sent), 6)
    kept = (
        np.diff(np.maximum.accumulate(stamps), prepend=-np.inf) > 0.0
    )  # the reader drops readings that run back by less than a second
    gathered = Arrivals(float(stamps[0]), int(arrival_ns[0]))
    for part in np.array_split(np.flatnonzero(kept), max(1, stamps.size // 2048)):
        gathered.add(stamps[part], arrival_ns[part])
    fitted, _ = fit_robot_clock(0, gathered)
    at = np.linspace(0.0, seconds, 2000)
    shown = clock.reading(at) + (robot.reading(at) - at)
    late = 1e-3 * (fitted.to_host_ns(shown) - HOST_NS - 1e9 * host.reading(at))
    # Where its clock goes back, the controller shows one time twice.
    once = (shown >= np.maximum.accumulate(shown)) & (shown <= np.minimum.accumulate(shown[::-1])[::-1])
    return Outcome((late - 1e6 * link.least)[once], 1e-3 * fitted.bound_at(shown)[once], 1e6 * link.least)
