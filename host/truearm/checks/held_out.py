"""What a finding gives in rows that were not used to estimate it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from truearm.checks.evidence import WIDEST
from truearm.checks.whitened import WhitenedFit
from truearm.types import Floats, Indices

BLOCKS = 12  # contiguous stretches of the order of measurement
FEWEST_PLACES = 3
LEAST = 1e-11  # of the largest eigenvalue of the information: less is rounding


class Gain(NamedTuple):
    """The share of the squares of left-out rows that a finding removes, and its size in standard errors over the blocks."""

    share: float
    t: float


def left_out_blocks(n: int, places: Indices | None) -> Indices:
    """Return the block (n,) of each row: its place, or one of BLOCKS stretches."""
    if places is not None and np.unique(places).size >= FEWEST_PLACES:
        return places
    return np.arange(n) * BLOCKS // n


class Block(NamedTuple):
    """Rows left out: their residuals' indices, the inverse (k, k) of what all others determine, and a basis (n, r) of what
    only these rows determine, such as the sockets of a place.
    """

    rows: Indices
    inverse: Floats
    own: Floats


def _block(rows: Indices, jac: Floats, information: Floats) -> Block:
    inside = jac[rows]
    values, vectors = np.linalg.eigh(information - inside.T @ inside)
    determined = values > LEAST * values[-1]
    usable = vectors[:, determined]
    own, singular, _ = np.linalg.svd(inside @ vectors[:, ~determined], full_matrices=False)
    return Block(rows, usable / values[determined] @ usable.T, own[:, singular > math.sqrt(LEAST)])


class LeftOut:
    """Predictions of each block of rows by a fit to all others, with the columns (m, d) of findings as parameters.

    x = (H − H_b)⁻¹(g − g_b), with H and g of all rows and knowledge. Further columns enter by their Schur complement.
    What only the rows of a block determine is fitted to these.
    """

    def __init__(self, fit: WhitenedFit, findings: Floats, blocks: Indices) -> None:
        d, k = findings.shape[1], fit.jac.shape[1]
        knowledge = np.concatenate([fit.knowledge_jac, fit.prior_jac])
        prior = np.zeros((len(knowledge) + d, k + d))
        prior[: len(knowledge), :k], prior[len(knowledge) :, k:] = knowledge, np.eye(d) / WIDEST
        jac = np.concatenate([fit.jac, findings], axis=1)
        scale = np.maximum(np.linalg.norm(np.concatenate([jac, prior]), axis=0), 1e-300)
        self.jac, prior, self.target = jac / scale, prior / scale, fit.residual
        targets = np.concatenate([fit.knowledge_residual, fit.prior_residual, np.zeros(d)])
        information, self.score = self.jac.T @ self.jac + prior.T @ prior, self.jac.T @ self.target + prior.T @ targets
        number = blocks[fit.row]
        self.blocks = [_block(np.flatnonzero(number == block), self.jac, information) for block in np.unique(number)]
        self.residual = np.empty_like(self.target)
        for block in self.blocks:
            inside, jac = block.rows, self.jac[block.rows]
            predicted = jac @ block.inverse @ (self.score - jac.T @ self.target[inside])
            self.residual[inside] = without(block.own, self.target[inside] - predicted)

    def residual_with(self, columns: Floats) -> Floats:
        """Return the residuals (m,) of all blocks with columns (m, d) as further parameters."""
        out = np.empty_like(self.residual)
        cross, square, score = self.jac.T @ columns, columns.T @ columns, columns.T @ self.target
        for inside, inverse, own in self.blocks:
            inner, jac, target = columns[inside], self.jac[inside], self.target[inside]
            others = cross - jac.T @ inner
            follow = inverse @ others
            reduced = square - inner.T @ inner + np.eye(len(square)) / WIDEST**2 - others.T @ follow
            size = np.linalg.solve(reduced, score - inner.T @ target - follow.T @ (self.score - jac.T @ target))
            out[inside] = self.residual[inside] - without(own, (inner - jac @ follow) @ size)
        return out

    def gain(self, residual: Floats) -> Gain:
        """Return the gain of residuals (m,) over those without further columns."""
        before, after = (
            np.array([float(r[block.rows] @ r[block.rows]) for block in self.blocks]) for r in (self.residual, residual)
        )
        less = before - after
        error = float(less.std(ddof=1)) / math.sqrt(less.size) if less.size > 1 else math.inf
        return Gain(float(less.sum() / before.sum()), float(less.mean() / max(error, 1e-12)))


def without(basis: Floats, values: Floats) -> Floats:
    """Return values (n,) without their part along an orthonormal basis (n, r)."""
    return np.asarray(values - basis @ (basis.T @ values))
