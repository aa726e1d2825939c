"""Detect during recording whether something stands still: the joints, or a sensor alone if there are no joint readings.

This is for display only; the dwells that are used are found afterwards (``dwell``), by the same rule. In windows of 0.2
s, the range of readings at rest is taken as three times that of the quietest tenth of the last minute. Before anything
has rested, motion could pass for rest, so the threshold never exceeds ``most``.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from truearm.session.dwells import QUIET_FACTOR, QUIET_SHARE, WINDOW_BINS
from truearm.types import Floats

BIN_NS = 50_000_000
GAP_NS = 300_000_000  # after such a gap the state is not known
REMEMBERED = 1200  # bins kept, a minute
JOINTS = (1e-6, 1e-3)  # rad or m: least and most range of a window at rest
SENSOR = (1e-6, 5e-5)  # m


class StandstillDetector:
    """Takes readings (k,), or the extremes of short blocks of them, in order of time.

    ``since_ns``: start of the current rest; ``last_ns``: time of the last reading.
    """

    def __init__(self, least: float, most: float) -> None:
        self.since_ns: int | None = None
        self._least, self._most = least, most
        self._bin: tuple[int, Floats, Floats] | None = None  # begin, low, high
        self._window: deque[tuple[int, Floats, Floats]] = deque(maxlen=WINDOW_BINS)
        self._ranges: deque[Floats] = deque(maxlen=REMEMBERED)
        self.last_ns = 0

    def feed(self, t_ns: int, low: Floats, high: Floats) -> tuple[int, int] | None:
        """Return begin and end of the rest that ended, if one did."""
        ended = None
        if self._bin is not None and t_ns - self.last_ns > GAP_NS:
            ended = self._end(self.last_ns)
            self._bin = None
            self._window.clear()
        elif self._bin is not None and t_ns - self._bin[0] >= BIN_NS:
            ended = self._close(self._bin)
            self._bin = None
        if self._bin is None:
            self._bin = t_ns, low, high
        else:
            self._bin = self._bin[0], np.minimum(self._bin[1], low), np.maximum(self._bin[2], high)
        self.last_ns = t_ns
        return ended

    def _close(self, whole: tuple[int, Floats, Floats]) -> tuple[int, int] | None:
        self._window.append(whole)
        if len(self._window) < WINDOW_BINS:
            return None
        lows, highs = np.array([b[1] for b in self._window]), np.array([b[2] for b in self._window])
        spread = highs.max(axis=0) - lows.min(axis=0)
        self._ranges.append(spread)
        rest = QUIET_FACTOR * np.quantile(np.array(self._ranges), QUIET_SHARE, axis=0)
        if np.all(spread <= np.clip(rest, self._least, self._most)):
            self.since_ns = self._window[0][0] if self.since_ns is None else self.since_ns
            return None
        return self._end(whole[0])

    def _end(self, t_ns: int) -> tuple[int, int] | None:
        if self.since_ns is None:
            return None
        begin, self.since_ns = self.since_ns, None
        return begin, t_ns
