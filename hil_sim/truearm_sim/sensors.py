"""What the box's converter and its magnetostrictive head give: lengths to counts and times, with noise that belongs to the sample.

The LVDT's conditioner turns the bar's extension e [m] into a voltage with e = POLY[0] + POLY[1]·V, which the box's
calibration knows. The converter has 24 bits over ±1.2 V; beyond, it saturates. While the bar is off, the core hangs out
of the coil and the input lies at the negative rail.

Noise is a pure function of seed, channel and sample index: sample k is number k mod BLOCK of the block k div BLOCK, and
each block has a generator of its own, a counter-based one (Philox) with the seed as key and channel and block in the
counter. So any chunks that a reader asks for hold the same values.

Beside a line device the transverse transducers' conditioners give a voltage likewise; where the magnet is out of their reach they lie at the
negative rail too, and the head finds no pulse.

The magnetostrictive head sends a strain pulse from the magnet along its wire; its time of flight is position / v plus the delay of
the electronics, with v = 25.4 mm / (US_PER_INCH µs), and the position is that at the interrogation edge.
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
TRANSVERSE_POLY = (((118, -6), (7163, -6)), ((-73, -6), (7091, -6)))  # m and m/V of either, 7.5 mm at some 1.05 V
SAMPLE_SIGMA = 3e-6  # m, of the LVDT's samples
RESTING_VOLTS = np.array([0.0, 0.3127, -0.1184, 0.7501])  # transducers that nothing touches, excitation reference
RESTING_SIGMA = np.array([0.0, 18e-6, 18e-6, 9e-6])  # V
BLOCK = 8192
MODULATOR_NS = 240  # 125 MHz / 15 = 8.333 MHz, two clocks a modulator period
OSRS = tuple(2**k for k in range(7, 15))
US_PER_INCH = (905, -2)  # mantissa and exponent, as on the sensor's label
SOUND = 25400.0 / 9.05  # m/s
MAG_DELAY_NS = 1200  # of the head's electronics
# 5.1 µm. The counter's tick is 22.5 µm; this noise spreads a resting magnet over its borders, so that the mean of many shots is
# wrong by (tick/π)·exp(−2π²·(σ/tick)²) = 2.6 µm at most, where without noise it would be half a tick.
MAG_SIGMA_PS = 1800
TICK_PS = 8000  # of the counter that times the flight
# Generators beside those of the converter's channels 0 to 3 and of the repeatability, 4.
_MAG_NOISE, _MAG_STOPS = 5, 6


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


CALIBRATED_MDEGC = 24_500  # of the box, when its LVDT was calibrated


def calibration(poly: Poly = POLY, serial: str = "sim-lvdt") -> dict[str, Any]:
    """What the box's ident says of a channel, the LVDT's by default (protocol/SPEC.md §5)."""
    return {"unit": "m", "poly": [list(pair) for pair in poly], "serial": serial, "date": "2026-01-01"}


def sample_noise(seed: int, channel: int, block: int) -> Floats:
    """Standard normal numbers (BLOCK,) of one block of samples."""
    # The key is 128 bits, the counter 256; a block draws far fewer than the 2^64 counts that its neighbours lie apart.
    bits = np.random.Philox(key=seed, counter=[0, block, channel, 0])
    return np.random.Generator(bits).standard_normal(BLOCK)


def flight_times(position: Floats, lost: float, seed: int, block: int) -> NDArray[np.int64]:
    """Times of flight (BLOCK,) [ps] of one block of shots at magnet positions (BLOCK,) [m].

    −1, no stop pulse, for a share ``lost`` of them and where the position is NaN.
    """
    flights = 1e12 / SOUND * position + 1e3 * MAG_DELAY_NS + MAG_SIGMA_PS * sample_noise(seed, _MAG_NOISE, block)
    bits = np.random.Philox(key=seed, counter=[0, block, _MAG_STOPS, 0])
    stopless = np.random.Generator(bits).random(BLOCK) < lost
    return np.where(stopless | np.isnan(position), -1, np.rint(flights)).astype(np.int64)


def magnetostrictive(period_ns: int) -> dict[str, Any]:
    """What the box's configuration says of the head, read at this period; 0: never."""
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
    """Standard normal numbers (n,), one per dwell; the first m are the same for every n ≥ m."""
    return np.random.Generator(np.random.Philox(key=seed, counter=[0, 0, len(CHANNELS), 0])).standard_normal(n)


def volts_of_extension(extension: Floats, poly: Poly = POLY) -> Floats:
    """A conditioner's output [V] for what it measures [m], the bar's extension by default."""
    zero, gain = (mantissa * 10.0**exponent for mantissa, exponent in poly)
    return (extension - zero) / gain


def counts_of_volts(volts: Floats) -> NDArray[np.int32]:
    """The converter's counts, saturating."""
    return np.clip(np.rint(volts / VOLTS_PER_COUNT), COUNTS_MIN, COUNTS_MAX).astype(np.int32)


def sample_counts(extension: Floats, seed: int, block: int, transverse: Floats | None = None) -> NDArray[np.int32]:
    """Counts (BLOCK, 4) of one block for the bar's true extensions (BLOCK,) [m], NaN while the bar is off.

    ``transverse`` (BLOCK, 2) [m]: the magnet before the transverse transducers, NaN out of their reach; without it they rest.
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
