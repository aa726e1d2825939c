"""The readings of the box's converter and magnetostrictive head: lengths to counts and times, with noise.

The LVDT's conditioner turns the bar's extension e [m] into a voltage with e = POLY[0] + POLY[1]·V, which is known from
the box's calibration. The converter has 24 bits over ±1.2 V; beyond that it saturates. While the bar is off, the core
hangs out of the coil and the input is at the negative rail.

Noise is a pure function of seed, channel and sample index. Sample k is number k mod BLOCK of block k div BLOCK, and
each block has its own counter-based generator (Philox) with the seed as key and channel and block in the counter. Any
chunks that a reader requests therefore contain the same values.

At a line device the conditioners of the transverse transducers produce a voltage in the same way. If the magnet is out
of their range, they too are at the negative rail, and the head finds no pulse.

The magnetostrictive head sends a strain pulse from the magnet along its wire. Its time of flight is position / v plus
the delay of the electronics, with v = 25.4 mm / (US_PER_INCH µs), and the position is that at the interrogation edge.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from truearm.types import Floats

Poly = tuple[tuple[int, int], ...]

CHANNELS = ("lvdt", "transverse_a", "transverse_b", "excitation")
SCALE = (1430511474609375, -22)  # mantissa and exponent, V per count: 1.2 V / 2^23, exactly
VOLTS_PER_COUNT = 1.2 / 2**23
COUNTS_MIN, COUNTS_MAX = -(2**23), 2**23 - 1
POLY = ((-4213, -7), (378812, -7))  # m and m/V, mantissa and exponent: zero −0.42 mm, gain 37.9 mm/V
TRANSVERSE_POLY = (((118, -6), (7163, -6)), ((-73, -6), (7091, -6)))  # m and m/V of each, 7.5 mm at about 1.05 V
SAMPLE_SIGMA = 3e-6  # m, of the LVDT's samples
RESTING_VOLTS = np.array([0.0, 0.3127, -0.1184, 0.7501])  # transducers without contact, excitation reference
RESTING_SIGMA = np.array([0.0, 18e-6, 18e-6, 9e-6])  # V
BLOCK = 8192
MODULATOR_NS = 240  # 125 MHz / 15 = 8.333 MHz, two clocks per modulator period
OSRS = tuple(2**k for k in range(7, 15))
US_PER_INCH = (905, -2)  # mantissa and exponent, as on the sensor's label
SOUND = 25400.0 / 9.05  # m/s
MAG_DELAY_NS = 1200  # of the head's electronics
# 5.1 µm. The counter's tick is 22.5 µm. This noise spreads a resting magnet across tick boundaries, so that the error
# of the mean of many shots is at most (tick/π)·exp(−2π²·(σ/tick)²) = 2.6 µm; without noise it would be half a tick.
MAG_SIGMA_PS = 1800
TICK_PS = 8000  # of the counter that measures the flight
# Generators in addition to those of the converter's channels 0 to 3 and of the repeatability, 4.
_MAG_NOISE, _MAG_STOPS = 5, 6


def period_ns(osr: int) -> int:
    """Return the converter's sample period: 983,040 ns at oversampling 4096.

    Raises ValueError unless osr is in OSRS.
    """
    if osr not in OSRS:
        raise ValueError(f"oversampling must be one of {OSRS}, is {osr}")
    return osr * MODULATOR_NS


def group_delay_ns(osr: int) -> int:
    """Return the age of the signal in a sample at its time stamp (ADS131M04 datasheet, digital filter).

    The filter is a sinc³ of up to 1024 modulator periods, and above that an average of its outputs.
    """
    sinc = min(osr, 1024)
    return MODULATOR_NS * (3 * (sinc - 1) + (osr - sinc)) // 2


CALIBRATED_MDEGC = 24_500  # temperature of the box at the calibration of its LVDT


def calibration(poly: Poly = POLY, serial: str = "sim-lvdt") -> dict[str, Any]:
    """Return the calibration of a channel in the box's ident, the LVDT's by default (protocol/SPEC.md §5)."""
    return {"unit": "m", "poly": [list(pair) for pair in poly], "serial": serial, "date": "2026-01-01"}


def sample_noise(seed: int, channel: int, block: int) -> Floats:
    """Return standard normal numbers (BLOCK,) for one block of samples."""
    # The key has 128 bits, the counter 256; a block uses far fewer than the 2^64 counts between its neighbours.
    bits = np.random.Philox(key=seed, counter=[0, block, channel, 0])
    return np.random.Generator(bits).standard_normal(BLOCK)


def flight_times(position: Floats, lost: float, seed: int, block: int) -> NDArray[np.int64]:
    """Return times of flight (BLOCK,) [ps] of one block of shots at magnet positions (BLOCK,) [m].

    −1, no stop pulse, for a share ``lost`` of them and where the position is NaN.
    """
    flights = 1e12 / SOUND * position + 1e3 * MAG_DELAY_NS + MAG_SIGMA_PS * sample_noise(seed, _MAG_NOISE, block)
    bits = np.random.Philox(key=seed, counter=[0, block, _MAG_STOPS, 0])
    stopless = np.random.Generator(bits).random(BLOCK) < lost
    return np.where(stopless | np.isnan(position), -1, np.rint(flights)).astype(np.int64)


def magnetostrictive(period_ns: int) -> dict[str, Any]:
    """Return the head's entry in the box's configuration, for readings at this period; 0: never."""
    return {
        "period_ns": period_ns,
        "blanking_ns": 10_000,
        "timeout_ns": 240_000 if period_ns and period_ns < 510_000 else 500_000,
        "us_per_inch": list(US_PER_INCH),
        "delay_ns": MAG_DELAY_NS,
        "serial": "sim-mag",
        "date": "2026-01-01",
    }


def repeatability(seed: int, n: int) -> Floats:
    """Return standard normal numbers (n,), one per dwell; the first m are the same for every n ≥ m."""
    return np.random.Generator(np.random.Philox(key=seed, counter=[0, 0, len(CHANNELS), 0])).standard_normal(n)


def volts_of_extension(extension: Floats, poly: Poly = POLY) -> Floats:
    """Return a conditioner's output [V] for its measurand [m], the bar's extension by default."""
    zero, gain = (mantissa * 10.0**exponent for mantissa, exponent in poly)
    return (extension - zero) / gain


def counts_of_volts(volts: Floats) -> NDArray[np.int32]:
    """Return the converter's counts, with saturation."""
    return np.clip(np.rint(volts / VOLTS_PER_COUNT), COUNTS_MIN, COUNTS_MAX).astype(np.int32)


