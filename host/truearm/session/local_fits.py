"""Values and rates of a moving signal at chosen instants, by local cubics.

A polynomial of third degree is fitted by least squares over the window t − w … t + w, and its value and slope at t are
used. This interpolates and averages in one step: with n samples of white noise σ the value has the variance (9/4) σ²/n.

**Truncation error.** Beyond a cubic, the signal's next term is of fourth degree, c·P₄(u), where P₄ is Legendre's
polynomial and u = −1 … 1 over the window. It causes an error of (3/8)·c at the middle and residuals with an RMS of c/3.
The error at the middle is therefore 9/8 of the RMS of the residuals, or less if these are partly noise. The same fit
has the same error in two signals that move together, such as a device's reading and the joints that drive it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.types import Floats

DEGREE = 3
LEAST = DEGREE + 3  # samples per window
MISSED = 9.0 / 8.0  # error at the middle divided by the RMS of the residuals


class LocalFits(NamedTuple):
    """Local fits at r instants of c signals.

    Value (r, c), rate (r, c) [1/s], RMS residual (r, c) for n − 4 degrees of freedom, number of samples n (r,), and
    variance of the value (r,) for white noise of variance 1.
    """

    value: Floats
    rate: Floats
    rms: Floats
    n: NDArray[np.int64]
    leverage: Floats


def fit_locally(t: Floats, values: Floats, centres: Floats, half_s: float) -> LocalFits:
    """Fit cubics around ``centres`` (r,) [s] to samples ``values`` (n, c) at ascending ``t`` (n,) [s], with w =
    ``half_s``.

    NaN where a window holds fewer than LEAST samples. The caller must check that a window is complete.
    """
    r, c = centres.size, values.shape[1]
    low, high = np.searchsorted(t, centres - half_s), np.searchsorted(t, centres + half_s, side="right")
    value, rate, rms = (np.full((r, c), np.nan) for _ in range(3))
    out = LocalFits(value, rate, rms, high - low, np.full(r, np.nan))
    for k in np.flatnonzero(high - low >= LEAST):
        window = slice(low[k], high[k])
        u = (t[window] - centres[k]) / half_s
        q, triangle = np.linalg.qr(np.vander(u, DEGREE + 1, increasing=True))
        if np.abs(np.diag(triangle)).min() < 1e-6:  # all samples at one time
            continue
        of_samples = q.T @ values[window]
        inverse = np.linalg.inv(triangle)
        out.value[k], out.rate[k] = (inverse @ of_samples)[:2]
        out.rate[k] /= half_s
        left = values[window] - q @ of_samples
        out.rms[k] = np.sqrt(np.sum(left**2, axis=0) / (u.size - DEGREE - 1))
        out.leverage[k] = float(inverse[0] @ inverse[0])
    return out
