r"""Values and rates at chosen instants of a moving signal: a cubic through the samples about each instant (hop 5).

Over the window t − w … t + w a polynomial of third degree is fitted by least squares; its value and slope at t are taken.
That is interpolation and averaging in one: with n samples of white noise σ the value has the variance (9/4) σ²/n.

**What it may be wrong by.** A signal's next term, of fourth degree, is c·P₄(u) beyond a cubic (P₄ Legendre's, u = −1 … 1
over the window). At the middle it is off by (3/8)·c, and the residuals that it leaves have the RMS c/3. So the error at
the middle is 9/8 of the RMS of the residuals, and at most that where these are partly noise. The same fit of two signals
that move together, a device's reading and the joints that carry it, errs alike in both.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.types import Floats

DEGREE = 3
LEAST = DEGREE + 3  # samples of a window
MISSED = 9.0 / 8.0  # error in the middle over the RMS of the residuals


class LocalFits(NamedTuple):
    """At r instants, of c signals: value (r, c), rate (r, c) [1/s], RMS residual (r, c) for n − 4 degrees of freedom,
    number of samples n (r,), and the variance of the value (r,) for white noise of variance 1."""

    value: Floats
    rate: Floats
    rms: Floats
    n: NDArray[np.int64]
    leverage: Floats


def fit_locally(t: Floats, values: Floats, centres: Floats, half_s: float) -> LocalFits:
    """Cubics about ``centres`` (r,) [s] through samples ``values`` (n, c) at ``t`` (n,) [s] ascending, w = ``half_s``.

    NaN where a window holds fewer than LEAST samples. Whether a window is whole is the caller's to know.
    """
    r, c = centres.size, values.shape[1]
    low, high = np.searchsorted(t, centres - half_s), np.searchsorted(t, centres + half_s, side="right")
    value, rate, rms = (np.full((r, c), np.nan) for _ in range(3))
    out = LocalFits(value, rate, rms, high - low, np.full(r, np.nan))
    for k in np.flatnonzero(high - low >= LEAST):
        window = slice(low[k], high[k])
        u = (t[window] - centres[k]) / half_s
        q, triangle = np.linalg.qr(np.vander(u, DEGREE + 1, increasing=True))
        if np.abs(np.diag(triangle)).min() < 1e-6:  # all at one time
            continue
        of_samples = q.T @ values[window]
        inverse = np.linalg.inv(triangle)
        out.value[k], out.rate[k] = (inverse @ of_samples)[:2]
        out.rate[k] /= half_s
        left = values[window] - q @ of_samples
        out.rms[k] = np.sqrt(np.sum(left**2, axis=0) / (u.size - DEGREE - 1))
        out.leverage[k] = float(inverse[0] @ inverse[0])
    return out
