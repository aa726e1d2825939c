"""The mean of correlated samples, how far it may be off, and whether it drifts (hop 5).

The variance of the mean of n samples with autocovariance Γ(k) is σ²/n_eff with n_eff = n σ² / C and
C = Γ(0) + 2 Σ Γ(k). An estimate of Γ is noise beyond the correlation, so the sum stops at the first lag W that is at least
five times the integrated correlation time τ(W) = C(W) / (2 Γ(0)) (Sokal, "Monte Carlo methods in statistical mechanics", 1997, §3). Taking
deviations from the estimated mean lowers each Γ(k) by C/n; that is put back (Wolff, "Monte Carlo errors with less errors",
Comput. Phys. Commun. 156, 2004, eq. 49).

Where a stop begins to be at rest. The second half of a stop says what rest is: its level, and how far the mean of k blocks strays from that by noise alone.
Stretches of 1, 2, 4 … blocks, short ones for ringing and long ones for a creep, are held against that level; rest begins
after the last stretch that is off it. The bounds are such that noise alone cuts FALSE_ALARM of all stops that rest from
their beginning, whatever their number of stretches (Bonferroni), if a block's mean is Gaussian. They are never below
``floor``, which is what the user of the signal does not care about.

Nothing here knows what the signal is: the sensor's samples and the joints' readings are treated alike.

The Allan deviation. How far the mean of samples wanders as it is taken over longer times: the overlapping Allan deviation.

σ²(τ) is half the mean square of the difference of two neighbouring means over τ. White noise falls as 1/√τ; where it stops
falling is the floor below which no longer rest brings a mean. Degrees of freedom are those of white noise (Riley,
Handbook of Frequency Stability Analysis, NIST SP 1065, 2008, §5.4.1), so the intervals hold down to the floor and are too
narrow beyond it.
"""

from __future__ import annotations

from collections.abc import Sequence
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from truearm.types import Floats

SOKAL = 5.0
LEAST_LAGS = 8  # noise that alternates (a high-passed converter's) has a small τ after one lag


class MeanOfSamples(NamedTuple):
    """``variance``: of the mean; ``noise``: standard deviation of one sample; ``n_eff``: independent samples;
    ``drift``: of the least-squares line from end to end, ``drift_sigma`` its standard deviation."""

    mean: float
    variance: float
    noise: float
    n: int
    n_eff: float
    drift: float
    drift_sigma: float


def mean_of(samples: Floats) -> MeanOfSamples:
    """Mean of n ≥ 8 evenly spaced samples (n,) in any unit."""
    n = samples.size
    mean = float(np.mean(samples))
    deviation = samples - mean
    place = np.linspace(-0.5, 0.5, n)
    drift = float(place @ deviation / (place @ place))
    # Noise about the line: a drift is neither noise nor correlation, it is judged apart.
    about_line = deviation - drift * place
    variance, noise = mean_variance(about_line, fitted=2)
    n_eff = noise**2 / variance if variance > 0.0 else float(n)
    drift_sigma = float(np.sqrt(12.0 * variance))  # a slope's variance is σ²/Σx², Σx² = n/12
    return MeanOfSamples(mean, variance, noise, n, n_eff, drift, drift_sigma)


def mean_variance(deviation: Floats, fitted: int = 1) -> tuple[float, float]:
    """Variance of the mean of n samples and standard deviation of one, from their deviations (n,).

    ``fitted``: 1 for deviations from the mean, 2 from the least-squares line, which takes as much from each Γ(k) again.
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


LEAST_FREEDOM = 5.0


class Allan(NamedTuple):
    """Averaging times (k,) [s], deviations (k,) [unit of the samples], and degrees of freedom (k,)."""

    tau_s: Floats
    deviation: Floats
    freedom: Floats


def allan(pieces: Sequence[Floats], period_s: float) -> Allan:
    """Of several whole pieces of evenly spaced samples (n,), at averaging times of 1, 2, 4 … samples; at most a third of a piece."""
    longest = max((piece.size for piece in pieces), default=0)
    rows = []
    for k in range(longest.bit_length()):
        m = 1 << k
        found = [_variance(piece, m) for piece in pieces if piece.size >= 3 * m]
        freedom = sum(f for _, f in found)
        if freedom >= LEAST_FREEDOM:
            rows.append((m * period_s, np.sqrt(sum(v * f for v, f in found) / freedom), freedom))
    return Allan(*np.array(rows).reshape(-1, 3).T)


def _variance(samples: Floats, m: int) -> tuple[float, float]:
    """Variance of means of m samples, and its degrees of freedom if the noise is white."""
    n = samples.size
    sums = np.concatenate([[0.0], np.cumsum(samples - np.mean(samples))])
    means = (sums[m:] - sums[:-m]) / m
    variance = 0.5 * float(np.mean(np.square(means[m:] - means[:-m])))
    points = n + 1  # of the phase, whose differences the samples are
    freedom = (1.5 * (points - 1) / m - 2.0 * (points - 2) / points) * 4.0 * m**2 / (4.0 * m**2 + 5.0)
    return variance, max(float(freedom), 1.0)
