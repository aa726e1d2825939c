"""Device time → host time by lines in overlapping windows, each with all lines that the exchanges allow (see ``clock``)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from truearm.types import Floats

Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Window:
    """host = host_ref_ns + dx + offset_ns + rate · dx, dx = 1000 · (device − device_ref_us)."""

    device_ref_us: int
    host_ref_ns: int
    offset_ns: float
    rate: float
    lines: Floats  # (v, 2) offset_ns and rate of the corners of all lines that keep to the bounds
    margin_ns: float
    centre_us: int
    rejected_us: tuple[int, ...]  # t1 of the exchanges that were left out

    def to_host_ns(self, t_us: Ints) -> tuple[Ints, Floats]:
        """Host times [ns] of device times (n,) and how far they may be off [ns]."""
        whole = 1000 * (t_us - self.device_ref_us)  # exact; only what is small becomes a float
        dx = whole.astype(np.float64)
        correction = self.offset_ns + self.rate * dx
        others = self.lines[:, :1] + self.lines[:, 1:] * dx
        bound = np.max(np.abs(others - correction), axis=0)
        return self.host_ref_ns + whole + np.rint(correction).astype(np.int64), bound


@dataclass(frozen=True)
class DeviceClock:
    """The clock of one segment: windows by ascending centre."""

    segment: int
    windows: tuple[Window, ...]

    def to_host_ns(self, t_us: Ints) -> tuple[Ints, Floats]:
        """Host times [ns] of device times (n,) [µs] and the bound of each one's error [ns].

        Beyond the exchanges the outer windows are continued; the bound grows as it must.
        """
        t_us = np.asarray(t_us, dtype=np.int64)
        centres = np.array([window.centre_us for window in self.windows])
        left = np.clip(np.searchsorted(centres, t_us, side="right") - 1, 0, len(centres) - 1)
        host, bound = np.empty(t_us.shape, np.int64), np.empty(t_us.shape)
        for k in np.unique(left):
            at = left == k
            host[at], bound[at] = self._between(int(k), t_us[at])
        return host, bound

    def _between(self, k: int, t_us: Ints) -> tuple[Ints, Floats]:
        host, bound = self.windows[k].to_host_ns(t_us)
        if k + 1 == len(self.windows):
            return host, bound
        start, end = self.windows[k].centre_us, self.windows[k + 1].centre_us
        weight = np.clip((t_us - start) / (end - start), 0.0, 1.0)
        next_host, next_bound = self.windows[k + 1].to_host_ns(t_us)
        apart = (next_host - host).astype(np.float64)
        blended = bound + weight * (next_bound - bound)
        # Windows that contradict each other: one of them is right, which one is not known.
        torn = np.maximum(bound + weight * np.abs(apart), next_bound + (1.0 - weight) * np.abs(apart))
        blended = np.where(np.abs(apart) > bound + next_bound, torn, blended)
        return host + np.rint(weight * apart).astype(np.int64), blended
