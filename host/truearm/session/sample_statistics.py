r"""The mean of correlated samples, how far it may be off, and whether it drifts (hop 5).

The variance of the mean of n samples with autocovariance Γ(k) is σ²/n_eff with n_eff = n σ² / C and
C = Γ(0) + 2 Σ Γ(k). An estimate of Γ is noise beyond the correlation, so the sum stops at the first lag W that is at least
five times the integrated correlation time τ(W) = C(W) / (2 Γ(0)) (Sokal, "Monte Carlo methods in statistical mechanics", 1997, §3). Taking
deviations from the estimated mean lowers each Γ(k) by C/n; that is put back (Wolff, "Monte Carlo errors with less errors",
Comput. Phys. Commun. 156, 2004, eq. 49).
"""

from __future__ import annotations

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
