"""The variances of joint laws by the evidence in the data (MacKay 1992, Neural Computation 4(3), type-II maximum
likelihood).

Linearised, measured − predicted = J_g·g + J_c·c + noise. g, geometry and rig, is integrated out. The coefficients of
laws are c ~ N(0, S), S = Σ_k v_k K_k. docs/explanation/estimation.md has the fixed point of each v_k, with a
half-normal hyperprior of scale ``cap`` on √v. Without it, a joint that hardly moves the point could have curves of any
size.

All computations are in the subspace that the data determine, A = G Gᵀ with few columns. With L Lᵀ = I + Gᵀ S G, X = L⁻¹
Gᵀ and V = XᵀX, the covariance of the coefficients is S − S V S. It is computed with S = F Fᵀ as F (I + FᵀAF)⁻¹ Fᵀ,
which rounding cannot make indefinite.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.linalg

from truearm.types import Floats

FLOOR = 1e-30  # a smaller variance counts as zero
NEGLIGIBLE = 1e-7  # nats that a neglected direction of the prior may contribute
UNSEEN = 1e-3  # a prior at its cap gains half of this in nats along a neglected direction of the data
ROUNDING = 1e-13  # of the largest such number
REVIVED = 0.03  # of the cap
LEAP = 4.0
COUNTS = 1e-3  # relative to a block's variance: smaller kernel variances are ignored in the convergence test


@dataclass(frozen=True, eq=False)
class PriorBlock:
    """The prior of some coefficients of c: Σ_k v_k ``kernels[k]``, with hyperpriors of scale ``cap`` on √v_k."""

    columns: slice
    kernels: Floats  # (o, m, m)
    cap: float

    def covariance(self, variances: Floats) -> Floats:
        """Return its part (m, m) of S."""
        flat = self.kernels.reshape(len(self.kernels), -1)
        return (variances @ flat).reshape(self.kernels.shape[1:])


class Marginal(NamedTuple):
    """The information of the data about c with everything else integrated out: A = RᵀR and b = Rᵀz."""

    root: Floats  # (m, k) R
    rhs: Floats  # (m,) z


class Seen(NamedTuple):
    """The subspace of c that the data determine: A = G Gᵀ and b = G β, with G (k, r) and β (r,)."""

    root: Floats
    rhs: Floats


class Weighed(NamedTuple):
    """c at given variances: the log evidence [nats] relative to that without laws, and the factors of z and V."""

    x: Floats  # (r, k)
    z: Floats  # (k,)
    nats: float

    def v(self, columns: slice) -> Floats:
        """Return V of one block."""
        x = self.x[:, columns]
        return x.T @ x


def seen_by(marginal: Marginal, blocks: Sequence[PriorBlock]) -> Seen:
    """Return the directions of c that the data determine."""
    cap = np.zeros(marginal.root.shape[1])
    for block in blocks:
        cap[block.columns] = block.cap
    scaled = marginal.root * cap
    tall = scaled.shape[0] > scaled.shape[1]
    square, vectors = np.linalg.eigh(scaled.T @ scaled if tall else scaled @ scaled.T)  # rounding is far below UNSEEN
    directions = vectors[:, square > UNSEEN]
    if tall:
        directions = scaled @ directions / np.sqrt(square[square > UNSEEN])
    return Seen(marginal.root.T @ directions, directions.T @ marginal.rhs)


def weigh(data: Seen, blocks: Sequence[PriorBlock], variances: Sequence[Floats]) -> Weighed:
    """Return c at these variances."""
    root, rhs = data
    inner = np.eye(rhs.size)
    if blocks:
        pairs = zip(blocks, variances, strict=True)
        half = np.concatenate([_half(block.covariance(variance)) @ root[block.columns] for block, variance in pairs])
        inner += half.T @ half
    lower = scipy.linalg.cholesky(inner, lower=True, check_finite=False)
    # On its own the transpose is in LAPACK's order, which takes half the time of one array with the right side.
    x, y = (
        scipy.linalg.solve_triangular(lower, right_side, lower=True, check_finite=False) for right_side in (root.T, rhs)
    )
    nats = 0.5 * float(rhs @ rhs - y @ y) - float(np.log(np.diag(lower)).sum())
    return Weighed(x, x.T @ y, nats)


def _half(covariance: Floats) -> Floats:
    """Return H (m, m) with HᵀH = covariance, with ROUNDING of its size added, which makes it definite."""
    size = max(float(np.trace(covariance)), FLOOR)
    return np.asarray(np.linalg.cholesky(covariance + ROUNDING * size * np.eye(len(covariance))).T, dtype=float)


class Coefficients(NamedTuple):
    """c (k,) and its covariance (k, k); the prior's is ``prior_root`` (k, p) times its transpose."""

    value: Floats
    covariance: Floats
    prior_root: Floats


def coefficients(
    marginal: Marginal, weighed: Weighed, blocks: Sequence[PriorBlock], variances: Sequence[Floats]
) -> Coefficients:
    """Return the estimate of c at these variances."""
    information = (marginal.root**2).sum(axis=0)
    roots = [prior_root(b, v, information[b.columns].max(initial=0.0)) for b, v in zip(blocks, variances, strict=True)]
    root = scipy.linalg.block_diag(*roots) if roots else np.zeros((weighed.z.size, 0))
    pieces = [marginal.root[:, block.columns] @ of_block for block, of_block in zip(blocks, roots, strict=True)]
    along = np.concatenate([marginal.root[:, :0], *pieces], axis=1)
    lower = np.linalg.cholesky(np.eye(root.shape[1]) + along.T @ along)
    half = scipy.linalg.solve_triangular(lower, root.T, lower=True, check_finite=False)
    return Coefficients(root @ (root.T @ weighed.z), half.T @ half, root)


