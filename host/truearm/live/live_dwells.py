"""Detect dwells and lines as they are taken, for display, with their durations and sensor readings."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from truearm.live.standstill import JOINTS, SENSOR, StandstillDetector
from truearm.session.dwell_samples import DRIFT_SIGMAS, MICRON
from truearm.session.sample_noise import LEAST_LAGS, mean_of
from truearm.types import Floats
from truearm.units import NS

SETTLE_NS = 500_000_000  # discarded at the beginning of a rest
ENOUGH_NS = 1_600_000_000  # settling, a second of samples and the guard at the end, as in session.dwells
GUARD_NS = 100_000_000
BLOCKS = 20_000  # kept, a minute at 4 kHz
READINGS = 1000  # kept, two seconds at 500 Hz
LEAST_STROKE = 0.02  # m
LEAST_SPEED = 0.005  # m/s


class LiveDwell(NamedTuple):
    """A dwell: host times, the sensor's mean [m], noise of a sample [m] and drift [m]; NaN without samples.

    ``q``: None without a robot.
    """

    begin_ns: int
    end_ns: int
    mean: float
    noise: float
    drift: float
    settled: bool
    q: Floats | None


class ControllerTime:
    """Converts times of a separate clock to host time, using the fastest arrival so far.

    Arrivals come in bursts on a busy machine, which must not look like standing still. The remaining error is a latency
    and a drift of CREEP.
    """

    CREEP = 1e-4
    RESTART_NS = 1_000_000_000

    def __init__(self) -> None:
        self._offset_ns: float | None = None
        self._last_ns = 0

    def host_ns(self, own_ns: int, arrival_ns: int) -> int:
        """Return the host time of data stamped ``own_ns``. If that clock steps back by a second, the estimate is
        restarted.
        """
        offset = float(arrival_ns - own_ns)
        if self._offset_ns is not None and own_ns > self._last_ns - self.RESTART_NS:
            offset = min(offset, self._offset_ns + self.CREEP * max(0, own_ns - self._last_ns))
            own_last = max(own_ns, self._last_ns)  # one stream's block may begin before another's
        else:
            own_last = own_ns
        self._offset_ns, self._last_ns = offset, own_last
        return own_ns + int(offset)


class LiveDwells:
    """Detects dwells by the joints if there is a robot, else by the sensor alone.

    Times are host times of the measurements, not of their arrivals.
    """

    def __init__(self, with_robot: bool) -> None:
        self._with_robot = with_robot
        self._rest = StandstillDetector(*JOINTS) if with_robot else StandstillDetector(*SENSOR)
        self._blocks: deque[tuple[int, int, float, float]] = deque(maxlen=BLOCKS)  # time, n, mean, variance
        self._readings: deque[tuple[int, Floats]] = deque(maxlen=READINGS)

    def samples(self, t_ns: int, extension: Floats) -> LiveDwell | None:
        """Process samples (n,) [m] and return the dwell that they ended."""
        self._blocks.append((t_ns, extension.size, float(extension.mean()), float(extension.var())))
        if self._with_robot:
            return None
        low, high = extension.min(keepdims=True), extension.max(keepdims=True)
        return self._seen(self._rest.feed(t_ns, low, high))

    def joints(self, t_ns: int, q: Floats) -> LiveDwell | None:
        """Process a reading (j,) and return the dwell that it ended."""
        if self._readings and self._readings[-1][1].shape != q.shape:
            return None
        ended = self._seen(self._rest.feed(t_ns, q, q))
        self._readings.append((t_ns, q))
        return ended

    @property
    def standing_ns(self) -> int | None:
        """Return for how long it has stood still as of the last reading, after which nothing is known. None while it
        moves.
        """
        since_ns = self._rest.since_ns
        return None if since_ns is None else self._rest.last_ns - since_ns

    @property
    def q(self) -> Floats | None:
        """Return the last joints."""
        return self._readings[-1][1] if self._readings else None

    def under_way(self) -> LiveDwell | None:
        """Return the current dwell as if it ended with the last reading; None while it moves or if it is too short."""
        since_ns = self._rest.since_ns
        return None if since_ns is None else self._seen((since_ns, self._rest.last_ns))

    def _seen(self, rest: tuple[int, int] | None) -> LiveDwell | None:
        if rest is None or rest[1] - rest[0] < ENOUGH_NS:
            return None
        begin, end = rest[0] + SETTLE_NS, rest[1] - GUARD_NS
        q = next((q for t_ns, q in reversed(self._readings) if t_ns <= end), None)
        used = np.array([block for block in self._blocks if begin <= block[0] <= end]).reshape(-1, 4)
        if len(used) < 2 * LEAST_LAGS:
            return LiveDwell(*rest, float("nan"), float("nan"), float("nan"), False, q)
        mean = mean_of(used[:, 2])
        noise = float(np.sqrt(np.average(used[:, 3], weights=used[:, 1])))
        settled = abs(mean.drift) <= max(MICRON, DRIFT_SIGMAS * mean.drift_sigma)
        return LiveDwell(*rest, mean.mean, noise, mean.drift, settled, q)


class Strokes:
    """Detects lines driven past a line device by its longitudinal sensor, one for each direction."""

    def __init__(self) -> None:
        self._run: list[tuple[int, float]] = []  # first and last point of a run in one direction
        self._last: tuple[int, float] | None = None

    def feed(self, t_ns: int, position: float) -> tuple[float, float] | None:
        """Return length [m] and mean speed [m/s] of the stroke that ended with this position [m]."""
        last, self._last = self._last, (t_ns, position)
        if last is None or t_ns <= last[0]:
            return None
        speed = (position - last[1]) / NS.to_si(t_ns - last[0])
        moving = abs(speed) >= LEAST_SPEED
        if self._run:
            way = self._run[-1][1] - self._run[0][1]
            if moving and speed * way > 0:
                self._run[-1] = (t_ns, position)
                return None
            (t0, x0), (t1, x1) = self._run
            self._run = []
            if abs(x1 - x0) >= LEAST_STROKE:
                return abs(x1 - x0), abs(x1 - x0) / NS.to_si(t1 - t0)
        if moving:
            self._run = [last, (t_ns, position)]
        return None
