"""The variances of joint laws by the evidence in the data (MacKay 1992, Neural Computation 4(3), type-II maximum likelihood).

Linearised, measured − predicted = J_g·g + J_c·c + noise, where g are the parameters of geometry and rig, and c the
coefficients of the laws with the prior c ~ N(0, S), S = Σ_k v_k K_k block by block. With g integrated out, the
information of the data about c is

    A = N_cc − N_cg N_gg⁻¹ N_gc ,   b likewise of J_cᵀ R⁻¹ y ,

and the gradient of the log evidence by v_k is ½ (zᵀ K_k z − tr K_k V) with

    z = (I + A S)⁻¹ b ,   V = (I + A S)⁻¹ A .

It vanishes at the fixed point of v ← v · zᵀKz / (tr KV + 1/cap²). The last term is a half-normal hyperprior of scale
``cap`` on each standard deviation √v. Without it, a joint that hardly moves the measured point could have curves of any
size.

All computations are done in the subspace that the data determine: A = G Gᵀ, with as many columns as A has directions
that matter against a prior of scale ``cap``. Even with hundreds of poses these are few. With L Lᵀ = I + Gᵀ S G and
X = L⁻¹ Gᵀ, V = XᵀX. The covariance of the coefficients is S − S V S, computed with S = F Fᵀ as F (I + FᵀAF)⁻¹ Fᵀ, which
rounding cannot make indefinite.
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
UNSEEN = 1e-6  # a prior at its cap gains half of this in nats along a neglected direction of the data
ROUNDING = 1e-13  # of the largest such number
REVIVED = 0.03  # of the cap
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
    """The information of the data about c with everything else integrated out: A (k, k) and b (k,)."""

    information: Floats
    rhs: Floats


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
    cap = np.zeros(marginal.rhs.size)
    for block in blocks:
        cap[block.columns] = block.cap
    values, vectors = np.linalg.eigh(cap[:, None] * marginal.information * cap)
    some = values > np.maximum(UNSEEN, ROUNDING * values.max(initial=0.0))
    length = np.sqrt(values[some])
    return Seen(vectors[:, some] * length / cap[:, None], (vectors[:, some].T @ (cap * marginal.rhs)) / length)


def weigh(seen: Seen, blocks: Sequence[PriorBlock], variances: Sequence[Floats]) -> Weighed:
    """Return c at these variances."""
    root, rhs = seen
    inner = np.eye(rhs.size)
    for block, variance in zip(blocks, variances, strict=True):
        own = root[block.columns]
        inner += own.T @ (block.covariance(variance) @ own)
    lower = scipy.linalg.cholesky(0.5 * (inner + inner.T), lower=True, check_finite=False)
    x = scipy.linalg.solve_triangular(lower, np.column_stack([root.T, rhs]), lower=True, check_finite=False)
    y = x[:, -1]
    nats = 0.5 * float(rhs @ rhs - y @ y) - float(np.log(np.diag(lower)).sum())
    return Weighed(x[:, :-1], x[:, :-1].T @ y, nats)


class Coefficients(NamedTuple):
    """c (k,) and its covariance (k, k); the prior's is ``prior_root`` (k, p) times its transpose."""

    value: Floats
    covariance: Floats
    prior_root: Floats


def coefficients(
    marginal: Marginal, here: Weighed, blocks: Sequence[PriorBlock], variances: Sequence[Floats]
) -> Coefficients:
    """Return the estimate of c at these variances."""
    a, roots = marginal.information, []
    for block, variance in zip(blocks, variances, strict=True):
        values, vectors = np.linalg.eigh(block.covariance(variance))
        felt = float(np.abs(np.diag(a)[block.columns]).max(initial=block.cap**-2))  # unseen ones keep their prior
        some = values * felt * len(values) > NEGLIGIBLE
        roots.append(vectors[:, some] * np.sqrt(values[some]))
    root = scipy.linalg.block_diag(*roots) if roots else np.zeros((here.z.size, 0))
    inner = np.eye(root.shape[1]) + root.T @ a @ root
    lower = scipy.linalg.cholesky(0.5 * (inner + inner.T), lower=True, check_finite=False)
    half = scipy.linalg.solve_triangular(lower, root.T, lower=True, check_finite=False)
    return Coefficients(root @ (root.T @ here.z), half.T @ half, root)


def learned(
    seen: Seen, blocks: Sequence[PriorBlock], variances: Sequence[Floats], steps: int, tolerance: float = 3e-3
) -> list[Floats]:
    """Return the variances after ``steps`` fixed-point steps, or once no relevant one changes by over ``tolerance``."""
    out = [np.array(variance) for variance in variances]
    for _ in range(steps):
        here = weigh(seen, blocks, out)
        largest = 0.0
        for i, block in enumerate(blocks):
            gain, loss = _gradient(here, block)
            new = np.maximum(out[i] * gain / loss, FLOOR)
            scale = np.maximum(new, COUNTS * max(float(new.sum()), COUNTS * block.cap**2))
            largest = max(largest, float((np.abs(new - out[i]) / scale).max()))
            out[i] = new
        if largest < tolerance:
            break
    return out


def revived(seen: Seen, blocks: Sequence[PriorBlock], variances: Sequence[Floats]) -> list[Floats]:
    """Return the variances, restarting any that had fallen to zero but would raise the evidence.

    The fixed point is multiplicative, so a variance that fell while the noise was still too large would recover very
    slowly.
    """
    here, out = weigh(seen, blocks, variances), []
    for block, variance in zip(blocks, variances, strict=True):
        gain, loss = _gradient(here, block)
        again = (REVIVED * block.cap) ** 2
        out.append(np.where((variance < again) & (gain > loss), again, variance))
    return out


def _gradient(here: Weighed, block: PriorBlock) -> tuple[Floats, Floats]:
    """Return zᵀKz and tr KV + 1/cap² of each kernel."""
    z, v = here.z[block.columns], here.v(block.columns)
    flat = block.kernels.reshape(len(block.kernels), -1)
    return flat @ np.outer(z, z).ravel(), flat @ v.ravel() + 1.0 / block.cap**2


def block_nats(here: Weighed, block: PriorBlock, variances: Floats) -> float:
    """Return by how much a block raises the log evidence, all other variances unchanged: its Savage–Dickey ratio."""
    z, v, s = here.z[block.columns], here.v(block.columns), block.covariance(variances)
    left = np.eye(len(z)) - v @ s
    sign, logarithm = np.linalg.slogdet(left)
    if sign <= 0.0:  # rounding, if the data are overwhelming
        return math.inf
    return 0.5 * float(logarithm) + 0.5 * float(z @ s @ np.linalg.solve(left, z))
