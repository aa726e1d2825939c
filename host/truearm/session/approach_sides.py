"""From which side each joint came to its place: its links lie behind its encoder by half the backlash on that side."""

from __future__ import annotations

import numpy as np

from truearm.session.dwells import Dwell
from truearm.session.joint_readings import Bins
from truearm.types import Floats

LEAST = 5e-4  # rad or m; a joint that moved less has come from nowhere: a swing about its place is no approach
BACK_BINS = 200  # how far back the last motion is looked for: 10 s


def came_from(bins: Bins, dwell: Dwell) -> Floats:
    """Direction (j,) of the last motion of each joint before a dwell: −1 or 1, 0 where it did not move or nobody knows."""
    direction = np.zeros(dwell.q.size)
    last = dwell.bins[0]
    while last > 0 and bins.t_first_s[last - 1] >= dwell.stood_s and bins.segment[last - 1] == dwell.segment:
        last -= 1
    for k in range(last - 1, max(-1, last - 1 - BACK_BINS), -1):
        if bins.gap[k + 1] or bins.segment[k] != dwell.segment or np.all(direction):
            break
        above, below = bins.high[k] - dwell.q, dwell.q - bins.low[k]
        new = (direction == 0.0) & (np.maximum(above, below) > LEAST)
        direction[new] = np.where(above > below, -1.0, 1.0)[new]
    return direction
