"""Estimate the variance of a mean of samples, where a signal rests, and its long-term wander.

**The mean of correlated samples** has the variance C / n, with the sum C of the autocovariances. The sum ends at the
first lag that is five times the integrated correlation time (Sokal, "Monte Carlo methods in statistical mechanics", 1997,
§3), and is corrected for the estimated mean (Wolff, Comput. Phys. Commun. 156, 2004, eq. 49).

**Rest** is defined by a stop's second half. Stretches of 1, 2, 4 … blocks are compared with its level: short ones show
ringing, long ones creep. Rest begins after the last stretch that deviates by more than noise or ``floor`` explains. Noise
alone truncates a fraction FALSE_ALARM of stops.
"""

from __future__ import annotations

from functools import cache
from statistics import NormalDist
from typing import Annotated, NamedTuple

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from truearm.types import Floats

SOKAL = 5.0
LEAST_LAGS = 8  # alternating noise (of a high-passed converter) has a small τ after one lag


class MeanOfSamples(NamedTuple):
    """Statistics of a mean.

    ``value_var``: variance of the mean; ``noise``: standard deviation of one sample; ``n_eff``: number of independent samples;
    ``drift``: end-to-end change of the least-squares line; ``drift_sigma``: its standard deviation.
    """

    value: float
    value_var: Annotated[float, Meta(ge=0.0)]
    noise: float
    n_samples: int
    n_eff: float
    drift: float
    drift_sigma: float


def mean_of(samples: Floats) -> MeanOfSamples:
    """Return the mean of n ≥ 8 evenly spaced samples (n,) in any unit."""
    n = samples.size
    # Noise about the line: a drift is neither noise nor correlation and is judged separately.
    mean, drift, about_line = _line(samples)
    variance, noise = mean_variance(about_line, fitted=2)
    n_eff = noise**2 / variance if variance > 0.0 else float(n)
    drift_sigma = float(np.sqrt(12.0 * variance))  # a slope's variance is σ²/Σx², Σx² = n/12
    return MeanOfSamples(mean, variance, noise, n, n_eff, drift, drift_sigma)


def _line(samples: Floats) -> tuple[float, float, Floats]:
    """Return the mean of samples (n,), the end-to-end change of their least-squares line, and the residuals (n,) of it."""
    mean, place = float(np.mean(samples)), np.linspace(-0.5, 0.5, samples.size)
    drift = float(place @ (samples - mean) / (place @ place))
    return mean, drift, samples - mean - drift * place


