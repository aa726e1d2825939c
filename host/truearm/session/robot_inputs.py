"""When the controller's digital inputs changed, as its readings show it (hop 4).

A reading shows the inputs at its own instant. An edge lies between the last reading that shows the old level and the first that
shows the new one: two controller times, a cycle apart where no reading is missing.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from truearm.types import Floats

Ints = NDArray[np.int64]

UNKNOWN = -1  # inputs of a reading that does not say them
MOST_CHANGES = 1_000_000  # of a segment; a signal faster than that is none that edges can be told in


@dataclass(frozen=True)
class Changes:
    """Changes (k,) of one input in order: each lies between two controller times [s]; ``level`` is the new one."""

    before_s: Floats
    after_s: Floats
    level: NDArray[np.bool_]


@dataclass
class InputTrack:
    """Gathers the changes of one segment of controller time."""

    readings: int = 0  # that say their inputs
    count: int = 0
    _last: tuple[float, int] | None = None
    _times: list[Floats] = field(default_factory=list)  # (k, 2) before and after
    _bits: list[Ints] = field(default_factory=list)  # (k, 2)

    def add(self, t: Floats, bits: Ints) -> None:
        """Take readings (n,) in order of controller time [s]; ``bits`` UNKNOWN where one does not say them."""
        known = bits >= 0
        t, bits = t[known], bits[known]
        if not t.size:
            return
        self.readings += t.size
        if self._last is not None:
            t, bits = np.concatenate([[self._last[0]], t]), np.concatenate([[self._last[1]], bits])
        self._last = (float(t[-1]), int(bits[-1]))
        at = np.flatnonzero((bits[1:] != bits[:-1]) & (t[1:] > t[:-1]))[: MOST_CHANGES - self.count]
        if at.size:
            self.count += at.size
            self._times.append(np.stack([t[at], t[at + 1]], axis=1))
            self._bits.append(np.stack([bits[at], bits[at + 1]], axis=1))

    def inputs(self) -> list[int]:
        """The inputs that changed, ascending."""
        changed = 0
        for bits in self._bits:
            changed |= int(np.bitwise_or.reduce(bits[:, 0] ^ bits[:, 1]))
        return [k for k in range(63) if changed >> k & 1]

    def changes(self, number: int) -> Changes:
        """Those of one input."""
        times = np.concatenate(self._times or [np.empty((0, 2))])
        bits = np.concatenate(self._bits or [np.empty((0, 2), np.int64)]) >> number & 1
        of_it = bits[:, 0] != bits[:, 1]
        return Changes(times[of_it, 0], times[of_it, 1], bits[of_it, 1] == 1)
