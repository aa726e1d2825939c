"""Noise of residuals that are not as declared: of another size, or shared by rows near each other.

The kernels are V = σ²[(1 − a) I + a K] over the rows, with K: rows near in the order of measurement, rows of one mount,
or rows of similar joint readings. The one with the greatest restricted likelihood is taken, if it is better than the
declared noise by the number of kernels tried.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import linalg

from truearm.checks.whitened import WhitenedFit
from truearm.estimate.ties import first_within
from truearm.types import Floats, Indices, Mask

SHARES = (0.1, 0.3, 0.6, 0.9)  # of the variance that rows share
# Kernels with their widths: rows, and standard deviations of the joint readings.
SHAPES = (("order", 2.0), ("order", 8.0), ("order", 40.0), ("mount", 0.0), ("pose", 0.1), ("pose", 0.3), ("pose", 1.0))
STRETCH = 50  # rows; of a longer table, stretches of as many are judged
MOST_JUDGED = 400  # rows
ODD = 1e-3  # probability that χ² of noise as declared is so small or so large
ODD_ORDER = 4.0  # standard deviations of the correlation of neighbours


@dataclass(frozen=True)
class Kernel:
    """The noise of the rows in units of the declared one. ``lower`` holds L of V = L Lᵀ for each set of rows."""

    name: str = "declared"
    scale: float = 1.0  # ratio of its standard deviation to the declared one
    share: float = 0.0  # of the variance that rows share
    gain: float = 0.0  # nats over the declared noise, less the price
    lower: tuple[tuple[Indices, Floats], ...] = field(default=(), repr=False)  # residuals (c, n') and L (n', n')

    @property
    def declared(self) -> bool:
        return self.name == "declared"

    @property
    def plain(self) -> bool:
        """Return whether the noise of rows is independent."""
        return not self.lower

    def whiten(self, columns: Floats) -> Floats:
        """Return columns (m, d) divided by the root of the noise's covariance."""
        if self.plain:
            return columns / self.scale
        out = np.empty_like(columns)
        for index, lower in self.lower:
            part = columns[index].transpose(1, 0, 2)
            flat = part.reshape(len(lower), -1)
            solved = linalg.solve_triangular(lower, flat, lower=True, check_finite=False)
            out[index] = solved.reshape(part.shape).transpose(1, 0, 2)
        return out

    def dual(self, vectors: Floats) -> Floats:
        """Return L⁻ᵀ vectors (m, x): the product of whitened columns with vectors is that of the columns with these."""
        if self.plain:
            return vectors / self.scale
        out = np.empty_like(vectors)
        for index, lower in self.lower:
            flat = vectors[index].transpose(1, 0, 2)
            solved = linalg.solve_triangular(
                lower, flat.reshape(len(lower), -1), trans=1, lower=True, check_finite=False
            )
            out[index] = solved.reshape(flat.shape).transpose(1, 0, 2)
        return out

    def spread(self, columns: Floats) -> Floats:
        """Return Lᵀ columns (m, d): their Gram matrix is columnsᵀ V columns."""
        if self.plain:
            return columns * self.scale
        out = np.empty_like(columns)
        for index, lower in self.lower:
            out[index] = lower.T @ columns[index]
        return out


DECLARED = Kernel()


def similarity(fit: WhitenedFit, rows: Indices, name: str, width: float) -> Floats:
    """Return the kernel K (n', n') of some rows; ``width`` in rows, or in standard deviations of the joint readings."""
    if name == "order":
        return np.asarray(np.exp(-np.abs(rows[:, None] - rows) / width))
    if name == "mount":
        run = fit.how.run[rows]
        return np.asarray(run[:, None] == run, dtype=float)
    readings = fit.how.table.q[fit.how.row]
    z = ((readings - readings.mean(axis=0)) / np.maximum(readings.std(axis=0), 1e-9))[rows] / np.sqrt(readings.shape[1])
    square = (z**2).sum(axis=1)
    return np.asarray(np.exp(-0.5 * np.maximum(square[:, None] + square - 2.0 * z @ z.T, 0.0) / width**2))


