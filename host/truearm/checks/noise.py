"""Noise of residuals that are not as declared: of another size, or shared by rows near each other.

The kernels are V = σ²[(1 − a) I + a K] over the rows. K correlates rows near in the order of measurement, rows of one
mount, or rows of similar joint readings. The one with the greatest restricted likelihood is taken, if it is better than
the declared noise by the number of kernels tried.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy import linalg

from truearm.checks.whitened import DECLARED, Kernel, SharedNoise, WhitenedFit
from truearm.estimate.ties import first_within
from truearm.types import Floats, Indices

SHARES = (0.1, 0.3, 0.6, 0.9)  # of the variance that rows share
# Kernels with their widths: rows, and standard deviations of the joint readings.
SHAPES = (("order", 2.0), ("order", 8.0), ("order", 40.0), ("mount", 0.0), ("pose", 0.1), ("pose", 0.3), ("pose", 1.0))
STRETCH = 50  # rows; of a longer table, stretches of as many are judged
MOST_JUDGED = 400  # rows

(_potri,) = linalg.get_lapack_funcs(("potri",), dtype=np.float64)


def learned_noise(fit: WhitenedFit) -> Kernel:
    """Return the noise with the greatest restricted likelihood, or the declared one."""
    rows = judged_rows(fit.n)
    inside = np.isin(fit.row, rows)
    row = np.searchsorted(rows, fit.row[inside])
    moves = fit.jac[inside].any(axis=0)  # of the others, such as far knots of a curve, there is only the prior
    jac = fit.jac[inside][:, moves]
    prior = fit.wide_prior[:, np.append(moves, True)][fit.wide_prior[:, :-1][:, moves].any(axis=1)]
    length = np.maximum(np.linalg.norm(np.concatenate([jac, prior[:, :-1]]), axis=0), 1e-300)
    judged = replace(
        fit,
        row=row,
        component=fit.component[inside],
        jac=jac / length,
        residual=fit.residual[inside],
        wide_prior=prior / np.append(length, 1.0),
    )
    shapes = [(name, width) for name, width in SHAPES if name != "mount" or np.unique(fit.measured.run[rows]).size > 1]
    choices = [("white", 0.0, 0.0), *((*shape, share) for shape in shapes for share in SHARES)]
    declared, _ = likelihood(judged, DECLARED)
    likelihoods = [likelihood(judged, kernel_of(judged, rows, *choice)) for choice in choices]
    best = first_within([value for value, _ in likelihoods])
    value, scale = likelihoods[best]
    gain = value - declared - math.log(len(choices))
    if gain <= 0.0:
        return DECLARED
    return replace(kernel_of(fit, np.arange(fit.n), *choices[best]), scale=scale, gain=gain)


def likelihood(fit: WhitenedFit, kernel: Kernel) -> tuple[float, float]:
    """Return the restricted log-likelihood of the residuals, and the scale of the noise.

    −½[ν log σ² + χ²/σ² + log det V + log det(Jᵀ V⁻¹ J)], with σ² = χ²/ν unless the kernel is the declared one. The columns
    of J are of similar length.
    """
    m, k = fit.jac.shape
    white = kernel.whiten(np.column_stack([fit.jac, fit.residual]))
    data = white.T @ white
    lower = np.linalg.cholesky(data + fit.wide_prior.T @ fit.wide_prior + 1e-12 * np.eye(k + 1))
    inverse = _potri(lower[:k, :k], lower=1)[0]  # the lower triangle
    chi2 = float(lower[k, k] ** 2)
    freedom = m - float((inverse * (2.0 * np.tril(data[:k, :k], -1) + np.diag(np.diag(data)[:k]))).sum())
    variance = 1.0 if kernel.declared else max(chi2 / max(freedom, 1.0), 1e-12)
    cost = freedom * math.log(variance) + chi2 / variance + kernel.log_determinant
    return -0.5 * cost - float(np.log(np.diag(lower)[:k]).sum()), math.sqrt(variance)


def judged_rows(n: int) -> Indices:
    """Return all rows, or of many, contiguous stretches."""
    if n <= MOST_JUDGED:
        return np.arange(n)
    starts = np.linspace(0, n - STRETCH, MOST_JUDGED // STRETCH).astype(np.intp)
    return np.unique(starts[:, None] + np.arange(STRETCH))


def similarity(fit: WhitenedFit, rows: Indices, name: str, width: float) -> Floats:
    """Return the kernel K (n', n') of some rows; ``width`` in rows, or in standard deviations of the joint readings."""
    if name == "order":
        return np.asarray(np.exp(-np.abs(rows[:, None] - rows) / width))
    if name == "mount":
        run = fit.measured.run[rows]
        return np.asarray(run[:, None] == run, dtype=float)
    readings = fit.measured.table.q[fit.measured.row]
    z = ((readings - readings.mean(axis=0)) / np.maximum(readings.std(axis=0), 1e-9))[rows] / np.sqrt(readings.shape[1])
    square = (z**2).sum(axis=1)
    return np.asarray(np.exp(-0.5 * np.maximum(square[:, None] + square - 2.0 * z @ z.T, 0.0) / width**2))


def kernel_of(fit: WhitenedFit, rows: Indices, name: str, width: float, share: float) -> Kernel:
    """Return (1 − share) I + share K over the ``rows`` of a fit, once for all components that the same rows have."""
    if not share:
        return Kernel(name)
    covariance = (1.0 - share) * np.eye(rows.size) + share * similarity(fit, rows, name, width)
    sets: dict[bytes, list[Indices]] = {}
    for number in np.unique(fit.component):
        residuals = np.flatnonzero(fit.component == number)
        sets.setdefault(fit.row[residuals].tobytes(), []).append(residuals)
    stacks = [np.stack(stack, axis=1) for stack in sets.values()]
    row_sets = (fit.row[residuals[:, 0]] for residuals in stacks)
    roots = (linalg.cholesky(covariance[np.ix_(members, members)], lower=True) for members in row_sets)
    return Kernel(
        name, shared=tuple(SharedNoise(residuals, root) for residuals, root in zip(stacks, roots, strict=True))
    )
