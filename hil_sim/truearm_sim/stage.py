"""A stage in place of the arm: all sensors follow a carriage moved by hand, to rehearse ``truearm box gauge``.

The sensors' true calibrations differ from those stored in the box, and a gauging must find them: their zero and gain
are random, from the seed, and the LVDT and the transverse transducers are bent. The carriage takes time to move:
samples taken immediately show a moving sensor.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from truearm.types import Floats
from truearm_sim import sensors
from truearm_sim.robot import States, quintic
from truearm_sim.world import MAG_MIDDLE, MAG_PERIOD_NS, Level, Setup, World, standard_plan

SPEED = 0.02  # m/s, at the middle of a move
SETTLE_S = 0.3  # of the shortest move
LARGEST = 0.04  # m, in either direction
_CURVES = 0x57A6E  # of their random numbers, in addition to the seed


@dataclass(frozen=True)
class Curve:
    """A sensor's true curve: position [m] = zero + gain·V + bend·V²."""

    zero: float
    gain: float
    bend: float

    def volts(self, position: Floats) -> Floats:
        """Return the voltage (m,) at positions (m,): the root near V = (position − zero)/gain."""
        rest = position - self.zero
        return np.asarray(2.0 * rest / (self.gain + np.sqrt(self.gain**2 + 4.0 * self.bend * rest)))


def drawn_curve(poly: sensors.Poly, rng: np.random.Generator) -> Curve:
    """Return a random curve near the box's data: zero to 0.2 mm, gain to 0.5 %, bent by 0.1 % of the gain at 1 V."""
    zero, gain = (mantissa * 10.0**exponent for mantissa, exponent in poly)
    a, b, c = rng.standard_normal(3)
    return Curve(zero + 2e-4 * a, gain * (1.0 + 5e-3 * b), 1e-3 * gain * np.copysign(0.5 + abs(c), c))


class Stage(World):
    """A world with a carriage set by hand. Its box samples the carriage's position from the time it is set."""

    def __init__(self, seed: int) -> None:
        super().__init__(seed, standard_plan(9, seed), setup=Setup(mag_period_ns=MAG_PERIOD_NS))
        rng = np.random.default_rng([seed, _CURVES])
        self.curves = [drawn_curve(poly, rng) for poly in (sensors.POLY, *sensors.TRANSVERSE_POLY)]
        self.speed_of_sound = sensors.SOUND * (1.0 + 2e-3 * rng.standard_normal())
        self.now_s = 0.0
        self._moves = [(0.0, 1.0, 0.0, 0.0)]  # begin and end [s], from and to [m]

    def move_to(self, position: float) -> None:
        """Set the carriage [m]: it starts at once. Raises ValueError beyond LARGEST."""
        if not abs(position) <= LARGEST:
            raise ValueError(position)
        here = float(self.position(np.array([self.now_s]))[0])
        seconds = max(SETTLE_S, 15.0 / 8.0 * abs(position - here) / SPEED)
        self._moves.append((self.now_s, self.now_s + seconds, here, position))

    def position(self, t: Floats) -> Floats:
        """Return the position of the carriage (m,) [m] at true times t (m,)."""
        begin, end, origin, target = np.array(self._moves).T
        i = np.maximum(np.searchsorted(begin, t, side="right") - 1, 0)
        share = np.clip((t - begin[i]) / (end[i] - begin[i]), 0.0, 1.0)
        return np.asarray(origin[i] + quintic(share) * (target[i] - origin[i]))

    def counts(self, k0: int, k1: int, t_start_device_ns: int, period: int) -> NDArray[np.int32]:
        """See ``World.counts``."""
        device_ns = t_start_device_ns + np.arange(k0, k1, dtype=np.int64) * period
        shown_ns = device_ns - sensors.group_delay_ns(period // sensors.MODULATOR_NS)
        position = self.position(self.clocks.device.true(1e-9 * shown_ns))
        sigma = (sensors.SAMPLE_SIGMA / self.curves[0].gain, *sensors.RESTING_SIGMA[1:])
        volts = np.empty((k1 - k0, len(sensors.CHANNELS)))
        for channel in range(len(sensors.CHANNELS)):
            still = channel >= len(self.curves)
            level = sensors.RESTING_VOLTS[channel] if still else self.curves[channel].volts(position)
            volts[:, channel] = level + sigma[channel] * _noise(self.seed, channel, k0, k1)
        return sensors.counts_of_volts(volts)

    def flight_times(self, k0: int, k1: int, t_start_device_ns: int, period_ns: int) -> NDArray[np.int64]:
        """See ``World.flight_times``."""
        device_ns = t_start_device_ns + np.arange(k0, k1, dtype=np.int64) * period_ns
        position = MAG_MIDDLE + self.position(self.clocks.device.true(1e-9 * device_ns))
        noise = sensors.MAG_SIGMA_PS * _noise(self.seed, len(sensors.CHANNELS) + 1, k0, k1)
        return np.rint(1e12 / self.speed_of_sound * position + 1e3 * sensors.MAG_DELAY_NS + noise).astype(np.int64)

    def robot_lines(self, t0_ns: int, t1_ns: int, level: Level | None = None) -> tuple[NDArray[np.int64], list[bytes]]:
        """Return no lines, as there is no robot; record the lab's time, at which the carriage is set."""
        self.now_s = 1e-9 * t1_ns
        return np.zeros(0, np.int64), []

    def robot_states(self, t0_ns: int, t1_ns: int, level: Level | None = None) -> States:
        """See ``robot_lines``."""
        self.now_s = 1e-9 * t1_ns
        return self.controller.states(0.0, 0.0)

    @property
    def robot_end_ns(self) -> int:
        """Return a time that is never reached: whoever sets the carriage ends the program."""
        return 1 << 62


def _noise(seed: int, channel: int, k0: int, k1: int) -> Floats:
    """Return standard normal numbers (k1 − k0,) of samples k0 ≤ k < k1."""
    first, last = k0 // sensors.BLOCK, (k1 - 1) // sensors.BLOCK
    drawn = np.concatenate([_block(seed, channel, block) for block in range(first, last + 1)])
    return np.asarray(drawn[k0 - first * sensors.BLOCK : k1 - first * sensors.BLOCK])


@lru_cache(maxsize=16)
def _block(seed: int, channel: int, block: int) -> Floats:
    return sensors.sample_noise(seed, channel, block)
