"""Convert the times of the box and of the robot controller to host time.

**The box** answers requests for its time: the host writes at t0, the device receives at t1 and answers at t2, and the
answer arrives at t3. Each exchange is a row of ``truearm.clocks``: h(t1) ≥ t0 and h(t2) ≤ t3. The bound includes half
of the shortest round trip, which no exchange can divide between the two directions.

**The robot** sends readings in one direction. The fastest reading of each second is a row with a latest time alone. The
estimate is late by the shortest latency, which the parameter τ of the identification absorbs, or a trigger wire shows
(``trigger_edges``). The bound covers the rest: how far the estimate may be from the shortest latency. It is no hard
bound (docs/explanation/clocks.md#robot-and-host). Where controller time runs backward, another segment begins.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from truearm import clocks
from truearm.clocks import RATE_LIMIT, SLEWED_WANDER, WANDER, Clock
from truearm.session.session_file import Session
from truearm.types import Floats, Ints
from truearm.units import MDEGC, PPM

AROUND_NS = 60_000_000_000  # on each side
UNKNOWN = -1  # host time of an instant in a segment without a clock
COLDEST, WARMEST = -60_000, 200_000  # m°C; anything else is not a reading


class BoxTemperature(NamedTuple):
    """Readings (k,) in °C in order of host time [ns]."""

    t_host_ns: Ints
    degc: Floats

    @property
    def extremes(self) -> tuple[float, float] | None:
        """Return the lowest and the highest reading [°C]; None if there are no readings."""
        return (float(self.degc.min()), float(self.degc.max())) if len(self.degc) else None

    def at(self, t_host_ns: Ints) -> Floats:
        """Return the means (n,) of the readings around host times (n,); NaN where there are none."""
        first = np.searchsorted(self.t_host_ns, t_host_ns - AROUND_NS)
        last = np.searchsorted(self.t_host_ns, t_host_ns + AROUND_NS, side="right")
        total = np.concatenate([[0.0], np.cumsum(self.degc)])
        n = last - first
        return np.where(n > 0, (total[last] - total[first]) / np.maximum(n, 1), np.nan)

    def between(self, t_host_ns: Ints) -> Floats:
        """Return readings (n,) at host times (n,), interpolated linearly; NaN where no reading is near.

        Meant for a thermometer with fine resolution.
        """
        if not len(self.degc):
            return np.full(len(t_host_ns), np.nan)
        begin = self.t_host_ns[0]
        degc = np.interp(1e-9 * (t_host_ns - begin), 1e-9 * (self.t_host_ns - begin), self.degc)
        return np.where(np.isnan(self.at(t_host_ns)), np.nan, degc)


TICK_NS = 1000  # device time is in whole microseconds, rounded down


@dataclass(frozen=True)
class DeviceClock:
    """The clock of one segment."""

    clock: Clock
    least_bound_ns: float  # half the shortest round trip: a lower bound would mean that the clocks are no crystals

    def to_host_ns(self, t_us: Ints) -> tuple[Ints, Floats]:
        """Return the host times [ns] of device times (n,) [µs] and the bounds of their errors [ns]."""
        host, bound = self.clock.to_time(1000 * np.asarray(t_us, dtype=np.int64))
        return host, np.maximum(bound, self.least_bound_ns)


def host_times(clocks: Mapping[int, DeviceClock], segment: Ints, t_us: Ints) -> tuple[Ints, Floats]:
    """Return the host times (n, …) [ns], and their error bounds, of the box's times (n, …) [µs] in segments (n,).

    Without a clock of the segment they are UNKNOWN and NaN.
    """
    host, bound = np.full(t_us.shape, UNKNOWN), np.full(t_us.shape, np.nan)
    for k in np.intersect1d(segment, list(clocks)).astype(np.int64).tolist():
        host[segment == k], bound[segment == k] = clocks[k].to_host_ns(t_us[segment == k])
    return host, bound


def box_temperature(readings: Sequence[tuple[int, int, int]], clocks: Mapping[int, DeviceClock]) -> BoxTemperature:
    """Return readings by host time, given as segment, device time [µs] and m°C.

    Those of segments without a clock are left out.
    """
    segment, t_us, mdegc = np.array(readings, np.int64).reshape(-1, 3).T
    t_host_ns, bound = host_times(clocks, segment, t_us)
    sound = np.flatnonzero(np.isfinite(bound) & (mdegc >= COLDEST) & (mdegc <= WARMEST))
    order = sound[np.argsort(t_host_ns[sound], kind="stable")]
    return BoxTemperature(t_host_ns[order], MDEGC.to_si(mdegc[order]))


@dataclass(frozen=True)
class ClockChange:
    """A step of one of the clocks."""

    device_us: tuple[int, int]  # the exchanges before and after it
    by_ns: int  # how far host time advanced relative to device time


@dataclass(frozen=True)
class ClockReport:
    """How well the clock of one segment is known. Times in ns."""

    segment: int
    exchanges: int
    rejected: int
    device_us: tuple[int, int]  # first and last exchange
    offset_ns: int  # host − device at the middle of the segment
    rate_ppm: float  # how much faster the host counts than the device, mean
    bound_ns: float  # largest at any exchange
    rtt_min_ns: int
    rtt_median_ns: int
    half_asymmetry_ns: float  # rtt_min / 2: unobservable, included in the bound
    changes: tuple[ClockChange, ...]


def recorded_wander(session: Session) -> float:
    """Return how far the rate of the host's clock may wander: more if the system can slew the recording's clock."""
    kind = session.metadata.get("session", {}).get("clock")
    return WANDER if kind in ("monotonic-raw", "virtual") else SLEWED_WANDER


def fit_clock(
    segment: int, exchanges: Ints | Sequence[tuple[int, ...]], wander: float = WANDER
) -> tuple[DeviceClock, ClockReport] | None:
    """Return the clock of one segment and its report; None if no exchange (k, 4) is usable."""
    rows = np.array(exchanges, dtype=np.int64).reshape(-1, 4)
    sane = rows[(rows[:, 1] <= rows[:, 2]) & (rows[:, 0] <= rows[:, 3])]
    # By any clock, the host measured less time than the device: a stamp is wrong.
    sane = sane[_round_trips(sane) >= -TICK_NS - RATE_LIMIT * 1000.0 * (sane[:, 2] - sane[:, 1])]
    sane = sane[np.argsort(sane[:, 1], kind="stable")]
    t0, t1, t2, t3 = sane.T
    received = 1000 * t1 + TICK_NS
    while_held = received - 1000 * t2  # the bound of the answer, moved to the receipt
    latest = t3 + while_held + np.ceil(RATE_LIMIT * np.abs(while_held)).astype(np.int64)
    clock = clocks.fit(received, latest, t0, wander=wander)
    if clock is None:
        return None
    rtt = _round_trips(sane)
    device = DeviceClock(clock, max(0.0, 0.5 * int(np.min(rtt))))
    middle = np.array([int(t1[0] + t1[-1]) // 2])
    report = ClockReport(
        segment=segment,
        exchanges=len(rows),
        rejected=len(rows) - len(sane) + clock.wrong.size,
        device_us=(int(t1[0]), int(t1[-1])),
        offset_ns=int((device.to_host_ns(middle)[0] - 1000 * middle)[0]),
        rate_ppm=PPM.of(clock.rate),
        bound_ns=float(np.max(device.to_host_ns(t1)[1])),
        rtt_min_ns=int(np.min(rtt)),
        rtt_median_ns=int(np.median(rtt)),
        half_asymmetry_ns=0.5 * int(np.min(rtt)),
        changes=tuple(ClockChange((step.before_ns // 1000, step.after_ns // 1000), step.by_ns) for step in clock.steps),
    )
    return device, report


def _round_trips(sane: Ints) -> Ints:
    return np.asarray(sane[:, 3] - sane[:, 0] - 1000 * (sane[:, 2] - sane[:, 1]))


CELLS = 10  # in a second: in one of them, clocks drift by less than the heights of its packets
NODE_S = 10.0  # between the nodes of a clock: a drift of 1 ppm a minute bends it by less than 1 µs in between
AROUND_S = 30.0  # before and after a node, for its bound
RUN = 8  # seconds that contain a packet nearly as fast as possible
TILTED = 1.75  # factor on a run's height: a change tilts the estimate
SECONDS = 2.0 * AROUND_S  # around a node: with fewer, their fastest packet lies higher
ROUNDING_NS = 1000.0  # stamps are printed to the microsecond
DRIFT = 1e-6 / 60.0  # 1/s: a rate changes by no more than 1 ppm a minute


@dataclass(frozen=True)
class RobotClock:
    """The clock of one segment of controller time: a ``Clock`` of ns since ``t_ref_s``, and bounds at k nodes."""

    t_ref_s: float
    clock: Clock
    node_s: Floats  # (k,) ascending
    bound_ns: Floats  # (k,) of the error; of arrivals excluding the link's shortest latency, which is unknown

    def stamps(self, t_robot_s: Floats) -> Ints:
        """Return controller times (n,) [s] as whole ns from ``t_ref_s``."""
        return np.rint(1e9 * (np.asarray(t_robot_s) - self.t_ref_s)).astype(np.int64)

    def bound_at(self, t_robot_s: Floats) -> Floats:
        """Return bounds (n,) [ns] at controller times: the larger one of the two nodes around each."""
        node = np.clip(np.searchsorted(self.node_s, t_robot_s), 0, len(self.node_s) - 1)
        return np.asarray(np.maximum(self.bound_ns[np.maximum(node - 1, 0)], self.bound_ns[node]))

    def to_robot_s(self, t_host_ns: Ints) -> Floats:
        """Return controller times (n,) [s] of host times."""
        return np.asarray(self.t_ref_s + 1e-9 * self.clock.to_stamp(t_host_ns))

    def to_host_ns(self, t_robot_s: Floats) -> Ints:
        """Return host times [ns] of controller times (n,) [s], late by the shortest latency of the link."""
        return self.clock.to_time(self.stamps(t_robot_s))[0]


@dataclass(frozen=True)
class EdgeReport:
    """Results from the edges of the box's trigger output for one segment of controller time.

    ``shortest_latency_ns`` is the delay of the arrivals' clock relative to the edges' clock in the middle of the
    segment, which arrivals alone cannot show. Its error is at most the sum of ``bound_ns`` and the bound of the
    arrivals' clock. If the input's shorter delay exceeds the range of ``trigger_edges``, the excess is included.
    """

    input: int | None  # of the controller, following the output; None: no input does
    inverted: bool  # it goes low when the output goes high
    edges: int  # edges of the box's output while the controller sent readings
    unseen: int  # edges not visible in any reading
    unclear: int  # edges and changes of the input that cannot be distinguished: bounces, missing readings
    stray: int  # changes of the input without a matching edge
    used: int = 0
    rejected: int = 0  # edges that contradict the others
    # falling edges of the output are seen later than rising ones by, at least and at most; NaN if unknown
    falling_later_ns: tuple[float, float] = (np.nan, np.nan)
    # bound between controller and box, which the edges alone give; median; NaN if none is used
    to_box_ns: float = np.nan
    bound_ns: float = np.nan  # largest bound between controller and host, with that of the box's clock
    shortest_latency_ns: float = np.nan
    in_use: bool = False  # the robot's readings are timed by the edges, not by their arrivals


@dataclass(frozen=True)
class RobotClockReport:
    """How well a segment of controller time is tied to host time.

    A constant latency cannot be known and is not included.
    """

    segment: int
    readings: int
    t_robot_s: tuple[float, float]  # first and last
    rate_ppm: float  # how much faster the host counts than the controller, mean
    jitter_ns: float  # mean latency above the shortest; median over the minutes' halves
    bound_ns: float  # largest of the clock in use; for arrivals excluding the shortest latency
    edges: EdgeReport | None = None  # of a trigger wire, if the box toggled one


@dataclass
class Arrivals:
    """Collects (controller time, arrival) of one segment from its first reading.

    Keeps the fastest of each second, and sums.

    Clocks with rates 45 ppm apart drift by 45 µs in a second, which would make its first readings seem the fastest.
    Cells are kept so that the drift is removed first: 10 MB in six hours. The last one may get more readings.
    """

    t_ref_s: float
    host_ref_ns: int
    last_s: float = float("-inf")
    _cells: list[Floats] = field(default_factory=list)  # (6, n) each, see ``seconds``
    _last_cell: Floats = field(default_factory=lambda: np.empty((6, 0)))

    def add(self, t_robot_s: Floats, t_host_ns: Ints) -> None:
        """Take readings (n,) in order of arrival."""
        dt = t_robot_s - self.t_ref_s
        latency = (t_host_ns - self.host_ref_ns - np.rint(1e9 * dt).astype(np.int64)).astype(np.float64)
        rows = np.stack([np.floor(CELLS * dt), dt, latency, np.ones(dt.size), dt, latency])
        cells = _merged(np.concatenate([self._last_cell, rows], axis=1))
        self._cells.append(cells[:, :-1])
        self._last_cell = cells[:, -1:]
        self.last_s = float(t_robot_s[-1])

    def seconds(self) -> Floats:
        """Return rows (6, k) by second.

        These are its number; dt [s] and latency [ns] of the fastest reading; number of readings, sums of dt and
        latency.
        """
        cells = np.concatenate([*self._cells, self._last_cell], axis=1)
        self._cells.clear()
        cells[0] = np.floor(cells[0] / CELLS)
        rough = _merged(cells)
        rate = float(np.median(np.diff(rough[2]) / np.diff(rough[1]))) if rough.shape[1] > 1 else 0.0
        cells[[2, 5]] -= rate * cells[[1, 4]]
        seconds = _merged(cells)
        seconds[[2, 5]] += rate * seconds[[1, 4]]
        return seconds


def _merged(rows: Floats) -> Floats:
    """Return the rows (6, k) with one column for each number in the first row."""
    rows = rows[:, np.lexsort((rows[2], rows[0]))]
    first = np.flatnonzero(np.diff(rows[0], prepend=-np.inf))
    return np.concatenate([rows[:3, first], np.add.reduceat(rows[3:], first, axis=1)])


def fit_robot_clock(segment: int, arrivals: Arrivals) -> tuple[RobotClock, RobotClockReport]:
    """Return the clock of one segment of controller time and its report. ``arrivals`` must hold a reading."""
    second, dt, latency, n, dt_sum, latency_sum = arrivals.seconds()
    stamps = np.rint(1e9 * dt).astype(np.int64)
    host_ns = arrivals.host_ref_ns + stamps + latency.astype(np.int64)
    fitted = clocks.fit(stamps, host_ns, wander=SLEWED_WANDER)
    assert fitted is not None  # there is a row

    def offset_at(dt_s: Floats) -> Floats:
        t_ns = np.rint(1e9 * dt_s).astype(np.int64)
        return (fitted.to_time(t_ns)[0] - t_ns - arrivals.host_ref_ns).astype(np.float64)

    height, mean_height = latency - offset_at(dt), latency_sum / n - offset_at(dt_sum / n)
    nodes = arrivals.t_ref_s + dt[np.flatnonzero(np.diff(np.floor(dt / NODE_S), prepend=-np.inf))]
    nodes = np.concatenate([[arrivals.t_ref_s], nodes[1:], [arrivals.last_s]])
    nodes = nodes[np.append(np.diff(nodes) > 0.5 * NODE_S, True)]  # where readings are missing, nodes may be close
    nodes[0] = arrivals.t_ref_s
    around = np.searchsorted(dt, nodes[:, None] - arrivals.t_ref_s + [-AROUND_S, AROUND_S])
    bound = np.array([_bound(height[a:b], mean_height[a:b]) for a, b in around])
    half = np.flatnonzero(np.diff(np.floor(second / AROUND_S), prepend=-np.inf))
    report = RobotClockReport(
        segment=segment,
        readings=int(n.sum()),
        t_robot_s=(arrivals.t_ref_s, arrivals.last_s),
        rate_ppm=float(PPM.of(fitted.rate)),
        jitter_ns=float(np.median(np.add.reduceat(mean_height * n, half) / np.add.reduceat(n, half))),
        bound_ns=float(np.max(bound)),
    )
    return RobotClock(arrivals.t_ref_s, fitted, nodes, bound), report


def _bound(height: Floats, mean_height: Floats) -> float:
    """Return the bound [ns] from the heights of the fastest readings of some seconds, and of all of their readings."""
    typical = float(np.mean(height)) * math.sqrt(max(1.0, SECONDS / height.size))
    if height.size < 3:
        typical = float(np.mean(mean_height))
    lasting = float(np.max(np.min(sliding_window_view(height, min(RUN, height.size)), axis=1)))
    return max(2.0 * typical, TILTED * lasting) + 0.5e9 * DRIFT * AROUND_S**2 + ROUNDING_NS
