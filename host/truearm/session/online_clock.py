"""Device time ↔ host time while a session is being recorded: what the exchanges of the last minute say of now.

The same fit as afterwards (``clock``), over the one window that ends with the newest exchange; so its bound rests on the same
assumptions, and wherever both are asked their bounds overlap. What the fit afterwards adds is the other side: exchanges
that come later. An estimate takes some ms where the clock is steady; memory does not grow.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from truearm.session.box_messages import Exchange
from truearm.session.device_clock_fit import WINDOW_US, fit_clock
from truearm.units import PPM

MOST_EXCHANGES = 480  # at 4 Hz a window has 240; somebody who probes faster gets a shorter one
LEAST_EXCHANGES = 3


@dataclass(frozen=True)
class OnlineEstimate:
    """The clock at the newest exchange. Times in ns."""

    device_us: int
    offset_ns: int  # host − device there
    rate_ppm: float  # how much faster the host counts than the device
    bound_ns: float  # of the offset's error
    half_asymmetry_ns: float  # half the shortest round trip: no exchange can show it, the bound contains it
    rtt_min_ns: int
    exchanges: int
    rejected: int


class OnlineClock:
    """Takes the exchanges as they come. Device time that steps back is a box that restarted: what was before it is forgotten."""

    def __init__(self) -> None:
        self._window: deque[Exchange] = deque(maxlen=MOST_EXCHANGES)

    def add(self, t0_ns: int, t1_us: int, t2_us: int, t3_ns: int) -> None:
        """One answered exchange: host before writing, device received, device sent, host arrival."""
        window = self._window
        if window and t1_us < window[-1].t1_us:
            window.clear()
        window.append(Exchange(t0_ns, t1_us, t2_us, t3_ns))
        while window[0].t1_us < t1_us - WINDOW_US:
            window.popleft()

    def estimate(self) -> OnlineEstimate | None:
        """What is known at the newest exchange; None before the third one, or where none of them can be used."""
        if len(self._window) < LEAST_EXCHANGES:
            return None
        fitted = fit_clock(0, self._window)
        if fitted is None:
            return None
        clock, report = fitted
        newest_us = self._window[-1].t1_us
        host, bound = clock.to_host_ns(np.array([newest_us]))
        return OnlineEstimate(
            device_us=newest_us,
            offset_ns=int(host[0]) - 1000 * newest_us,
            rate_ppm=PPM.of(clock.windows[-1].rate),
            bound_ns=float(bound[0]),
            half_asymmetry_ns=report.half_asymmetry_ns,
            rtt_min_ns=report.rtt_min_ns,
            exchanges=report.exchanges,
            rejected=report.rejected,
        )