def prior_root(block: PriorBlock, variances: Floats, information: float = 0.0) -> Floats:
    """Return F (m, p) with F Fᵀ the block's prior, without directions that ``information`` cannot tell from none."""
    values, vectors = np.linalg.eigh(block.covariance(variances))
    significant = values * max(information, block.cap**-2) * len(values) > NEGLIGIBLE  # unseen ones keep their prior
    return np.asarray(vectors[:, significant] * np.sqrt(values[significant]))


def learned(
    data: Seen, blocks: Sequence[PriorBlock], variances: Sequence[Floats], steps: int, tolerance: float = 3e-3
) -> list[Floats]:
    """Return the variances after ``steps`` fixed-point steps, or once no relevant one changes by over ``tolerance``.

    The fixed point is approached slowly, so every two steps are extrapolated (SQUAREM: Varadhan and Roland 2008,
    Scandinavian Journal of Statistics 35(2)) in the standard deviations. If the evidence is then lower than at the point
    before the last step, the extrapolation is undone. It is also undone if there is no step left to check it with.
    """
    current = [np.array(variance) for variance in variances]
    undo: list[Floats] | None = None
    history, objective = [current], -math.inf
    for _ in range(steps):
        weighed = weigh(data, blocks, current)
        value = _objective(weighed, blocks, current)
        if undo is not None and value < objective:
            current, history, undo = undo, [undo], None
            continue
        objective = value
        new, largest = _step(weighed, blocks, current)
        if largest < tolerance:
            return new
        history, current, undo = [*history, new], new, None
        if len(history) == 3:
            current, undo = _extrapolated(*history), new
            history = [current]
    return current if undo is None else undo


def _step(weighed: Weighed, blocks: Sequence[PriorBlock], variances: Sequence[Floats]) -> tuple[list[Floats], float]:
    """Return the variances after a fixed-point step, and the largest relative change of a relevant one."""
    out, largest = [], 0.0
    for block, variance in zip(blocks, variances, strict=True):
        gain, loss = _gradient(weighed, block)
        new = np.maximum(variance * gain / loss, FLOOR)
        scale = np.maximum(new, COUNTS * max(float(new.sum()), COUNTS * block.cap**2))
        largest = max(largest, float((np.abs(new - variance) / scale).max()))
        out.append(new)
    return out, largest


def _objective(weighed: Weighed, blocks: Sequence[PriorBlock], variances: Sequence[Floats]) -> float:
    """Return the log evidence with the hyperprior."""
    return weighed.nats - sum(float(v.sum()) / (2.0 * block.cap**2) for v, block in zip(variances, blocks, strict=True))


def _extrapolated(first: Sequence[Floats], second: Sequence[Floats], third: Sequence[Floats]) -> list[Floats]:
    """Return the variances beyond three successive ones; none falls or rises by more than LEAP beyond the third."""
    a, b, c = (np.sqrt(np.concatenate(values)) for values in (first, second, third))
    bend = float(np.linalg.norm(c - 2.0 * b + a))
    stride = max(float(np.linalg.norm(b - a)) / bend, 1.0) if bend > 0.0 else 1.0
    beyond = np.clip(a + 2.0 * stride * (b - a) + stride**2 * (c - 2.0 * b + a), c / LEAP, c * LEAP)
    ends = np.cumsum([len(values) for values in third])[:-1]
    return [np.maximum(values**2, FLOOR) for values in np.split(beyond, ends)]


def revived(data: Seen, blocks: Sequence[PriorBlock], variances: Sequence[Floats]) -> list[Floats]:
    """Return the variances, restarting any that had fallen to zero but would raise the evidence.

    The fixed point is multiplicative, so a variance that fell while the noise was still too large would recover very
    slowly.
    """
    weighed, out = weigh(data, blocks, variances), []
    for block, variance in zip(blocks, variances, strict=True):
        gain, loss = _gradient(weighed, block)
        again = (REVIVED * block.cap) ** 2
        out.append(np.where((variance < again) & (gain > loss), again, variance))
    return out


def _gradient(weighed: Weighed, block: PriorBlock) -> tuple[Floats, Floats]:
    """Return zᵀKz and tr KV + 1/cap² of each kernel."""
    z, v = weighed.z[block.columns], weighed.v(block.columns)
    flat = block.kernels.reshape(len(block.kernels), -1)
    return flat @ np.outer(z, z).ravel(), flat @ v.ravel() + 1.0 / block.cap**2


def block_nats(weighed: Weighed, block: PriorBlock, variances: Floats) -> float:
    """Return by how much a block raises the log evidence, all other variances unchanged: its Savage–Dickey ratio."""
    z, v, s = weighed.z[block.columns], weighed.v(block.columns), block.covariance(variances)
    remaining = np.eye(len(z)) - v @ s
    sign, logarithm = np.linalg.slogdet(remaining)
    if sign <= 0.0:  # rounding, if the data are overwhelming
        return math.inf
    return 0.5 * float(logarithm) + 0.5 * float(z @ s @ np.linalg.solve(remaining, z))
