"""Estimate the box's temperature during a measurement from its heartbeats.

The sensor is the microcontroller's own. It has a resolution of half a degree and an accuracy of a few degrees, but it
follows the box as the box warms up. Averaging over two minutes smooths the steps; a box changes by less than one step
in that time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from truearm.session.device_clock import DeviceClock
from truearm.types import Floats, Ints
from truearm.units import MDEGC

AROUND_NS = 60_000_000_000  # on each side
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
        k = np.clip(np.searchsorted(self.t_host_ns, t_host_ns), 1, max(len(self.degc) - 1, 1))
        away = np.abs(self.t_host_ns[[np.minimum(k, len(self.degc) - 1), k - 1]] - t_host_ns).min(axis=0)
        begin = self.t_host_ns[0]
        found = np.interp(1e-9 * (t_host_ns - begin), 1e-9 * (self.t_host_ns - begin), self.degc)
        return np.where(away <= AROUND_NS, found, np.nan)


def box_temperature(
    heard: Mapping[int, Sequence[tuple[int, int]]], clocks: Mapping[int, DeviceClock]
) -> BoxTemperature:
    """Return the readings ``heard`` in each segment, given as device time [µs] and m°C.

    Readings of segments without a clock are left out.
    """
    times, degrees = [np.zeros(0, np.int64)], [np.zeros(0)]
    for segment, beats in heard.items():
        readings = [(t_us, mdegc) for t_us, mdegc in beats if COLDEST <= mdegc <= WARMEST]
        if segment in clocks and readings:
            t_us, mdegc = np.array(readings, dtype=np.int64).T
            times.append(clocks[segment].to_host_ns(t_us)[0])
            degrees.append(MDEGC.to_si(mdegc))
    t_host_ns, degc = np.concatenate(times), np.concatenate(degrees)
    order = np.argsort(t_host_ns, kind="stable")
    return BoxTemperature(t_host_ns[order], degc[order])