def sample_counts(extension: Floats, seed: int, block: int, transverse: Floats | None = None) -> NDArray[np.int32]:
    """Return counts (BLOCK, 4) of one block for the bar's true extensions (BLOCK,) [m], NaN while the bar is off.

    ``transverse`` (BLOCK, 2) [m]: the magnet at the transverse transducers, NaN out of range; without it they rest.
    """
    volts = np.empty((BLOCK, len(CHANNELS)))
    noisy = extension + SAMPLE_SIGMA * sample_noise(seed, 0, block)
    volts[:, 0] = np.where(np.isnan(extension), COUNTS_MIN * VOLTS_PER_COUNT, volts_of_extension(noisy))
    for channel in range(1, len(CHANNELS)):
        volts[:, channel] = RESTING_VOLTS[channel] + RESTING_SIGMA[channel] * sample_noise(seed, channel, block)
    if transverse is not None:
        for channel, (poly, at) in enumerate(zip(TRANSVERSE_POLY, transverse.T, strict=True), start=1):
            moved = volts[:, channel] - RESTING_VOLTS[channel] + volts_of_extension(at, poly)
            volts[:, channel] = np.where(np.isnan(at), COUNTS_MIN * VOLTS_PER_COUNT, moved)
    return counts_of_volts(volts)