def learned_noise(fit: WhitenedFit) -> Kernel:
    """Return the noise with the greatest restricted likelihood, or the declared one."""
    judged = judged_rows(fit.n)
    judged_residuals = np.isin(fit.row, judged)
    sets = residual_sets(fit, judged_residuals)
    columns = np.concatenate([fit.jac, fit.residual[:, None]], axis=1)[judged_residuals]
    declared, _ = likelihood(columns, fit, DECLARED, is_known=True)
    shapes = [(name, width) for name, width in SHAPES if name != "mount" or np.unique(fit.how.run[judged]).size > 1]
    kernels = [Kernel("white")]
    for name, width in shapes:
        similar = similarity(fit, judged, name, width)
        kernels += [shared(name, share, similar, sets) for share in SHARES]
    likelihoods = [likelihood(columns, fit, kernel, is_known=False) for kernel in kernels]
    best = first_within([value for value, _ in likelihoods])
    value, scale = likelihoods[best]
    gain = value - declared - math.log(len(kernels))
    if gain <= 0.0:
        return DECLARED
    kernel = kernels[best]
    if not kernel.plain:
        similar = similarity(fit, np.arange(fit.n), *shapes[(best - 1) // len(SHARES)])
        kernel = shared(kernel.name, kernel.share, similar, residual_sets(fit, np.ones(fit.row.size, dtype=bool)))
    lower = tuple((index, scale * root) for index, root in kernel.lower)
    return replace(kernel, scale=scale, gain=gain, lower=lower)


def shared(name: str, share: float, similar: Floats, sets: Sequence[tuple[Indices, Indices]]) -> Kernel:
    """Return noise of which rows have a ``share`` in common by their similarity K (n', n')."""
    lower = tuple((index, covariance_root(similar[np.ix_(rows, rows)], share)) for index, rows in sets)
    return Kernel(name, share=share, lower=lower)


def judged_rows(n: int) -> Indices:
    """Return all rows, or of many, contiguous stretches."""
    if n <= MOST_JUDGED:
        return np.arange(n)
    starts = np.linspace(0, n - STRETCH, MOST_JUDGED // STRETCH).astype(np.intp)
    return np.unique(starts[:, None] + np.arange(STRETCH))


def residual_sets(fit: WhitenedFit, judged_residuals: Mask) -> list[tuple[Indices, Indices]]:
    """Return, for each set of components of the same rows: residuals (c, n') among ``some`` (m,), and their rows (n',).

    The rows are counted among those that have any of these residuals.
    """
    row, component = np.unique(fit.row[judged_residuals], return_inverse=True)[1], fit.component[judged_residuals]
    sets: dict[bytes, list[Indices]] = {}
    for number in np.unique(component):
        index = np.flatnonzero(component == number)
        sets.setdefault(row[index].tobytes(), []).append(index)
    return [(np.array(members), row[members[0]]) for members in sets.values()]


def covariance_root(similar: Floats, share: float) -> Floats:
    """Return L with L Lᵀ = (1 − share) I + share K."""
    return np.asarray(np.linalg.cholesky(share * similar + (1.0 - share + 1e-9) * np.eye(len(similar))))


def likelihood(columns: Floats, fit: WhitenedFit, kernel: Kernel, is_known: bool) -> tuple[float, float]:
    """Return the restricted log-likelihood of residuals, the last of the ``columns`` (m, k + 1), and the scale of noise.

    −½[ν log σ² + χ²/σ² + log det V + log det(Jᵀ V⁻¹ J)], with σ² = χ²/ν unless it ``is_known`` to be 1.
    """
    white = kernel.whiten(columns)
    k, m = white.shape[1] - 1, len(white)
    known = np.concatenate([fit.knowledge_jac, fit.prior_jac])
    length = np.maximum(np.linalg.norm(np.concatenate([columns[:, :k], known]), axis=0), 1e-300)
    known = known / length
    target = np.concatenate([fit.knowledge_residual, fit.prior_residual])
    jac, residual = white[:, :k] / length, white[:, -1]
    data = jac.T @ jac
    lower = np.linalg.cholesky(data + known.T @ known + 1e-12 * np.eye(k))
    solved = linalg.solve_triangular(lower, np.column_stack([jac.T @ residual + known.T @ target, data]), lower=True)
    chi2 = float(residual @ residual + target @ target - solved[:, 0] @ solved[:, 0])
    freedom = m - float(np.trace(linalg.solve_triangular(lower, solved[:, 1:].T, lower=True)))
    variance = 1.0 if is_known else max(chi2 / max(freedom, 1.0), 1e-12)
    determinant = sum(2.0 * len(index) * float(np.log(np.diag(lower)).sum()) for index, lower in kernel.lower)
    value = -0.5 * (freedom * np.log(variance) + chi2 / variance + determinant)
    return value - float(np.log(np.diag(lower)).sum()), float(np.sqrt(variance))
