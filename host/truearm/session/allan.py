"""How far the mean of samples wanders as it is taken over longer times: the overlapping Allan deviation.

σ²(τ) is half the mean square of the difference of two neighbouring means over τ. White noise falls as 1/√τ; where it stops
falling is the floor below which no longer rest brings a mean. Degrees of freedom are those of white noise (Riley,
Handbook of Frequency Stability Analysis, NIST SP 1065, 2008, §5.4.1), so the intervals hold down to the floor and are too
narrow beyond it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from truearm.types import Floats

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
