"""How an arm moves, how its links come to rest and how far they are from what the joints read; the default arm is a stiff PUMA 560.

A worn arm's links lie behind their encoders by half the backlash, on the side that they come from. A slow arm's joints are short
of their place when the commanded motion ends and come up exponentially, encoders and all. A limber arm's links swing on while
the encoders stand. The noise of a reading belongs to the reading: a pure function of seed, joint and the reading's number.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from truearm.types import Floats
from truearm_sim.joint_errors import JointError

PUMA_SPEED = tuple(np.deg2rad([82.0, 54.0, 122.0, 228.0, 241.0, 228.0]).tolist())  # rad/s
PUMA_ACCELERATION = (4.0, 4.0, 6.0, 15.0, 15.0, 15.0)  # rad/s²
BLOCK = 4096  # readings whose noise is drawn together
_NOISE = 16  # of the generators; the sensors have those below


@dataclass(frozen=True)
class Arm:
    """What of an arm differs from a stiff and quick one, each joint alike but for backlash and speed."""

    backlash: tuple[float, ...] = ()  # rad, of each joint; none: 0
    lag: float = 0.0  # rad, by which a joint that moved is short of its place on arrival
    lag_s: float = 0.25  # in which it comes up by a factor e
    swing: float = 0.0  # rad, amplitude of a link that moved beyond its encoder, from arrival on
    swing_hz: float = 4.0
    swing_s: float = 0.15  # in which the swing dies down by a factor e
    reading_sigma: float = 0.0  # rad, noise of a joint reading
    speed: tuple[float, ...] = PUMA_SPEED  # rad/s (m/s), of each joint at most
    acceleration: tuple[float, ...] = PUMA_ACCELERATION  # rad/s² (m/s²)
    errors: tuple[JointError, ...] = ()  # of the joints beyond geometry

    def rest_s(self, quick: float) -> float:
        """Time after arrival [s] at which all has died down by e⁻¹⁰; ``quick``: that of the stiff arm."""
        return max(quick, 10.0 * self.lag_s * (self.lag > 0.0), 10.0 * self.swing_s * (self.swing > 0.0))

    def behind(self, direction: Floats) -> Floats:
        """How far the links (m, j) stand from their encoders after motion in these directions (m, j) of −1, 0 or 1."""
        half = 0.5 * np.array(self.backlash or (0.0,))
        return np.asarray(-half * direction)

    def apart(self, q: Floats) -> Floats:
        """How far the links (k, j) stand from their encoders at readings q (k, j), by what depends on the joints alone."""
        return np.asarray(sum((error.at(q) for error in self.errors), np.zeros(q.shape)))

    def durations(self, delta: Floats) -> Floats:
        """Shortest durations (n,) [s] of quintics over delta (n, j) [rad, m]."""
        size, j = np.abs(delta), delta.shape[1]
        by_speed = 15.0 / 8.0 * size / np.array(self.speed[:j])
        by_acceleration = np.sqrt(10.0 / np.sqrt(3.0) * size / np.array(self.acceleration[:j]))
        return np.asarray(np.maximum(by_speed, by_acceleration).max(axis=1))

    def short(self, since: Floats, share: Floats) -> Floats:
        """How far the joints (k,) are from their place, of motion by +1, ``since`` arrival [s]; before, by the share of the way."""
        return np.asarray(-self.lag * np.where(since > 0.0, np.exp(-since / self.lag_s), share))

    def swinging(self, since: Floats) -> Floats:
        """How far the links (k,) are beyond their encoders, of motion by +1, ``since`` arrival [s]; 0 before."""
        wave = np.exp(-since / self.swing_s) * np.sin(2.0 * np.pi * self.swing_hz * since)
        return np.asarray(self.swing * np.where(since > 0.0, wave, 0.0))

    def reading_noise(self, seed: int, numbers: NDArray[np.int64], joints: int) -> Floats:
        """Noise (k, j) of the readings of ascending numbers (k,), any chunks alike."""
        noise = np.zeros((numbers.size, joints))
        if self.reading_sigma:
            for block in np.unique(numbers // BLOCK):
                here = numbers // BLOCK == block
                bits = np.random.Philox(key=seed, counter=[0, int(block), _NOISE, 0])
                drawn = np.random.Generator(bits).standard_normal((BLOCK, joints))
                noise[here] = self.reading_sigma * drawn[numbers[here] - block * BLOCK]
        return noise


# Backlash of a gear or two that should be replaced, brakes that let go late, links that swing on, encoders with noise.
WORN = Arm(
    backlash=(4e-4, 2e-4, 3e-4, 5e-4, 2e-4, 8e-4), lag=3e-4, lag_s=0.05, swing=1e-4, swing_s=0.05, reading_sigma=2e-5
)


def last_direction(delta: Floats) -> Floats:
    """Sign (m, j) of the last motion of each joint up to and with each move (m, j); 0 before the first."""
    moved = np.where(delta != 0.0, np.arange(len(delta))[:, None], -1)
    latest = np.maximum.accumulate(moved, axis=0)
    signs = np.sign(np.take_along_axis(delta, np.maximum(latest, 0), axis=0))
    return np.asarray(np.where(latest >= 0, signs, 0.0))
