"""The motion of an arm: how its links come to rest and deviate from the joint readings.

The default is a stiff PUMA 560.

A worn arm's links lag their encoders by half the backlash, on the side they come from. A slow arm's joints have not
reached their target when the commanded motion ends, and approach it exponentially, including their encoders. The links
of a compliant arm continue to swing while the encoders are at rest. The noise of a reading belongs to the reading: it
is a pure function of seed, joint and the number of the reading.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from truearm.types import Floats
from truearm_sim.joint_errors import JointError

PUMA_SPEED = tuple(np.deg2rad([82.0, 54.0, 122.0, 228.0, 241.0, 228.0]).tolist())  # rad/s
PUMA_ACCELERATION = (4.0, 4.0, 6.0, 15.0, 15.0, 15.0)  # rad/s²
BLOCK = 4096  # readings whose noise is generated together
_NOISE = 16  # of the generators; the sensors have the lower numbers


@dataclass(frozen=True)
class Arm:
    """How an arm differs from a stiff and quick one; every joint is the same except for backlash and speed."""

    backlash: tuple[float, ...] = ()  # rad, of each joint; none: 0
    lag: float = 0.0  # rad, remaining distance to the target on arrival, for a joint that moved
    lag_s: float = 0.25  # time constant of the approach
    swing: float = 0.0  # rad, amplitude of a link beyond its encoder from arrival on, if it moved
    swing_hz: float = 4.0
    swing_s: float = 0.15  # time constant of the decay of the swing
    reading_sigma: float = 0.0  # rad, noise of a joint reading
    speed: tuple[float, ...] = PUMA_SPEED  # maximum rad/s (m/s) of each joint
    acceleration: tuple[float, ...] = PUMA_ACCELERATION  # rad/s² (m/s²)
    errors: tuple[JointError, ...] = ()  # of the joints beyond geometry

    def rest_s(self, quick: float) -> float:
        """Return the time after arrival [s] until everything has decayed by e⁻¹⁰; ``quick``: that of the stiff arm."""
        return max(quick, 10.0 * self.lag_s * (self.lag > 0.0), 10.0 * self.swing_s * (self.swing > 0.0))

    def behind(self, direction: Floats) -> Floats:
        """Return the offset of the links (m, j) from their encoders after motion in directions (m, j) of −1, 0 or 1."""
        half = 0.5 * np.array(self.backlash or (0.0,))
        return np.asarray(-half * direction)

    def apart(self, q: Floats) -> Floats:
        """Return the offset of the links (k, j) from their encoders at readings q (k, j), by joint errors alone."""
        return np.asarray(sum((error.at(q) for error in self.errors), np.zeros(q.shape)))

    def durations(self, delta: Floats) -> Floats:
        """Return the shortest durations (n,) [s] of quintics over delta (n, j) [rad, m]."""
        size, j = np.abs(delta), delta.shape[1]
        by_speed = 15.0 / 8.0 * size / np.array(self.speed[:j])
        by_acceleration = np.sqrt(10.0 / np.sqrt(3.0) * size / np.array(self.acceleration[:j]))
        return np.asarray(np.maximum(by_speed, by_acceleration).max(axis=1))

    def short(self, since: Floats, share: Floats) -> Floats:
        """Return the remaining distance (k,) to the target, for motion by +1, ``since`` arrival [s].

        Before it, by ``share``.

        ``share`` is the share of the path covered.
        """
        if not self.lag:
            return np.zeros(since.shape)
        return np.asarray(-self.lag * np.where(since > 0.0, np.exp(-since / self.lag_s), share))

    def swinging(self, since: Floats) -> Floats:
        """Return how far the links (k,) are beyond their encoders, for motion by +1, ``since`` arrival [s], or 0."""
        if not self.swing:
            return np.zeros(since.shape)
        wave = np.exp(-since / self.swing_s) * np.sin(2.0 * np.pi * self.swing_hz * since)
        return np.asarray(self.swing * np.where(since > 0.0, wave, 0.0))

    def reading_noise(self, seed: int, numbers: NDArray[np.int64], joints: int) -> Floats:
        """Return the noise (k, j) of the readings with ascending numbers (k,), the same for any chunks."""
        noise = np.zeros((numbers.size, joints))
        if self.reading_sigma:
            for block in np.unique(numbers // BLOCK):
                here = numbers // BLOCK == block
                bits = np.random.Philox(key=seed, counter=[0, int(block), _NOISE, 0])
                drawn = np.random.Generator(bits).standard_normal((BLOCK, joints))
                noise[here] = self.reading_sigma * drawn[numbers[here] - block * BLOCK]
        return noise


# Backlash of a gear or two that should be replaced, brakes that release late, links that keep swinging, noisy encoders.
WORN = Arm(
    backlash=(4e-4, 2e-4, 3e-4, 5e-4, 2e-4, 8e-4), lag=3e-4, lag_s=0.05, swing=1e-4, swing_s=0.05, reading_sigma=2e-5
)


def last_direction(delta: Floats) -> Floats:
    """Return the sign (m, j) of each joint's latest motion up to and including each move (m, j); 0 before the first."""
    moved = np.where(delta != 0.0, np.arange(len(delta))[:, None], -1)
    latest = np.maximum.accumulate(moved, axis=0)
    signs = np.sign(np.take_along_axis(delta, np.maximum(latest, 0), axis=0))
    return np.asarray(np.where(latest >= 0, signs, 0.0))
