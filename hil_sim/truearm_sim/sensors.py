"""What the box's converter gives: lengths and voltages to counts, with noise that belongs to the sample.

The LVDT's conditioner turns the bar's extension e [m] into a voltage with e = POLY[0] + POLY[1]·V, which the box's
calibration knows. The converter has 24 bits over ±1.2 V; beyond, it saturates. While the bar is off, the core hangs out
of the coil and the input lies at the negative rail.

Noise is a pure function of seed, channel and sample index: sample k is number k mod BLOCK of the block k div BLOCK, and
each block has a generator of its own, a counter-based one (Philox) with the seed as key and channel and block in the
counter. So any chunks that a reader asks for hold the same values.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from truearm.types import Floats

CHANNELS = ("lvdt", "transverse_a", "transverse_b", "excitation")
SCALE = (1430511474609375, -22)  # mantissa and exponent, V per count: 1.2 V / 2^23, exactly
VOLTS_PER_COUNT = 1.2 / 2**23
COUNTS_MIN, COUNTS_MAX = -(2**23), 2**23 - 1
POLY = ((-4213, -7), (378812, -7))  # m and m/V, mantissa and exponent: zero −0.42 mm, gain 37.9 mm/V
SAMPLE_SIGMA = 3e-6  # m, of the LVDT's samples
RESTING_VOLTS = np.array([0.0, 0.3127, -0.1184, 0.7501])  # transducers that nothing touches, excitation reference
RESTING_SIGMA = np.array([0.0, 18e-6, 18e-6, 9e-6])  # V
BLOCK = 8192
MODULATOR_NS = 240  # 125 MHz / 15 = 8.333 MHz, two clocks a modulator period
OSRS = tuple(2**k for k in range(7, 15))


def period_ns(osr: int) -> int:
    """Sample period of the converter: 983,040 ns at oversampling 4096. Raises ValueError unless osr is in OSRS."""
    if osr not in OSRS:
        raise ValueError(f"oversampling must be one of {OSRS}, is {osr}")
    return osr * MODULATOR_NS


def group_delay_ns(osr: int) -> int:
    """How much earlier than its stamp a sample shows the signal (ADS131M04 datasheet, digital filter).

    A sinc³ filter of up to 1024 modulator periods, and beyond that an average of its outputs.
    """
    sinc = min(osr, 1024)
    return MODULATOR_NS * (3 * (sinc - 1) + (osr - sinc)) // 2


def calibration() -> dict[str, Any]:
    """What the box's ident says of the LVDT channel (protocol/SPEC.md §5)."""
    return {"unit": "m", "poly": [list(pair) for pair in POLY], "serial": "sim-lvdt", "date": "1993-10-01"}


def sample_noise(seed: int, channel: int, block: int) -> Floats:
    """Standard normal numbers (BLOCK,) of one block of samples."""
    # The key is 128 bits, the counter 256; a block draws far fewer than the 2^64 counts that its neighbours lie apart.
    bits = np.random.Philox(key=seed, counter=[0, block, channel, 0])
    return np.random.Generator(bits).standard_normal(BLOCK)


def repeatability(seed: int, n: int) -> Floats:
    """Standard normal numbers (n,), one a dwell; the first m are the same for every n ≥ m."""
    return np.random.Generator(np.random.Philox(key=seed, counter=[0, 0, len(CHANNELS), 0])).standard_normal(n)


def volts_of_extension(extension: Floats) -> Floats:
    """The conditioner's output [V] for an extension of the bar [m]."""
    zero, gain = (mantissa * 10.0**exponent for mantissa, exponent in POLY)
    return (extension - zero) / gain


def counts_of_volts(volts: Floats) -> NDArray[np.int32]:
    """The converter's counts, saturating."""
    return np.clip(np.rint(volts / VOLTS_PER_COUNT), COUNTS_MIN, COUNTS_MAX).astype(np.int32)


def sample_counts(extension: Floats, seed: int, block: int) -> NDArray[np.int32]:
    """Counts (BLOCK, 4) of one block for the bar's true extensions (BLOCK,) [m], NaN while the bar is off."""
    volts = np.empty((BLOCK, len(CHANNELS)))
    noisy = extension + SAMPLE_SIGMA * sample_noise(seed, 0, block)
    volts[:, 0] = np.where(np.isnan(extension), COUNTS_MIN * VOLTS_PER_COUNT, volts_of_extension(noisy))
    for channel in range(1, len(CHANNELS)):
        volts[:, channel] = RESTING_VOLTS[channel] + RESTING_SIGMA[channel] * sample_noise(seed, channel, block)
    return counts_of_volts(volts)
