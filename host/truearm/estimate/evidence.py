"""The variances of joint laws by the evidence in the data (MacKay 1992, Neural Computation 4(3), type-II maximum likelihood).

Linearised, measured − predicted = J_g·g + J_c·c + noise: g are geometry and rig, c the laws' coefficients with the prior
c ~ N(0, S), S = Σ_k v_k K_k block by block. With g integrated out the data say of c

    A = N_cc − N_cg N_gg⁻¹ N_gc ,   b likewise of J_cᵀ R⁻¹ y ,

and the gradient of the log evidence by v_k is ½ (zᵀ K_k z − tr K_k V) with

    z = (I + A S)⁻¹ b ,   V = (I + A S)⁻¹ A .

Its zero is the fixed point v ← v · zᵀKz / (tr KV + 1/cap²). The last part is a half-normal hyperprior of scale ``cap`` on each
standard deviation √v: without it a joint that the measured point hardly sees may have curves of any size.

With S = F Fᵀ and L Lᵀ = I + Fᵀ A F, X = L⁻¹ Fᵀ A: V = A − XᵀX, and the coefficients' covariance is (L⁻¹Fᵀ)ᵀ(L⁻¹Fᵀ). F has as
many columns as S has directions that the data could tell, so smooth curves cost less.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.linalg

from truearm.types import Floats

FLOOR = 1e-30  # a variance below this is none
NEGLIGIBLE = 1e-7  # nats that a direction of the prior may be worth to be left out
REVIVED = 0.03  # of the cap
COUNTS = 1e-3  # of a block's variance: a kernel's below this may change as it likes when convergence is judged


@dataclass(frozen=True, eq=False)
class PriorBlock:
    """The prior of some coefficients of c: Σ_k v_k ``kernels[k]``, with hyperpriors of scale ``cap`` on √v_k."""

    columns: slice
    kernels: Floats  # (o, m, m)
    cap: float

    def covariance(self, variances: Floats) -> Floats:
        """(m, m) its part of S."""
        return np.asarray(np.tensordot(variances, self.kernels, 1))


class Marginal(NamedTuple):
    """What the data say of c with everything else integrated out: A (k, k) and b (k,)."""

    information: Floats
    rhs: Floats


class Weighed(NamedTuple):
    """c at some variances: the log evidence [nats] over that of no laws, and what z, V and the posterior follow from."""

    marginal: Marginal
    root: Floats  # (k, r) F
    x: Floats  # (r, k)
    lower: Floats  # (r, r) L
    z: Floats  # (k,)
    nats: float

    def v(self, columns: slice) -> Floats:
        """V of one block."""
        x = self.x[:, columns]
        return np.asarray(self.marginal.information[columns, columns] - x.T @ x)

    def posterior(self) -> tuple[Floats, Floats]:
        """The coefficients (k,) and their covariance (k, k)."""
        half = scipy.linalg.solve_triangular(self.lower, self.root.T, lower=True, check_finite=False)
        return self.root @ (self.root.T @ self.z), np.asarray(half.T @ half)


def weigh(marginal: Marginal, blocks: Sequence[PriorBlock], variances: Sequence[Floats]) -> Weighed:
    """Return c at these variances."""
    a, b = marginal
    roots = []
    for block, variance in zip(blocks, variances, strict=True):
        values, vectors = np.linalg.eigh(block.covariance(variance))
        seen = float(np.abs(np.diag(a)[block.columns]).max(initial=0.0))
        some = values * seen * len(values) > NEGLIGIBLE
        roots.append(vectors[:, some] * np.sqrt(values[some]))
    root = scipy.linalg.block_diag(*roots) if roots else np.zeros((b.size, 0))
    seen_root = np.concatenate(
        [a[:, block.columns] @ part for block, part in zip(blocks, roots, strict=True)] or [np.zeros((b.size, 0))],
        axis=1,
    )
    inner = np.eye(root.shape[1]) + root.T @ seen_root
    lower = scipy.linalg.cholesky(0.5 * (inner + inner.T), lower=True, check_finite=False)
    x = scipy.linalg.solve_triangular(lower, seen_root.T, lower=True, check_finite=False)
    y = scipy.linalg.solve_triangular(lower, root.T @ b, lower=True, check_finite=False)
    nats = 0.5 * float(y @ y) - float(np.log(np.diag(lower)).sum())
    return Weighed(marginal, root, x, lower, b - x.T @ y, nats)


def learned(
    marginal: Marginal, blocks: Sequence[PriorBlock], variances: Sequence[Floats], steps: int, tolerance: float = 3e-3
) -> list[Floats]:
    """The variances after at most ``steps`` of the fixed point, or where none that counts changes by more than ``tolerance``."""
    out = [np.array(variance) for variance in variances]
    for _ in range(steps):
        here = weigh(marginal, blocks, out)
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


def revived(marginal: Marginal, blocks: Sequence[PriorBlock], variances: Sequence[Floats]) -> list[Floats]:
    """The variances, where one that had fallen to nothing would raise the evidence begun again.

    The fixed point multiplies, so what fell under a noise that was still too large would take very long to come back.
    """
    here, out = weigh(marginal, blocks, variances), []
    for block, variance in zip(blocks, variances, strict=True):
        gain, loss = _gradient(here, block)
        again = (REVIVED * block.cap) ** 2
        out.append(np.where((variance < again) & (gain > loss), again, variance))
    return out


def _gradient(here: Weighed, block: PriorBlock) -> tuple[Floats, Floats]:
    """zᵀKz and tr KV + 1/cap² of each kernel."""
    z, v = here.z[block.columns], here.v(block.columns)
    return (block.kernels @ z) @ z, (block.kernels * v).sum(axis=(1, 2)) + 1.0 / block.cap**2


def block_nats(here: Weighed, block: PriorBlock, variances: Floats) -> float:
    """By how much a block raises the log evidence, all other variances as they are: its Savage–Dickey ratio."""
    z, v, s = here.z[block.columns], here.v(block.columns), block.covariance(variances)
    left = np.eye(len(z)) - v @ s
    sign, logarithm = np.linalg.slogdet(left)
    if sign <= 0.0:  # rounding, where the data are overwhelming
        return math.inf
    return 0.5 * float(logarithm) + 0.5 * float(z @ s @ np.linalg.solve(left, z))