def mean_variance(deviation: Floats, fitted: int = 1) -> tuple[float, float]:
    """Return the variance of the mean of n samples and the standard deviation of one, from their deviations (n,).

    ``fitted``: 1 for deviations from the mean, 2 from the least-squares line, which lowers each Γ(k) by the same amount
    again.
    """
    n = deviation.size
    padded = 1 << (2 * n - 1).bit_length()
    spectrum = np.fft.rfft(deviation, padded)
    gamma = np.fft.irfft(spectrum * spectrum.conj(), padded)[: n // 2] / (n - np.arange(n // 2))
    if gamma[0] <= 0.0:
        return 0.0, 0.0
    tau = np.cumsum(gamma) / gamma[0] - 0.5  # τ(W), 1/2 for white noise
    lags = np.arange(tau.size)
    enough = np.flatnonzero(lags >= np.maximum(LEAST_LAGS, SOKAL * tau))
    window = int(enough[0]) if enough.size else tau.size - 1
    total = 2.0 * gamma[0] * max(float(tau[window]), 0.0)
    bias = fitted * total / n
    gamma0 = float(gamma[0]) + bias
    total = max(total + (2 * window + 1) * bias, gamma0 / n)
    return total / n, float(np.sqrt(gamma0))


FALSE_ALARM = 1e-4  # five dwells, for seven channels in 7200 dwells
LEAST_BLOCKS = 4


class Settled(NamedTuple):
    """Where one or several signals come to rest.

    ``first`` (…): index of the first block at rest, or the number of blocks if none is. ``level`` (…): mean of the
    second half. ``deviation`` (…, b): block means minus the level. ``bound`` (…): allowed deviation of one block.
    """

    first: NDArray[np.intp]
    level: Floats
    deviation: Floats
    bound: Floats


def settled_from(means: Floats, block_var: Floats | float, floor: Floats | float) -> Settled:
    """Return where the means (…, b) of consecutive blocks come to rest; each has the variance ``block_var`` (…) by
    noise.
    """
    b = means.shape[-1]
    half = b // 2
    level, deviation = _from_level(means)
    level_var = np.asarray(block_var) / (b - half)
    sums = np.concatenate([np.zeros((*means.shape[:-1], 1)), np.cumsum(deviation, axis=-1)], axis=-1)
    widths = [1 << k for k in range(max(1, half).bit_length())]
    sigmas = _sigmas(b * len(widths))
    first = np.zeros(means.shape[:-1], dtype=np.intp)
    for width in widths:
        stretch = (sums[..., width:] - sums[..., :-width]) / width
        bound = np.maximum(floor, sigmas * np.sqrt(block_var / width + level_var))
        off = np.abs(stretch) > bound[..., None]
        last = off.shape[-1] - np.argmax(off[..., ::-1], axis=-1)
        first = np.maximum(first, np.where(np.any(off, axis=-1), last, 0))
    return Settled(first, level, deviation, np.maximum(floor, sigmas * np.sqrt(block_var + level_var)))


def rests_within(means: Floats, floor: Floats | float) -> bool:
    """Return whether ``settled_from()`` finds all signals at rest from their first block, whatever their noise.

    A stretch deviates by no more than the largest deviation of its blocks, and every bound is at least ``floor`` (…).
    """
    _, deviation = _from_level(means)
    # Sums of blocks are rounded: that adds far less than one part in a million to the deviation of a stretch.
    return bool(np.all(np.abs(deviation).max(axis=-1) <= np.asarray(floor) * (1.0 - 1e-6)))


def _from_level(means: Floats) -> tuple[Floats, Floats]:
    """Return the mean (…) of the second half of the blocks (…, b), and the deviations (…, b) from it."""
    level = np.mean(means[..., means.shape[-1] // 2 :], axis=-1)
    return level, means - level[..., None]


@cache
def _sigmas(stretches: int) -> float:
    """Return the deviation, in standard deviations, that one of so many stretches exceeds with probability FALSE_ALARM."""
    return -NormalDist().inv_cdf(FALSE_ALARM / (2.0 * stretches))


def block_means(samples: Floats, length: int) -> Floats:
    """Return the means (n // length,) of consecutive blocks of samples (n,); the first n % length samples are not used."""
    count = samples.size // length
    return np.asarray(samples[samples.size - count * length :].reshape(count, length).mean(axis=1))


def block_variance(samples: Floats, length: int) -> float:
    """Return the variance of the mean of a block of this length, from the second half of the samples (n,) about its
    line.

    This is the larger of two values, derived from the correlation for a mean of many blocks and from the spread of the
    blocks. If neighbouring noise cancels, long means are far quieter than short ones.
    """
    _, _, about_line = _line(samples[samples.size // 2 :])
    of_mean, _ = mean_variance(about_line, fitted=2)
    means = block_means(about_line, length)
    spread = float(np.var(means, ddof=1)) if means.size > 1 else 0.0
    return max(of_mean * about_line.size / length, spread)


def quick_noise(samples: Floats) -> float:
    """Return the standard deviation of white samples (n,), n > 2, from their second differences.

    A swing of an arm hardly changes these.
    """
    return float(np.sqrt(np.mean(np.square(np.diff(samples, n=2))) / 6.0))


def rings(settled: Settled) -> bool:
    """Return whether deviations from the level change sides, as in a swing.

    If they stay on one side, it is a creep or a drift.
    """
    side = np.sign(settled.deviation[np.abs(settled.deviation) > settled.bound])
    return int(np.count_nonzero(np.diff(side))) >= 2
