"""The variances of joint laws by the evidence in the data (MacKay 1992, Neural Computation 4(3), type-II maximum
likelihood).

Linearised, measured − predicted = J_g·g + G·f + noise. g, geometry and rig, is integrated out. The modes f of all laws
are independent, f_j ~ N(0, s_j) with s = v·spectra. docs/explanation/estimation.md has the gradient by the variances v,
with a half-normal hyperprior of scale ``cap`` on each √v. Without it, a joint that hardly moves the point could have
curves of any size.

All computations are in the subspace that the data determine, A = G Gᵀ with few columns. With L Lᵀ = I + Gᵀ S G, X = L⁻¹
Gᵀ and V = XᵀX, the covariance of the modes is S − S V S.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.linalg
from scipy.linalg import get_lapack_funcs

from truearm.types import Floats, Indices

_pstrf = get_lapack_funcs("pstrf", dtype=np.float64)
UNSEEN = 1e-3  # a prior at its cap gains half of this in nats along a neglected direction of the data
REVIVED = 0.03  # of the cap: least √v where learning starts, because zero is a stationary point
STEPS = 8  # of the variances, for one noise


class ModePrior(NamedTuple):
    """The prior of f modes: ``spectra`` (v, f) per variance, and the scale ``cap`` (v,) of the hyperprior on √v."""

    spectra: Floats
    cap: Floats


class Seen(NamedTuple):
    """The subspace of f that the data determine: A = G Gᵀ and b = G β, with G (f, r) and β (r,)."""

    root: Floats
    rhs: Floats


class Weighed(NamedTuple):
    """f at given variances: the log evidence [nats] relative to that without laws, and the factors of z and V."""

    x: Floats  # (r, f)
    z: Floats  # (f,)
    nats: float


def seen_by(information: Floats, rhs: Floats, prior: ModePrior) -> Seen:
    """Return the directions of f that the data determine, from A (f, f) and b (f,)."""
    if not rhs.size:
        return Seen(np.zeros((0, 0)), np.zeros(0))
    scale = np.sqrt(prior.cap**2 @ prior.spectra)
    factor, pivot, rank, _ = _pstrf(scale[:, None] * information * scale, UNSEEN, lower=1)
    lower, order = np.tril(factor[:, :rank]), pivot - 1
    root = np.empty_like(lower)
    root[order] = lower / scale[order, None]
    return Seen(root, solve_lower(lower[:rank], (scale * rhs)[order[:rank]]))


def weigh(data: Seen, sizes: Floats) -> Weighed:
    """Return f at the prior variances ``sizes`` (f,)."""
    half = np.sqrt(sizes)[:, None] * data.root
    lower, y, nats = _evidence(data, half.T @ half)
    # On its own the transpose is in LAPACK's order, which takes half the time of one array with the right side.
    x = solve_lower(lower, data.root.T)
    return Weighed(x, x.T @ y, nats)


def nats_of(data: Seen, sizes: Floats, number: Indices) -> list[float]:
    """Return by how much [nats] the log evidence falls without the modes of each ``number`` (f,), all others unchanged."""
    half = np.sqrt(sizes)[:, None] * data.root
    square = half.T @ half
    dropped = (half[number == law] for law in range(int(number.max(initial=-1)) + 1))
    total = _evidence(data, square)[2]
    return [total - _evidence(data, square - modes.T @ modes)[2] for modes in dropped]


def _evidence(data: Seen, square: Floats) -> tuple[Floats, Floats, float]:
    """Return L (r, r), L⁻¹β (r,) and the log evidence, from Gᵀ S G (r, r)."""
    lower = np.asarray(np.linalg.cholesky(np.eye(data.rhs.size) + square), dtype=float)
    y = solve_lower(lower, data.rhs)
    return lower, y, 0.5 * float(data.rhs @ data.rhs - y @ y) - float(np.log(np.diag(lower)).sum())


def solve_lower(lower: Floats, right_side: Floats) -> Floats:
    """Return L⁻¹ times a right side."""
    if not lower.size:
        return np.zeros_like(right_side)
    return np.asarray(scipy.linalg.solve_triangular(lower, right_side, lower=True, check_finite=False))


def learned(data: Seen, prior: ModePrior, variances: Floats, steps: int = STEPS) -> Floats:
    """Return the variances (v,) that maximise the evidence with the hyperprior, at most ``steps`` from where they are."""
    from scipy.optimize import minimize  # slow to import, and large

    def cost(size: Floats) -> tuple[float, Floats]:
        weighed = weigh(data, (size * prior.cap) ** 2 @ prior.spectra)
        slope = prior.spectra @ (weighed.z**2 - (weighed.x**2).sum(axis=0))
        return 0.5 * float(size @ size) - weighed.nats, size * (1.0 - prior.cap**2 * slope)

    if not variances.size:
        return variances
    start = np.maximum(np.sqrt(variances) / prior.cap, REVIVED)
    options = {"maxiter": steps, "ftol": 1e-5}
    optimum = minimize(cost, start, jac=True, method="L-BFGS-B", bounds=[(0.0, None)] * start.size, options=options)
    return np.asarray((optimum.x * prior.cap) ** 2)
