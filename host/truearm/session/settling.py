"""Where a stop begins to be at rest, by a signal's own noise (hop 5).

The second half of a stop says what rest is: its level, and how far the mean of k blocks strays from that by noise alone.
Stretches of 1, 2, 4 … blocks, short ones for ringing and long ones for a creep, are held against that level; rest begins
after the last stretch that is off it. The bounds are such that noise alone cuts FALSE_ALARM of all stops that rest from
their beginning, whatever their number of stretches (Bonferroni), if a block's mean is Gaussian. They are never below
``floor``, which is what the user of the signal does not care about.

Nothing here knows what the signal is: the sensor's samples and the joints' readings are treated alike.
"""

from __future__ import annotations

from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from truearm.session.sample_statistics import mean_variance
from truearm.types import Floats

FALSE_ALARM = 1e-4  # of seven channels in 7200 dwells, five dwells
LEAST_BLOCKS = 4


class Settled(NamedTuple):
    """``first``: index of the first block at rest, the number of blocks if none is; ``level``: mean of the second half.

    ``deviation`` (b,): block means less the level; ``bound``: how far one block may stray.
    """

    first: int
    level: float
    deviation: Floats
    bound: float


def settled_from(means: Floats, block_var: float, floor: float) -> Settled:
    """Where the means (b,) of consecutive blocks, each of variance ``block_var`` by noise, come to rest."""
    b = means.size
    half = b // 2
    level = float(np.mean(means[half:]))
    level_var = block_var / (b - half)
    deviation = means - level
    sums = np.concatenate([[0.0], np.cumsum(deviation)])
    widths = [1 << k for k in range(max(1, half).bit_length())]
    sigmas = -NormalDist().inv_cdf(FALSE_ALARM / (2.0 * b * len(widths)))
    first = 0
    for width in widths:
        stretch = (sums[width:] - sums[:-width]) / width
        off = np.flatnonzero(np.abs(stretch) > max(floor, sigmas * np.sqrt(block_var / width + level_var)))
        first = max(first, int(off[-1]) + 1 if off.size else 0)
    return Settled(first, level, deviation, max(floor, float(sigmas * np.sqrt(block_var + level_var))))


def block_means(samples: Floats, length: int) -> Floats:
    """Means (n // length,) of consecutive blocks of samples (n,); the first n % length samples are in none."""
    count = samples.size // length
    return np.asarray(samples[samples.size - count * length :].reshape(count, length).mean(axis=1))


def block_variance(samples: Floats, length: int) -> float:
    """How far the mean of a block of this length strays, by the second half of the samples (n,) about its own line.

    The larger of what its correlation says of a mean of many blocks and of the blocks' own spread: noise of which
    neighbours cancel has far quieter long means than short ones.
    """
    tail = samples[samples.size // 2 :]
    place = np.linspace(-0.5, 0.5, tail.size)
    about_line = tail - np.mean(tail) - float(place @ tail / (place @ place)) * place
    of_mean, _ = mean_variance(about_line, fitted=2)
    means = block_means(about_line, length)
    spread = float(np.var(means, ddof=1)) if means.size > 1 else 0.0
    return max(of_mean * tail.size / length, spread)


def quick_noise(samples: Floats) -> float:
    """Standard deviation of white samples (n,), n > 2, by their second differences, which a swing of an arm hardly alters."""
    return float(np.sqrt(np.mean(np.square(np.diff(samples, n=2))) / 6.0))


def rings(found: Settled) -> bool:
    """Whether what is off the level changes sides: a swing; else it comes from one side: a creep or a drift."""
    side = np.sign(found.deviation[np.abs(found.deviation) > found.bound])
    return int(np.count_nonzero(np.diff(side))) >= 2
