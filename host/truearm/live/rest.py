"""Rests as they happen, for display. The dwells that are used are found afterwards.

Times are those of the source's own clock [s]: arrivals come in bursts on a busy machine, which must not look like
standing still.
"""

from __future__ import annotations

import numpy as np

from truearm.types import Floats

JOINT_RANGE, SENSOR_RANGE = 1e-3, 2e-4  # rad or m, and m: the readings of a rest lie within this
GAP_S = 0.3  # after such a gap the state is not known


class Rest:
    """The current rest of the joints or of a sensor, from ``begin_s`` to ``last_s``."""

    def __init__(self) -> None:
        self.begin_s = self.last_s = -np.inf
        self._extremes = np.empty((0, 0))

    def extend(self, t_s: float, values: Floats, most: float) -> bool:
        """Take readings (n, k); return False, and begin a new rest, if they came after a gap or the range of all since
        ``begin_s`` exceeds ``most``.
        """
        near = 0.0 <= t_s - self.last_s <= GAP_S
        together = np.vstack([self._extremes, values]) if near else values
        rests = near and bool(np.all(np.ptp(together, axis=0) <= most))
        if not rests:
            self.begin_s, together = t_s, values
        self.last_s, self._extremes = t_s, np.array([together.min(axis=0), together.max(axis=0)])
        return rests

    @property
    def duration_s(self) -> float:
        """Duration as of the last reading, after which nothing is known."""
        return self.last_s - self.begin_s
