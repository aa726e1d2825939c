"""The clocks of a simulation: the box's crystal and that of the robot's controller.

True time t [s] starts at 0 with the simulation and is also the host's clock. A clock reads

    reading(t) = offset + t + ppm·10⁻⁶·t + wander·(1 − cos 2πt/period),

with a constant rate error and a slow one, like that of a crystal that warms up and cools down. The rate differs from 1
by less than 10⁻³, so ``t ← t − (reading(t) − r)`` contracts by that factor, and four steps invert a reading to the last
bits.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Clock:
    """A clock: reading at t = 0 [s], rate error [ppm], amplitude [s] and period [s] of its slow wander."""

    offset: float = 0.0
    ppm: float = 0.0
    wander: float = 0.0
    wander_period: float = 1800.0

    def reading(self, t: Any) -> Any:
        """Return the reading of the clock [s] at true time t [s]; scalars or arrays."""
        angle = 2.0 * np.pi / self.wander_period * t
        slow = self.wander * (
            1.0 - (math.cos(angle) if type(angle) is float else np.cos(angle))
        )  # NumPy takes three times as long
        return self.offset + (t + (1e-6 * self.ppm * t + slow))

    def true(self, reading: Any) -> Any:
        """Return the true time t [s] at which the clock reads ``reading`` [s]: the inverse of :meth:`reading`."""
        t = reading - self.offset
        for _ in range(4):
            t = t - (self.reading(t) - reading)
        return t

    def from_true_ns(self, t_ns: int) -> int:
        """Return the reading [ns] at true time ``t_ns``, to the nearest nanosecond for times below a month."""
        return round(1e9 * float(self.reading(1e-9 * t_ns)))

    def to_true_ns(self, reading_ns: int) -> int:
        """Return the true time [ns] at which the clock reads ``reading_ns``."""
        return round(1e9 * float(self.true(1e-9 * reading_ns)))


@dataclass(frozen=True)
class Clocks:
    """The clocks of the box and the robot."""

    device: Clock
    robot: Clock


def draw_clocks(seed: int) -> Clocks:
    """Return random clocks: crystals within ±30 ppm, and that of the box wanders by 0.3 ppm as its case warms up."""
    rng = np.random.default_rng([seed, 0xC10C])
    ppm = rng.uniform(-30.0, 30.0, 2)
    period = 1800.0
    wander = 0.3e-6 * period / (2.0 * np.pi)
    return Clocks(
        device=Clock(float(rng.uniform(1.0, 20.0)), float(ppm[0]), wander, period),
        robot=Clock(float(rng.uniform(1e2, 1e4)), float(ppm[1])),
    )
